"""The window of a catch: the free hook is in it in all of the last ellipsoid, and the set is no smaller than that."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.config.load import load, parse, resolved
from rtcd_jax.evaluation import make_evaluate
from rtcd_jax.genome import decode, initial_genome
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.plants import brachiation
from rtcd_jax.problem import make_problem
from rtcd_jax.run.format import record_of
from rtcd_jax.run.reevaluation import row
from rtcd_jax.system.errors import ConfigError
from rtcd_jax.types import Status
from rtcd_jax.window import catch_shape, farthest, window_radius
from tests.paths import CONFIGS

SIZE, SPEED = 0.03, 1.5


def experiment(catch, name="acromonk", **sections):
    data = resolved(load(CONFIGS / f"{name}.yaml"))
    data["task"]["catch"] = catch
    for section, keys in sections.items():
        data[section] |= keys
    return parse(data)


@cache
def swing():
    trajectory = {"knots": 41, "step": {"min": 0.0125, "max": 0.1}}
    problem = make_problem(experiment({"window": {"gripper": SIZE}, "speed": SPEED}, trajectory=trajectory))
    return problem, decode(problem, jnp.asarray(initial_genome(problem)))


def hook(candidate, x):
    return np.asarray(brachiation.hook({"arm_length": float(candidate.design.arm_length)}, jnp.asarray(x)))


def test_the_hook_is_where_the_arms_lead():
    """Hanging straight it is two arms below the bar; stretched forward two arms in front of it; folded at the bar."""
    poses = jnp.asarray(np.array([[0, 0, 0, 0], [np.pi / 2, 0, 0, 0], [0.3, np.pi, 0, 0]]).T)
    found = brachiation.hook({"arm_length": 0.3}, poses)
    np.testing.assert_allclose(found, [[0, 0.6, 0], [-0.6, 0, 0]], atol=1e-15)


def test_the_linearized_hook_fills_its_window():
    """J E J' = size^2 I, and the velocities have the speed as half width."""
    problem, candidate = swing()
    shape = np.linalg.inv(catch_shape(problem, candidate))
    step = 1e-6 * np.eye(4)[:2]
    turn = np.stack([(hook(candidate, problem.goal + e) - hook(candidate, problem.goal - e)) / 2e-6 for e in step], 1)
    np.testing.assert_allclose(turn @ shape[:2, :2] @ turn.T, SIZE**2 * np.eye(2), atol=1e-9)
    np.testing.assert_allclose(shape[2:, 2:], SPEED**2 * np.eye(2))


@cache
def three_links():
    """The first swing of RicMonk, in a cycle with a window."""
    whole = make_problem(experiment({"reset": "brachiation", "window": {"gripper": SIZE}}, "ricmonk"))
    return whole.tasks[0], decode(whole, jnp.asarray(initial_genome(whole)), jnp.asarray(0))


@pytest.mark.parametrize("robot", [swing, three_links])
@pytest.mark.parametrize("seed", range(3))
def test_the_largest_ellipsoid_with_the_hook_in_its_window(robot, seed):
    """Of any shape, through the kinematics themselves: none of 400,000 states on the rim is outside, some are near."""
    problem, candidate = robot()
    problem = problem.of(candidate)
    rng, n = np.random.default_rng(seed), problem.plant.n
    root = rng.normal(size=(n, n))
    goal = jnp.asarray(problem.goal)
    last = Ellipsoids.about(goal[:, None], jnp.asarray(root @ root.T + np.eye(n))[..., None])
    radius = float(window_radius(problem, candidate, last))
    y = rng.normal(size=(n, 400_000))
    x = last.points(jnp.full((1, 400_000), radius), jnp.asarray(y / np.linalg.norm(y, axis=0))[:, None])[:, 0]
    off = np.linalg.norm(hook(candidate, x) - hook(candidate, goal[:, None]), axis=0)
    assert 0.99 * SIZE < off.max() < SIZE
    assert float(farthest(problem, candidate, last, jnp.asarray(radius**2))) == pytest.approx(off.max(), rel=1e-2)


@pytest.mark.thorough
def test_a_swing_ends_in_its_window():
    """The curved way of the hook takes a little from the set that the window's linear shape is."""
    problem, _ = swing()
    one = row(jax.jit(make_evaluate(problem))(jnp.asarray(initial_genome(problem))[None], jax.random.key(0)), 0)
    assert one.status == Status.OK
    window = record_of(problem, one)["window"]["gripper"]
    assert 0.97 * SIZE < window["farthest"] <= SIZE == window["size"]


GRIPPER = {"window": {"gripper": 0.03}}
WRONG = {
    "no speed": (GRIPPER, "acromonk", r"task\.catch\.speed = 0\.0: must be > 0"),
    "a speed alone": ({"speed": 1.0}, "acromonk", r"task\.catch\.speed = 1\.0: must be left away"),
    "a speed in a cycle": (
        {"reset": "brachiation", "speed": 1.0, **GRIPPER},
        "acromonk_cycle",
        r"task\.catch\.speed = 1\.0: must be left away",
    ),
    "half widths, too": (
        {"speed": 1.0, "half_widths": [1, 1, 1, 1], **GRIPPER},
        "acromonk",
        r"task\.catch\.window = .*: must be left away",
    ),
    "another point": ({"window": {"elbow": 0.03}, "speed": 1.0}, "acromonk", r"task\.catch\.window.*gripper"),
    "no size": (
        {"window": {"gripper": -0.03}, "speed": 1.0},
        "acromonk",
        r"task\.catch\.window = -0\.03: must be >=",
    ),
    "a third joint": (
        {"speed": 1.0, **GRIPPER},
        "ricmonk",
        r"gripper = 0\.03: is no shape of a robot with more than two joints",
    ),
    "no gripper": (
        {"speed": 1.0, **GRIPPER},
        "acrobot",
        r"gripper = 0\.03: needs a robot with arm_length; there is no arm_length",
    ),
}


@pytest.mark.parametrize(("catch", "name", "text"), WRONG.values(), ids=WRONG)
def test_what_is_no_window_is_refused(catch, name, text):
    with pytest.raises(ConfigError, match=text):
        make_problem(experiment(catch, name))


def test_stretched_arms_have_no_window_as_their_shape():
    config = experiment({"speed": 1.0, **GRIPPER})
    straight = config.model_copy(update={"task": config.task.model_copy(update={"goal": (0.5, 0.0, 0.0, 0.0)})})
    with pytest.raises(ConfigError, match="stretched or folded"):
        make_problem(straight)


def test_without_a_window_a_cycle_is_stored_as_before():
    assert experiment({"reset": "brachiation"}, "acromonk_cycle").task.catch.model_dump() == {"reset": "brachiation"}
