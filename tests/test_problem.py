"""Configuration -> Problem: every number at its place, and a goal that is an equilibrium."""

import numpy as np
import pytest

from rtcd_jax.config.load import EXAMPLE, parse_yaml
from rtcd_jax.problem import initial_design, make_problem
from rtcd_jax.system.errors import ConfigError
from tests.plants.robots import packaged


def problem_of(text=EXAMPLE):
    return make_problem(parse_yaml(text))


def test_the_plant_has_the_constants_of_the_configuration():
    text = EXAMPLE.replace("{name: pendulum}", "{name: pendulum, damping: 0.2, gravity: 3.7, torque_limit: 1.5}")
    problem = problem_of(text)
    assert problem.plant == packaged("pendulum", damping=0.2, gravity=3.7, torque_limit=1.5)
    np.testing.assert_array_equal(problem.input_limits(initial_design(problem)), [1.5])


def test_task_and_grid_are_those_of_the_configuration():
    problem = problem_of(EXAMPLE.replace("7]}", ".inf]}") + "trajectory: {knots: 31}\n")
    np.testing.assert_array_equal(problem.start, [0, 0])
    np.testing.assert_array_equal(problem.goal, [np.pi, 0])
    np.testing.assert_array_equal(problem.state_limits, [2 * np.pi, np.inf])
    assert problem.intervals == 30


def test_variables_stand_in_the_order_design_q_r_whatever_the_order_of_the_file():
    swapped = EXAMPLE.replace(
        "design: {mass: {initial: 0.7, min: 0.6, max: 0.8}, length: {initial: 0.4, min: 0.4, max: 0.6}}",
        "design: {length: {initial: 0.4, min: 0.4, max: 0.6}, mass: {initial: 0.7, min: 0.6, max: 0.8}}",
    )
    assert swapped != EXAMPLE
    names = ["design.mass", "design.length", "weights.q.0", "weights.q.1", "weights.r.0"]
    for text in (EXAMPLE, swapped):
        problem = problem_of(text)
        assert [v.name for v in problem.variables] == names
        assert [v.initial for v in problem.variables] == [0.7, 0.4, 10, 1, 0.1]
        assert [v.low for v in problem.variables] == [0.6, 0.4, 1, 1, 0.001]
        assert [v.high for v in problem.variables] == [0.8, 0.6, 10, 10, 10]
        assert problem.design_dims == (True, True, False, False, False)


@pytest.mark.parametrize("goal", ["[3.141592653589793, 0]", "[-3.141592653589793, 0]", "[3.14159266, 0]"])
def test_a_goal_within_rounding_of_an_equilibrium_is_taken(goal):
    problem_of(EXAMPLE.replace("goal: [3.141592653589793, 0]", f"goal: {goal}"))


@pytest.mark.parametrize("goal", ["[3.1415, 0]", "[3.141592, 0]", "[3.141592653589793, 0.001]", "[1, 0]"])
def test_a_goal_that_is_no_equilibrium_is_refused(goal):
    """An angle short by d leaves an acceleration of g d / l, 24.5 d here: 1.6e-5 for six decimals, 2e-7 for eight."""
    with pytest.raises(ConfigError, match=r"task\.goal = .* is no equilibrium without input: .* would have to be zero"):
        problem_of(EXAMPLE.replace("goal: [3.141592653589793, 0]", f"goal: {goal}"))


@pytest.mark.parametrize(
    ("goal", "meant"),
    [
        ("[3.14, 0]", "; did you mean theta = pi (3.141592653589793)?"),
        ("[-3, 0]", "; did you mean theta = -pi (-3.141592653589793)?"),
        ("[6.2, 0]", "; did you mean theta = 2 pi (6.283185307179586)?"),
        ("[0.01, 0]", "; did you mean theta = 0?"),
        ("[1.57, 0]", "zero"),
        ("[3.14, 0.1]", "zero"),
    ],
)
def test_the_equilibrium_beside_a_goal_is_named(goal, meant):
    """A quarter turn is none of the pendulum's, and no angle mends a speed."""
    text = EXAMPLE.replace("goal: [3.141592653589793, 0]", f"goal: {goal}").replace("start: [0, 0]", "start: [1, 0]")
    with pytest.raises(ConfigError) as caught:
        problem_of(text)
    assert str(caught.value).endswith(meant)
