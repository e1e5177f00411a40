"""A cheap stand-in for the pipeline: whole Evaluation records whose volumes are a known function of the genome."""

import jax
import jax.numpy as jnp

from rtcd_jax.types import Candidate, Evaluation, Funnel, Policy, Status, Trajectory, Volumes
from tests.plants.robots import packaged

PENDULUM = packaged("pendulum")

N = 3


def evaluate_one(genome, volume, status):
    """A record whose every field depends on the genome, so that a mix-up of rows shows."""
    mark = jnp.sum(genome * 10.0 ** jnp.arange(len(genome)))
    xs = mark * jnp.ones((N + 1, 2))
    values = mark * jnp.ones((N + 1, 2, 2))
    trajectory = Trajectory(mark * jnp.ones((N, 1)), xs, mark, mark, mark, jnp.int32(7), status)
    policy = Policy(trajectory, mark * jnp.ones((N + 1, 1, 2)), values, status)
    funnel = Funnel(policy, mark * jnp.ones(N + 1), jnp.full(N + 1, 9), status)
    named = {
        "sum": volume,
        "integral": 2 * volume,
        "inlet": 1 / volume,
        "geometric_mean": volume**2,
        "push": volume / 100,
    }
    volumes = Volumes(volume * jnp.ones(N + 1), named)
    candidate = Candidate(PENDULUM.Design(genome[0], genome[-1]), mark * jnp.ones(2), mark * jnp.ones(1))
    return Evaluation(genome, candidate, funnel, volumes, status)


def population(genomes, volumes, statuses=None):
    statuses = jnp.zeros(len(genomes), jnp.int32) if statuses is None else jnp.asarray(statuses, jnp.int32)
    return jax.vmap(evaluate_one)(jnp.asarray(genomes), jnp.asarray(volumes, jnp.float64), statuses)


@jax.jit
def bowl(genomes, key):
    """Volumes up to 100 at the genome (0.8, 0.6, 0.4, ...), 1 % of noise from the key; the far corner is infeasible."""
    best = 0.8 - 0.2 * jnp.arange(genomes.shape[1]) % 0.8
    noise = 1 + 0.01 * jax.random.uniform(key)
    volumes = 100 * noise * jnp.exp(-jnp.sum((genomes - best) ** 2, axis=1))
    return population(genomes, volumes, jnp.where(jnp.sum(genomes, axis=1) < 0.3, Status.TRAJECTORY_NOT_SOLVED, 0))
