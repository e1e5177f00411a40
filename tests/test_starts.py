"""The starting guesses of the trajectory optimizer, for every robot that ships a configuration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.config.load import load
from rtcd_jax.problem import Problem, make_problem
from rtcd_jax.trajectory import slowest_oscillation, starts
from tests.paths import CONFIGS


def _problem(name: str) -> Problem:
    return make_problem(load(CONFIGS / f"{name}.yaml"))


def test_a_damped_pendulum_swings_at_its_natural_frequency():
    b, g, m, l = 0.1, 9.81, 0.7, 0.4  # noqa: E741
    decay = b / (2 * m * l**2)
    assert slowest_oscillation(_problem("pendulum_rtcd")) == pytest.approx(np.sqrt(g / l - decay**2), rel=1e-12)


def test_what_does_not_oscillate_swings_once():
    """About the upright every mode is real."""
    config = load(CONFIGS / "pendulum_rtcd.yaml")
    task = config.task.model_copy(update={"start": config.task.goal, "goal": config.task.start})
    standing = make_problem(config.model_copy(update={"task": task}))
    assert slowest_oscillation(standing) == 0
    assert np.all(np.isfinite(starts(standing, jnp.float64).xs))


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["pendulum_rtcd", "cartpole_rtcd"])
def test_guesses_join_the_ends_at_admissible_steps(name):
    problem = _problem(name)
    guesses = jax.jit(lambda: starts(problem, jnp.float64))()  # constants, also inside a trace
    positions = problem.plant.n // 2
    step = problem.config.trajectory.step
    for guess in range(guesses.h.size):
        ends = guesses.xs[guess][[0, -1], :positions]
        np.testing.assert_allclose(ends, [problem.start[:positions], problem.goal[:positions]], atol=1e-12)
        assert step.min < guesses.h[guess] < step.max
        travelled = np.trapezoid(guesses.xs[guess, :, positions:], dx=guesses.h[guess], axis=0)
        np.testing.assert_allclose(travelled, (problem.goal - problem.start)[:positions], atol=1e-2)
