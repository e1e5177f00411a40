"""Several tasks as data of the candidates: each is worth what it is worth alone."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from rtcd_jax.config import load as configuration
from rtcd_jax.evaluation import make_evaluate
from rtcd_jax.genome import decode, encode, genome_of_task
from rtcd_jax.problem import make_problem
from rtcd_jax.system.errors import ConfigError
from rtcd_jax.types import Status
from tests import pipeline

HEAVIER = 0.05
TASKS = {
    "right": {},
    "left": {"goal": ["-pi", 0]},
    "heavy": {"plant": {"mass": f"mass + {HEAVIER}"}},
    "strong": {"plant": {"torque_limit": 3, "damping": "2*damping"}},
    "again": {},
}


def experiment(**changes):
    data = yaml.safe_load(configuration.EXAMPLE) | {"funnel": {"rollouts": "closed_form"}}
    return configuration.parse(data | changes)


@cache
def problem():
    return make_problem(experiment(tasks=TASKS))


@cache
def evaluated():
    """The paper's candidates on all tasks, by one program."""
    return jax.device_get(jax.jit(make_evaluate(problem()))(pipeline.genomes(), pipeline.GENERATION))


def of_task(name):
    return jax.tree.map(lambda leaf: leaf[:, list(TASKS).index(name)], evaluated().tasks)


def assert_equal(found, expected, tolerance):
    """Status, iterations, samples, and every number of the funnels that are there."""
    np.testing.assert_array_equal(found.status, expected.status)
    np.testing.assert_array_equal(found.funnel.trials, expected.funnel.trials)
    ok = np.asarray(expected.status) == Status.OK
    assert ok.sum() == 4
    for name, volume in expected.volumes.named.items():
        np.testing.assert_allclose(np.asarray(found.volumes[name])[ok], np.asarray(volume)[ok], rtol=tolerance)
    np.testing.assert_allclose(found.volumes.per_knot, expected.volumes.per_knot, rtol=tolerance)


@pytest.mark.thorough
def test_one_of_several_is_worth_what_it_is_alone():
    """To rounding: alone, start and goal are constants of the program, which its compiler folds."""
    alone = pipeline.evaluated()
    assert_equal(of_task("right"), alone, 1e-12)
    motions = of_task("right").funnel.policy.trajectory, alone.funnel.policy.trajectory
    np.testing.assert_array_equal(*(motion.iterations for motion in motions))


@pytest.mark.thorough
def test_where_a_task_stands_among_the_others_changes_no_bit():
    assert pipeline.same(*(jax.tree.map(np.asarray, each.volumes) for each in (of_task("right"), of_task("again"))))


@pytest.mark.thorough
def test_to_the_left_is_the_mirror_of_to_the_right():
    left, right = of_task("left"), of_task("right")
    assert_equal(left, right, 1e-12)
    np.testing.assert_allclose(left.funnel.policy.trajectory.xs, -right.funnel.policy.trajectory.xs, atol=1e-12)


@pytest.mark.thorough
def test_a_task_with_another_design_is_that_design():
    rows = pipeline.CANDIDATES + np.array([HEAVIER, 0, 0, 0, 0])
    heavier = jnp.asarray([encode(pipeline.problem(), row) for row in rows.tolist()])
    assert_equal(of_task("heavy"), pipeline.evaluate()(heavier, pipeline.GENERATION), 1e-8)


@pytest.mark.slow
def test_a_task_with_other_constants_is_that_robot():
    """The optimizer's inputs are those of the first task's motor: other steps, the same end."""
    alone = make_problem(experiment(plant={"name": "pendulum", "torque_limit": 3.0, "damping": 0.2}))
    expected = jax.device_get(jax.jit(make_evaluate(alone))(pipeline.genomes(), pipeline.GENERATION))
    found = of_task("strong")
    np.testing.assert_array_equal(found.status, expected.status)
    np.testing.assert_allclose(found.volumes["sum"], expected.volumes["sum"], rtol=1e-3)


OWN = {"search": {"share": "design"}, "policy": {"authority": {"initial": 0.5, "min": 0.1, "max": 1}}}


