"""The paper's pendulum candidates through the whole pipeline once, shared by the tests that look at parts of it."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from rtcd_jax.config import load as configuration
from rtcd_jax.evaluation import make_evaluate
from rtcd_jax.genome import encode
from rtcd_jax.problem import Problem, make_problem
from rtcd_jax.types import Evaluation

INITIAL, RTC, RTCD, HARD, LONG = range(5)
CANDIDATES = np.array(
    [
        (0.7, 0.4, 10, 1, 0.1),
        (0.7, 0.4, 9.50228149856, 1.19799233059, 1.63899990462),
        (0.6078624798988952, 0.40117256711300914, 9.981383224646017, 1.0005008747137005, 3.3867989083644128),
        (0.7, 0.4, 10, 1, 0.002),
        (0.75, 0.55, 4, 2, 0.8),
    ]
)
"""Mass, length, q, q, r: the paper's initial candidate, its published optima, one that steers too hard, a long one."""

GENERATION = jax.random.key(0)


@cache
def problem() -> Problem:
    """The paper's box with the default settings, all closed form."""
    data = yaml.safe_load(configuration.EXAMPLE) | {"funnel": {"rollouts": "closed_form"}}
    return make_problem(configuration.parse(data))


@cache
def genomes() -> jax.Array:
    """Those of `CANDIDATES` [5 d]."""
    return jnp.asarray([encode(problem(), row) for row in CANDIDATES.tolist()])


@cache
def evaluate():
    """The jitted evaluation of a generation."""
    return jax.jit(make_evaluate(problem()))


@cache
def evaluated() -> Evaluation:
    """Those of all candidates."""
    return jax.block_until_ready(evaluate()(genomes(), GENERATION))


def same(left, right) -> bool:
    """Whether two pytrees are equal bit by bit."""
    pairs = zip(jax.tree.leaves(left), jax.tree.leaves(right), strict=True)
    return all(np.array_equal(a, b, equal_nan=jnp.issubdtype(a.dtype, jnp.floating)) for a, b in pairs)
