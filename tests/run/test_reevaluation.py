"""MJX beside the closed form: the right model agrees, one that is wrong by a hundredth is named with a state."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.evaluation import compare_with_mjx
from rtcd_jax.run.reevaluation import physics_line, require_equal_physics
from rtcd_jax.system.errors import UserError
from tests import pipeline
from tests.plants.robots import packaged

STATES = 102


class Heavier(type(packaged("pendulum"))):
    """Its MuJoCo model has `factor` times the mass of its equations."""

    factor: float = 1.0

    def edit_model(self, design):
        edits = dict(super().edit_model(design))
        edits["body_mass"] = {name: self.factor * mass for name, mass in edits["body_mass"].items()}
        return edits


@cache
def _program():
    problem = pipeline.problem()
    elites = problem.config.elites.model_copy(update={"mjx_states": STATES})
    config = problem.config.model_copy(update={"elites": elites})
    row = jax.tree.map(lambda leaf: leaf[pipeline.RTCD], pipeline.evaluated())
    constants = {field.name: getattr(problem.plant, field.name) for field in dataclasses.fields(problem.plant)}

    @jax.jit
    def compare(factor):
        changed = dataclasses.replace(problem, config=config, plant=Heavier(**constants, factor=factor))
        return compare_with_mjx(changed, row, jax.random.key(5))

    return lambda factor: jax.device_get(compare(jnp.asarray(factor)))


@pytest.mark.thorough
def test_the_robots_model_agrees_with_its_equations():
    """To rounding, on states of all knots: none fails by MJX."""
    found = _program()(1.0)
    assert found.states == STATES
    assert found.failures == 0
    assert found.difference < 1e-9
    require_equal_physics(found)
    line = physics_line([found, found])
    assert line.startswith("MJX: 204 held-out samples of 2 funnels followed to the goal, 0 failed; largest")


@pytest.mark.thorough
@pytest.mark.parametrize("factor", [1.01, 0.99, 1.0001])
def test_a_wrong_mass_is_found_and_a_state_named(factor):
    found = _program()(factor)
    assert found.difference > 1e-6
    with pytest.raises(UserError, match="MJX and the closed form differ by") as error:
        require_equal_physics(found)
    text = str(error.value)
    assert f"of knot {found.knot} is at [" in text
    assert "\n" not in text
    for state in (found.start, found.closed_form, found.mjx):
        assert np.array2string(state, precision=9, separator=", ") in text
