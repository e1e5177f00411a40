"""The `tasks` of a configuration: what each has of its own, and what is refused."""

import math

import pytest
import yaml

from rtcd_jax.config import load as configuration
from rtcd_jax.system.errors import ConfigError

TWO = {"left": {"goal": ["-pi", 0]}, "heavy": {"plant": {"mass": "mass + 0.1", "damping": "2*damping"}}}


def experiment(**changes):
    return configuration.parse(yaml.safe_load(configuration.EXAMPLE) | changes)


def test_without_tasks_nothing_of_a_configuration_changes():
    assert "tasks" not in configuration.resolved(experiment())
    assert configuration.config_hash(experiment()) == "699114ffc6eb"  # as it was before there were any


def test_each_task_is_a_configuration_of_its_own():
    left, heavy = (experiment(tasks=TWO).each[name] for name in TWO)
    assert left.task.goal == (-3.141592653589793, 0)
    assert heavy.task == experiment().task
    assert (left.plant.values()["damping"], heavy.plant.values()["damping"]) == (0.1, 0.2)
    assert (left.edits, heavy.edits) == ({}, {"mass": "mass + 0.1"})
    for config in (experiment(tasks=TWO), left, heavy):
        assert configuration.parse_yaml(configuration.dump(config)) == config


def test_one_task_is_as_if_it_stood_in_task():
    one = experiment(tasks={"left": TWO["left"]})
    assert one.task.goal == (-3.141592653589793, 0)
    assert one == one.each["left"]


@pytest.mark.parametrize(
    ("tasks", "line"),
    [
        ({}, "tasks = {}: must name a task at least"),
        (3, "tasks = 3: must be a mapping"),
        ({"a": 3}, "tasks.a = 3: must be a mapping with the keys start, goal, plant"),
        ({"a b": {}}, "tasks.a b: must be a letter and up to 63 letters, digits and _"),
        ({"a": {}, "A": {}}, "tasks.A: differs from a by its case alone"),
        ({"a": {"state_limits": [7, 7]}}, r"tasks.a.state_limits = \[7, 7\]: unknown key; valid: start, goal, plant"),
        ({"a": {"goal": [1]}}, r"tasks.a.goal: must have 2 entries \(theta, theta_dot\), has 1"),
        ({"a": {"goal": [7, 0]}}, "tasks.a.goal.0 = 7.0: must lie between -6.28319 and 6.28319"),
        ({"a": {"goal": [0, 0]}}, r"tasks.a.goal = \(0.0, 0.0\): must differ from task.start"),
        ({"a": {"plant": {"mas": 1}}}, "tasks.a.plant.mas = 1.0: must be a constant or a design .*did you mean 'mass'"),
        ({"a": {"plant": {"mass": "mas"}}}, "tasks.a.plant.mass = 'mas': names mas; there is pi, damping, gravity"),
        ({"a": {"plant": {"damping": "mas"}}}, "tasks.a.plant.damping = 'mas': names mas; there is pi, damping"),
        ({"a": {"plant": {"damping": "0.5 - mass"}}}, "tasks.a.plant.damping = -0.1.*: must be >= 0"),
        ({"a": {"plant": {"damping": -1}}}, "tasks.a.plant.damping = -1.0: must be >= 0"),
        ({"a": {"plant": {"name": 1}}}, "tasks.a.plant.name = 1.0: is the same in all tasks"),
        ({"a": {"plant": {"mass": "2*"}}}, r"tasks.a.plant.mass = '2\*': is no arithmetic"),
    ],
)
def test_what_is_wrong_is_named(tasks, line):
    with pytest.raises(ConfigError, match=f"^configuration: {line}"):
        experiment(tasks=tasks)


def test_several_tasks_are_not_refined():
    with pytest.raises(ConfigError, match=r"search\.refine = True: must be false with several tasks"):
        experiment(tasks=TWO, search={"refine": True})


ARM = {
    "plant": {"name": "acromonk"},
    "design": {
        "arm_length": {"initial": 0.3, "min": 0.25, "max": 0.35},
        "support_mass": {"initial": 1, "min": 1, "max": 1},
        "swing_mass": {"initial": 1, "min": 1, "max": 1},
    },
    "weights": {"q": [{"initial": 1, "min": 0.1, "max": 10}] * 4, "r": [{"initial": 1, "min": 0.1, "max": 10}]},
}


def swing(start="-asin(0.15/arm_length)", goal="asin(0.15/arm_length)", catch=True, **changes):
    task = {"start": [start, 0, 0, 0], "goal": [goal, 0, 0, 0], "state_limits": [2, 2, 10, 10]}
    return experiment(**ARM, task=task | ({"catch": {"half_widths": [0.1] * 4}} if catch else {}), **changes)


def test_ends_may_follow_the_design():
    config = swing()
    assert config.task.start == ("-asin(0.15/arm_length)", 0, 0, 0)
    assert config.initial_ends == ((-math.asin(0.5), 0, 0, 0), (math.asin(0.5), 0, 0, 0))
    assert configuration.parse_yaml(configuration.dump(config)) == config


def test_constants_of_a_task_may_follow_the_design():
    config = swing(
        tasks={"a": {}, "b": {"plant": {"support_center": "arm_length - swing_center", "swing_center": 0.1}}}
    )
    alone = config.each["b"]
    assert alone.plant == config.plant
    assert alone.edits == {"support_center": "arm_length - swing_center", "swing_center": 0.1}
    assert (config.each["a"].follows_design, alone.follows_design) == (True, True)
    assert configuration.parse_yaml(configuration.dump(alone)) == alone


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"start": "-asin(0.15/arm)"}, r"task.start.0 = '-asin.*names arm; there is pi, arm_length, support_mass"),
        ({"start": "-asin(0.31/arm_length)"}, "task.start.0 = .*: has no finite value, at arm_length = 0.3$"),
        ({"start": "-asin(0.26/arm_length)"}, "task.start.0 = .*: has no finite value, at arm_length = 0.25$"),
        ({"goal": "6*arm_length"}, "task.goal.0 = 2.0.*: must lie between -2 and 2 .*, at arm_length = 0.35$"),
        ({"catch": False}, "task.goal.0 = .*: must be a number: only with task.catch a goal follows the design"),
        ({"goal": "-asin(0.15/arm_length)"}, "task.goal = .*: must differ from task.start"),
        ({"tasks": {"a": {"start": ["arm", 0, 0, 0]}}}, "tasks.a.start.0 = 'arm': names arm; there is pi, arm_length"),
        (
            {"tasks": {"a": {"plant": {"swing_inertia": "arm_length - 0.3"}}}},
            "tasks.a.plant.swing_inertia = -0.0.*: must be >= 0",
        ),
    ],
)
def test_ends_that_are_none_are_named(changes, line):
    with pytest.raises(ConfigError, match=f"(?m){line}"):
        swing(**changes)