def test_tasks_that_share_the_design_alone_have_weights_and_policy_of_their_own():
    """Of a genome's dimensions a task has the design's and its own: what decodes alone from them."""
    whole = make_problem(experiment(tasks=TASKS, **OWN))
    genome = np.random.default_rng(0).random(2 + len(TASKS) * 4)
    assert len(whole.free) == len(genome)
    seen = set()
    for number, (name, alone) in enumerate(zip(TASKS, whole.tasks, strict=True)):
        found = decode(whole, jnp.asarray(genome), jnp.asarray(number))
        own = genome_of_task(whole, name, genome)
        np.testing.assert_array_equal(own, [*genome[:2], *genome[2 + 4 * number : 6 + 4 * number]])
        expected = decode(alone, jnp.asarray(own))
        for part in ("design", "q", "r", "policy"):
            pairs = zip(*(jax.tree.leaves(getattr(each, part)) for each in (found, expected)), strict=True)
            for a, b in pairs:
                np.testing.assert_array_equal(a, b)
        seen.add(float(found.r[0]))
    assert len(seen) == len(TASKS)


def test_one_task_of_several_that_share_the_design_alone_is_as_ever():
    alone = make_problem(experiment(tasks={"right": {}}, **OWN))
    shared = make_problem(experiment(tasks={"right": {}}, policy=OWN["policy"]))
    assert [variable.name for variable in alone.variables] == [variable.name for variable in shared.variables]


def test_sharing_all_leaves_the_hash_of_a_configuration():
    hash_of = configuration.config_hash
    assert hash_of(experiment(search={"share": "all"})) == hash_of(experiment())
    assert hash_of(experiment(tasks=TASKS, search={"share": "design"})) != hash_of(experiment(tasks=TASKS))


def test_a_candidate_has_the_robot_and_the_ends_of_its_task():
    whole = problem()
    x, u = jnp.array([0.3, -0.2]), jnp.array([0.1])
    for number, alone in enumerate(whole.tasks):
        candidate = decode(whole, pipeline.genomes()[0], jnp.asarray(number))
        own = whole.of(candidate)
        np.testing.assert_array_equal(own.start, alone.start)
        np.testing.assert_array_equal(own.goal, alone.goal)
        np.testing.assert_array_equal(own.input_limits(candidate.design), alone.input_limits(candidate.design))
        expected = alone.plant.dynamics(decode(alone, pipeline.genomes()[0]).design, x, u)
        np.testing.assert_array_equal(own.plant.dynamics(candidate.design, x, u), expected)


@pytest.mark.thorough
def test_tasks_that_differ_in_their_ends_alone_keep_the_robot_s_constants():
    """They are no data then: the motor's limit is a constant of the program."""
    whole = make_problem(experiment(tasks={name: TASKS[name] for name in ("right", "left")}))
    candidate = decode(whole, pipeline.genomes()[0], jnp.asarray(1))
    own = whole.of(candidate)
    assert own.plant is whole.plant
    assert isinstance(own.input_limits(candidate.design), np.ndarray)


def test_one_task_is_a_run_without_tasks():
    """The same program, its numbers constants."""
    alone = make_problem(experiment(tasks={"left": {"goal": ["-pi", 0], "plant": {"damping": 0.2}}}))
    assert alone.tasks == ()
    np.testing.assert_array_equal(alone.goal, [-np.pi, 0])
    assert alone.plant.damping == 0.2
    assert decode(alone, pipeline.genomes()[0]).task is None


@pytest.mark.thorough
def test_over_the_tasks_the_volumes_are_their_mean_and_a_failure_is_the_first_one_s():
    each, over = evaluated().tasks, evaluated()
    for name, volume in over.volumes.named.items():
        with np.errstate(divide="ignore"):
            np.testing.assert_allclose(volume, np.exp(np.log(each.volumes[name]).mean(-1)), rtol=1e-12)
    np.testing.assert_array_equal(over.genome, pipeline.genomes())
    np.testing.assert_array_equal(over.status == Status.OK, (each.status == Status.OK).all(-1))


def test_a_goal_that_is_no_equilibrium_is_told_with_its_task():
    with pytest.raises(ConfigError, match=r"tasks\.left\.goal = \[3\.0, 0\.0\]: is no equilibrium .* did you mean"):
        make_problem(experiment(tasks={"right": {}, "left": {"goal": [3, 0]}}))
