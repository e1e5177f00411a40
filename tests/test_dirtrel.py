"""DIRTREL's l_w against dense matrix exponentials, its input constraint, and a search for it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import yaml

from rtcd_jax.config import load as configuration
from rtcd_jax.config.load import parse
from rtcd_jax.dirtrel import dirtrel
from rtcd_jax.evaluation import volumes_of
from rtcd_jax.policy import linearize
from rtcd_jax.system.errors import ConfigError
from rtcd_jax.types import Status
from rtcd_jax.volume import DIRTREL, VOLUMES
from tests import pipeline
from tests.test_adversary import uncertainty


@pytest.fixture(scope="module")
def best():
    """Problem, candidate and policy of the published RTC-D pendulum."""
    one = jax.tree.map(lambda leaf: leaf[0], pipeline.evaluated().take(np.array([pipeline.RTCD])))
    return pipeline.problem(), one.candidate, one.funnel


def spreads(problem, candidate, policy, width):
    """l_w and what the feedback asks for at the knots, by scipy."""
    motion = policy.trajectory
    a, b = linearize(problem, candidate, motion.xs[:-1].T, motion.us.T)
    q, r = np.diag(candidate.q), np.diag(candidate.r)
    e, total, asked = np.zeros((2, 2)), 0.0, []
    for k in range(len(motion.us)):
        gain, a_k, b_k = np.asarray(policy.gains[k]), np.asarray(a[..., k]), np.asarray(b[..., k])
        total += np.trace((q + gain.T @ r @ gain) @ e)
        asked.append(np.sqrt((gain @ e @ gain.T)[0, 0]))
        flow = scipy.linalg.expm(float(motion.dt) * np.block([[a_k - b_k @ gain, b_k], [np.zeros((1, 3))]]))
        e = flow[:2, :2] @ e @ flow[:2, :2].T + width**2 * flow[:2, 2:] @ flow[:2, 2:].T
    return total, np.array(asked)


def test_it_is_the_inverse_of_the_summed_cost(best):
    problem, candidate, funnel = best
    total, _ = spreads(problem, candidate, funnel.policy, 1.0)
    np.testing.assert_allclose(jax.jit(lambda: dirtrel(problem, candidate, funnel.policy))(), 1 / total, rtol=1e-9)


def test_inputs_near_the_limit_take_their_share(best):
    problem, candidate, funnel = best
    robust = dataclasses.replace(problem, uncertainty=uncertainty(input=0.05))
    slack = np.array([3.0])
    weak = dataclasses.replace(robust, plant=dataclasses.replace(robust.plant, torque_limit=float(slack[0])))
    total, asked = spreads(problem, candidate, funnel.policy, 0.05)
    room = slack - np.abs(np.asarray(funnel.policy.trajectory.us))[:, 0]
    share = min(1.0, np.min(room[1:] / asked[1:]))
    found = jax.jit(lambda: dirtrel(weak, candidate, funnel.policy))()
    np.testing.assert_allclose(found, share / total, rtol=1e-9)
    assert share > 0


def test_only_a_search_for_it_knows_it(best):
    problem, candidate, funnel = best
    assert tuple(volumes_of(problem, candidate, funnel).named) == tuple(VOLUMES)
    search = problem.config.search.model_copy(update={"objective": DIRTREL})
    searching = dataclasses.replace(problem, config=problem.config.model_copy(update={"search": search}))
    volumes = volumes_of(searching, candidate, funnel)
    assert tuple(volumes.named) == (*VOLUMES, DIRTREL)
    empty = dataclasses.replace(funnel, status=jnp.int32(Status.FUNNEL_EMPTY))
    assert volumes_of(searching, candidate, empty)[DIRTREL] == 0 < volumes[DIRTREL]


def test_nothing_goes_up_it_by_gradients():
    data = yaml.safe_load(configuration.EXAMPLE) | {"search": {"objective": "dirtrel", "refine": True}}
    with pytest.raises(ConfigError, match=r"search.refine = True: goes up no dirtrel: it needs a volume"):
        parse(data)
