"""The configuration: what is refused, in which words, and that nothing is lost on the way to a file and back."""

import math
import subprocess
import sys

import pytest
import yaml

from rtcd_jax import plants
from rtcd_jax.config.load import (
    EXAMPLE,
    Config,
    config_hash,
    differences,
    dump,
    load,
    parse,
    parse_yaml,
    resolved,
)
from rtcd_jax.config.plants import PLANTS
from rtcd_jax.config.schema import Variable
from rtcd_jax.config.settings import Settings, bounds
from rtcd_jax.system.errors import ConfigError
from tests.paths import CONFIGS

REMOVED = object()


def sections():
    """The models of all sections but the design, by name."""
    fields = ((name, field.annotation) for name, field in Config.model_fields.items())
    return [(name, kind) for name, kind in fields if isinstance(kind, type) and issubclass(kind, Settings)]


def changed(changes):
    """The example as a mapping, with values replaced at dotted keys."""
    data = yaml.safe_load(EXAMPLE)
    for key, value in changes.items():
        *branches, leaf = key.split(".")
        node = data
        for branch in branches:
            node = node[int(branch)] if isinstance(node, list) else node.setdefault(branch, {})
        leaf = int(leaf) if isinstance(node, list) else leaf
        if value is REMOVED:
            del node[leaf]
        else:
            node[leaf] = value
    return data


def errors(changes):
    """The error lines that the changed example gives; none if it is valid."""
    try:
        parse(changed(changes))
    except ConfigError as error:
        return [str(problem) for problem in error.problems]
    return []


VARIABLE = {"initial": 0.5, "min": 0.5, "max": 0.5}

WALL = {"normal": [0, 1], "offset": 5}
BALL = {"center": [0, 5], "semi_axes": [1, 1]}
REFUSED = {
    "misspelt section": ({"serch": {}}, "serch = {}: unknown key; did you mean 'search'? Valid: plant, task"),
    "misspelt key": (
        {"search.populaton": 8},
        "search.populaton = 8: unknown key; did you mean 'population'? Valid: objective, at_least, mode, population",
    ),
    "misspelt plant key": ({"plant.gravty": 1}, "plant.gravty = 1: unknown key; did you mean 'gravity'?"),
    "unlike any key": ({"elites.xyz": 8}, "elites.xyz = 8: unknown key; valid: count, distance, trials, directions"),
    "misspelt plant": ({"plant.name": "pendulm"}, "plant.name = 'pendulm': unknown plant; did you mean 'pendulum'?"),
    "plant is no name": ({"plant.name": 3}, "plant.name = 3: unknown plant; valid: acrobot"),
    "plant without a name": (
        {"plant": {}},
        "plant = {}: must be a mapping with a `name`, or with `mjcf: FILE`; valid names: acrobot",
    ),
    "plant is no mapping": ({"plant": "pendulum"}, "plant = 'pendulum': must be a mapping with a `name`"),
    "misspelt objective": (
        {"search.objective": "inlets"},
        "search.objective = 'inlets': unknown name; did you mean 'inlet'? Valid: sum, integral, inlet",
    ),
    "misspelt demand": (
        {"search.at_least": {"puhs": 0.1}},
        "search.at_least.puhs: must be a volume; did you mean 'push'? Valid: sum, integral, inlet",
    ),
    "demand of nothing": ({"search.at_least": {"push": 0.0}}, "search.at_least.push = 0.0: must be > 0 and <= 1e+12"),
    "misspelt mode": ({"search.mode": "nest"}, "search.mode = 'nest': unknown name; did you mean 'nested'?"),
    "misspelt rollouts": ({"funnel.rollouts": "mjc"}, "funnel.rollouts = 'mjc': unknown name; did you mean 'mjx'?"),
    "missing section": ({"task": REMOVED}, "task: is missing; from where to where, and within what"),
    "missing key": ({"design.mass.min": REMOVED}, "design.mass.min: is missing; lower end of the box"),
    "empty section": ({"funnel": None}, "funnel = None: must be a mapping with the keys rollouts, mjx_share"),
    "text for a number": ({"plant.damping": "0.1"}, "plant.damping = '0.1': must be a number; viscous friction"),
    "boolean for a number": ({"plant.damping": True}, "plant.damping = True: must be a number"),
    "fraction for a count": ({"search.population": 8.5}, "search.population = 8.5: must be a whole number"),
    "boolean for a count": ({"search.population": True}, "search.population = True: must be a whole number"),
    "number for a boolean": ({"design.mass.pinned": 1}, "design.mass.pinned = 1: must be true or false"),
    "number for a list": ({"task.start": 0}, "task.start = 0: must be a list"),
    "text in a list": ({"task.start.1": "0"}, "task.start.1 = '0': must be a number"),
    "number for a mapping": ({"design": 1}, "design = 1: must be a mapping"),
    "number for a variable": ({"weights.q.0": 1}, "weights.q.0 = 1: must be a mapping with the keys initial, min, max"),
    "not a number": ({"plant.gravity": math.nan}, "plant.gravity = nan: must be"),
    "infinite": ({"design.mass.max": math.inf}, "design.mass.max = inf: must be finite"),
    "limit is not a number": ({"task.state_limits.0": math.nan}, "task.state_limits.0 = nan: must be >= 1e-06"),
    "crossed box": ({"design.mass.min": 0.9}, "design.mass.min = 0.9: must be <= max = 0.8"),
    "crossed step": ({"trajectory.step.min": 0.2}, "trajectory.step.min = 0.2: must be <= max = 0.1; equal ones fix"),
    "start outside": ({"task.start.1": 7.5}, "task.start.1 = 7.5: must lie between -7 and 7 (task.state_limits)"),
    "goal outside": ({"task.goal.0": -6.5}, "task.goal.0 = -6.5: must lie between -6.28319 and 6.28319"),
    "goal on a limit": (
        {"task.state_limits.0": math.pi},
        "task.goal.0 = 3.141592653589793: must lie between -3.14159 and 3.14159 (task.state_limits): on a limit there",
    ),
    "start beyond the motion's share": (
        {"task.start.1": 6.5, "trajectory.limit_share": 0.9},
        "task.start.1 = 6.5: must lie in [-6.3, 6.3] (trajectory.limit_share of the limit)",
    ),
    "endless rollouts": (
        {"funnel.goal": {"horizon": 1000, "step": 1e-6}},
        "funnel.goal.step = 1e-06: must be >= horizon / 100000 = 0.01",
    ),
    "huge limit": ({"task.state_limits.0": 1e308}, "task.state_limits.0 = 1e+308: must be <= 1e+06, or .inf for none"),
    "a set of no kind": (
        {"task.keep_out": [{"normal": [0, 1]}]},
        "task.keep_out.0: must have the keys normal and offset of a half space, or center and semi_axes of an "
        "ellipsoid; has normal",
    ),
    "a set of both kinds": (
        {"task.keep_out": [{**WALL, "center": [0, 5], "semi_axes": [1, 1]}]},
        "task.keep_out.0: must have the keys normal and offset of a half space, or center and semi_axes",
    ),
    "a set's unknown key": (
        {"task.keep_out": [WALL, {"radius": 1}]},
        "task.keep_out.1.radius = 1: unknown key; valid: normal, offset, center, semi_axes",
    ),
    "no normal": ({"task.keep_out": [WALL | {"normal": [0, 0]}]}, "task.keep_out.0.normal = (0.0, 0.0): must not be"),
    "short normal": (
        {"task.keep_out": [WALL | {"normal": [1]}]},
        "task.keep_out.0.normal: must have 2 entries (theta, theta_dot), has 1",
    ),
    "infinite normal": ({"task.keep_out": [WALL | {"normal": [math.inf, 1]}]}, "task.keep_out.0.normal.0 = inf: must"),
    "infinite offset": (
        {"task.keep_out": [WALL | {"offset": math.inf}]},
        "task.keep_out.0.offset = inf: must be >= -1",
    ),
    "offset in words": ({"task.keep_out": [WALL | {"offset": "far"}]}, "task.keep_out.0.offset = 'far': "),
    "negative semi axis": (
        {"task.keep_out": [BALL | {"semi_axes": [1, -1]}]},
        "task.keep_out.0.semi_axes.1 = -1: must be >= 1e-06; ellipsoid: half its width in every state",
    ),
    "semi axis is not a number": (
        {"task.keep_out": [BALL | {"semi_axes": [1, math.nan]}]},
        "task.keep_out.0.semi_axes",
    ),
    "huge semi axis": ({"task.keep_out": [BALL | {"semi_axes": [1, 1e7]}]}, "task.keep_out.0.semi_axes.1 = 10000000.0"),
    "no end in any state": (
        {"task.keep_out": [BALL | {"semi_axes": [math.inf, math.inf]}]},
        "task.keep_out.0.semi_axes = (inf, inf): must have an entry that is not .inf: nothing would be left",
    ),
    "long center": (
        {"task.keep_out": [BALL | {"center": [0, 5, 0]}]},
        "task.keep_out.0.center: must have 2 entries (theta, theta_dot), has 3",
    ),
    "start in a half space": (
        {"task.keep_out": [{"normal": [-1, 0], "offset": -1}]},
        "task.start = (0.0, 0.0): must lie outside of task.keep_out.0, and not on its boundary",
    ),
    "goal on a half space's boundary": (
        {"task.keep_out": [{"normal": [1, 0], "offset": math.pi}]},
        "task.goal = (3.141592653589793, 0.0): must lie outside of task.keep_out.0, and not on its boundary",
    ),
    "goal in an ellipsoid": (
        {"task.keep_out": [BALL | {"center": [3, 5], "semi_axes": [1, 6]}]},
        "task.goal = (3.141592653589793, 0.0): must lie outside of task.keep_out.0, and not on its boundary",
    ),
    "goal in an ellipsoid for the motion": (
        {"task.keep_out": [BALL | {"center": [math.pi, 2], "semi_axes": [1, 1.9]}], "trajectory.limit_share": 0.9},
        "task.goal = (3.141592653589793, 0.0): must lie outside of task.keep_out.0, grown by 1 / traj",
    ),
    "huge start": ({"task.start.0": 1e7}, "task.start.0 = 10000000.0: must be >= -1e+06 and <= 1e+06; first state"),
    "no motion": ({"task.goal": [0, 0]}, "task.goal = (0.0, 0.0): must differ from task.start, unless"),
    "short start": ({"task.start": [0]}, "task.start: must have 2 entries (theta, theta_dot), has 1"),
    "long goal": ({"task.goal": [3, 0, 0]}, "task.goal: must have 2 entries (theta, theta_dot), has 3"),
    "short limits": ({"task.state_limits": [7]}, "task.state_limits: must have 2 entries (theta, theta_dot), has 1"),
    "short q": ({"weights.q.1": REMOVED}, "weights.q: must have 2 entries (theta, theta_dot), has 1"),
    "empty r": ({"weights.r": []}, "weights.r: must have 1 entry (torque), has 0"),
    "missing design field": ({"design.mass": REMOVED}, "design.mass: is missing; pendulum's design is mass, length"),
    "misspelt design field": (
        {"design.lenght": VARIABLE},
        "design.lenght: unknown design field of pendulum; did you mean 'length'? Valid: mass, length",
    ),
    "zero design": ({"design.mass.min": 0}, "design.mass.min = 0.0: must be >= 1e-06: masses and lengths are positive"),
    "text for an option": (
        {"policy.authority": "x"},
        "policy.authority = 'x': must be a number, or a mapping with the",
    ),
    "boolean for an option": ({"policy.discount": True}, "policy.discount = True: must be a number, or a mapping with"),
    "half a searched option": ({"policy.discount": {"min": 0, "max": 1}}, "policy.discount.initial: is missing; value"),
    "crossed option": (
        {"policy.authority": {"initial": 0.5, "min": 0.5, "max": 0.1}},
        "policy.authority.min = 0.5: must be <= max = 0.1",
    ),
    "zero weight": ({"weights.q.0.min": 0}, "weights.q.0.min = 0.0: must be >= 1e-09: weights have a log scale"),
    "mixed without a share": (
        {"funnel.rollouts": "mixed", "funnel.mjx_share": 0},
        "funnel.mjx_share = 0.0: must be > 0 when rollouts = 'mixed', or choose 'closed_form'",
    ),
    "goal's step": ({"funnel.goal.step": 8}, "funnel.goal.step = 8.0: must be < horizon = 2"),
    "indivisible population": (
        {"search": {"mode": "nested", "population": 100}},
        "search.population = 100: must be a multiple of nested.designs = 8",
    ),
    "small inner population": (
        {"search": {"mode": "nested", "population": 24}},
        "search.population = 24: must be >= 32 for nested.designs = 8",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_in_these_words(case):
    changes, words = REFUSED[case]
    (line,) = errors(changes)
    assert line.startswith(words)


# Dotted key, an accepted value at the end of its range, a refused one beyond it.
ENDS = [
    ("plant.damping", 0, -1e-9),
    ("plant.damping", 1e6, 1.1e6),
    ("plant.gravity", 1e-6, 0),
    ("plant.gravity", 1e6, 1e308),
    ("plant.torque_limit", 1e-6, 5e-324),
    ("plant.torque_limit", 1e6, 1.1e6),
    ("task.state_limits.1", 1e-6, 1e-7),
    ("task.state_limits.1", 1e6, 1.1e6),
    ("task.start.1", math.nextafter(7, 0), 7),
    ("task.start.1", math.nextafter(-7, 0), -7),
    ("design.mass.initial", 0.6, math.nextafter(0.6, 0)),
    ("design.mass.initial", 0.8, math.nextafter(0.8, 1)),
    ("design.mass.min", 1e-6, 5e-324),
    ("design.mass.max", 1e9, 1e308),
    ("weights.r.0.min", 1e-9, 5e-324),
    ("weights.r.0.max", 1e9, 1.7e308),
    ("trajectory.knots", 3, 2),
    ("trajectory.knots", 10_000, 10_001),
    ("trajectory.step.min", 1e-6, 1e-7),
    ("trajectory.step.min", 0.1, math.nextafter(0.1, 1)),
    ("trajectory.step.max", 1000, 1e308),
    ("trajectory.time_weight", 0, -1e-9),
    ("trajectory.time_weight", 1e6, 1e308),
    ("trajectory.substeps", 1, 0),
    ("trajectory.substeps", 1000, 10**19),
    ("trajectory.max_iterations", 1, 0),
    ("trajectory.max_iterations", 100_000, 100_001),
    ("trajectory.starts", 1, 0),
    ("trajectory.starts", 2, 3),
    ("trajectory.limit_share", 0.6, 5e-324),
    ("trajectory.limit_share", 1, 1.01),
    ("trajectory.input_share", 0.8, 0),
    ("trajectory.input_share", 1, 1.01),
    ("funnel.mjx_share", 1, 1.001),
    ("funnel.mjx_share", 1e-9, 0),
    ("funnel.directions", 1, 0),
    ("funnel.directions", 100_000, 10**19),
    ("funnel.climbers", 2, 1),
    ("funnel.climbers", 10_000, 10_001),
    ("funnel.climbs", 0, -1),
    ("funnel.climbs", 1000, 1001),
    ("funnel.steps", 1, 0),
    ("funnel.steps", 1000, 1001),
    ("funnel.trials", 1, 0),
    ("funnel.trials", 1_000_000, 10**19),
    ("funnel.confidence", 1e-9, 0),
    ("funnel.confidence", 0.999999, 1),
    ("funnel.goal.directions", 1, 0),
    ("funnel.goal.directions", 100_000, 100_001),
    ("funnel.goal.radii", 3, 2),
    ("funnel.goal.radii", 1000, 1001),
    ("funnel.goal.rounds", 1, 0),
    ("funnel.goal.rounds", 20, 21),
    ("funnel.goal.horizon", 0.03, 0.02),
    ("funnel.goal.horizon", 1000, 1e308),
    ("funnel.goal.step", 2.1e-5, 1.9e-5),
    ("search.population", 4, 3),
    ("search.population", 2**20, 10**19),
    ("search.generations", 1, 0),
    ("search.generations", 1_000_000, 1_000_001),
    ("search.sigma", 1e-6, 5e-324),
    ("search.sigma", 1, 1.001),
    ("search.seed", 0, -1),
    ("search.seed", 2**32 - 1, 2**32),
    ("search.chunk", 1, 0),
    ("search.chunk", 2**20, 2**20 + 1),
    ("search.nested.designs", 4, 3),
    ("search.nested.designs", 2**20, 2**20 + 1),
    ("search.nested.generations", 1, 0),
    ("search.nested.generations", 1_000_000, 1_000_001),
    ("elites.count", 1, 0),
    ("elites.count", 10_000, 10_001),
    ("elites.distance", 0, -1e-9),
    ("elites.distance", 0.999, 1),
    ("elites.trials", 1, 0),
    ("elites.trials", 10**8, 10**19),
    ("elites.mjx_states", 0, -1),
    ("elites.mjx_states", 10**8, 10**19),
    ("elites.keys", 0, -1),
    ("elites.keys", 1000, 1001),
    ("elites.directions", 1, 0),
    ("elites.directions", 1_000_000, 1_000_001),
    ("checkpoint.seconds", 0, -1e-9),
    ("checkpoint.seconds", 1e6, 1e308),
    ("policy.input_weight", 1e-9, 0),
    ("policy.input_weight", 1e9, 1e308),
    ("policy.input_weight", {"initial": 1, "min": 1e-9, "max": 1}, {"initial": 1, "min": 0, "max": 1}),
    ("policy.authority", 1, 1.001),
    ("policy.authority", 1e-6, 0),
    ("policy.authority", {"initial": 1, "min": 1e-6, "max": 1}, {"initial": 1, "min": 0, "max": 1}),
    ("policy.authority", {"initial": 1, "min": 0.1, "max": 1}, {"initial": 1, "min": 0.1, "max": 1.001}),
    ("policy.discount", 0, -1e-9),
    ("policy.discount", 1000, math.inf),
    ("policy.discount", 1000, math.nan),
    ("uncertainty.design", {"mass": 0}, {"mass": -0.01}),
    ("uncertainty.design", {"mass": 0.99}, {"mass": 1}),
    ("uncertainty.design", {"length": 0.1}, {"lenght": 0.1}),
    ("uncertainty.plant", {"damping": 0.2}, {"torque_limit": 0.2}),
    ("uncertainty.input_limit", 0, -0.01),
    ("uncertainty.input_limit", 0.99, 1),
    ("uncertainty.input", 0, -1e-9),
    ("uncertainty.input", 1e9, math.inf),
    ("uncertainty.noise", [0.1, 0.2], [0.1]),
    ("uncertainty.noise", [0, 0], [0, -1]),
    ("uncertainty.age", 0, -1e-9),
    ("uncertainty.age", 10, 1e308),
    ("uncertainty.residual", 0.01, 0),
    ("uncertainty.residual", 0.99, 1),
    ("policy.discount", {"initial": 0, "min": 0, "max": 1}, {"initial": 0, "min": -1, "max": 1}),
]


def numbers(model, prefix=""):
    """The dotted keys of all numbers below a section."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Settings):
            yield from numbers(field.annotation, f"{prefix}{name}.")
        elif field.annotation in (int, float):
            yield f"{prefix}{name}", field


@pytest.mark.parametrize("model", [*(model for name, model in sections() if name != "plant"), *PLANTS.values()])
def test_every_number_has_both_ends(model):
    ends = {key: bounds(field) for key, field in numbers(model)}
    assert [key for key, limits in ends.items() if not (">" in limits and "<" in limits)] == []


@pytest.mark.parametrize(("key", "inside", "outside"), ENDS)
def test_both_sides_of_every_range(key, inside, outside):
    needs = {"task.state_limits.1": {"task.start": [0.5, 0]}, "funnel.mjx_share": {"funnel.rollouts": "mixed"}}
    changes = needs.get(key, {})
    assert errors(changes | {key: inside}) == []
    (line,) = errors(changes | {key: outside})
    assert "must" in line


def test_a_number_or_a_name():
    assert parse(changed({"search.chunk": "auto"})).search.chunk == "auto"
    (line,) = errors({"search.chunk": "most"})
    assert line.startswith("search.chunk = 'most': must be >= 1 and <= 1048576, or 'auto'; candidates")


def test_nested_population_from_its_smallest():
    assert errors({"search": {"mode": "nested", "population": 32}}) == []
    assert errors({"search": {"mode": "joint", "population": 100}}) == []


def test_a_closed_form_funnel_needs_no_share():
    assert errors({"funnel": {"rollouts": "closed_form", "mjx_share": 0}}) == []


def test_infinite_limits_are_no_limits():
    assert parse(changed({"task.state_limits": [math.inf, 7]})).task.state_limits == (math.inf, 7)


AS_OPTIONS = {"normal": [0, 1], "offset": 2 * math.pi, "center": [], "semi_axes": []}
"""Of a command, which has one for every key."""


def test_sets_to_keep_out_of_are_read_written_and_counted():
    """Arithmetic and .inf, and half spaces beside ellipsoids; without them nothing is written of them."""
    stated = [WALL | {"offset": "2*pi"}, BALL | {"semi_axes": [math.inf, 2]}]
    config = parse(changed({"task.keep_out": stated}))
    half, ellipsoid = config.task.keep_out
    assert (half.normal, half.offset) == ((0, 1), 2 * math.pi)
    assert (ellipsoid.center, ellipsoid.semi_axes) == ((0, 5), (math.inf, 2))
    assert parse_yaml(dump(config)) == config
    assert parse(changed({"task.keep_out": [AS_OPTIONS, {**stated[1], "normal": [], "offset": None}]})) == config
    plain = parse(changed({}))
    assert "keep_out" not in dump(plain)
    assert config_hash(parse(changed({"task.keep_out": []}))) == config_hash(plain) != config_hash(config)


def pinned(*keys):
    return {f"{key}.pinned": True for key in keys}


DESIGN = ("design.mass", "design.length")
WEIGHTS = ("weights.q.0", "weights.q.1", "weights.r.0")


def test_something_must_be_free():
    assert errors(pinned(*DESIGN, *WEIGHTS[1:])) == []
    (line,) = errors(pinned(*DESIGN, *WEIGHTS))
    assert line == "the configuration: nothing to search: every variable is pinned or has min = max"


def test_a_box_without_width_is_not_free():
    width = {"weights.r.0": {"initial": 1, "min": 1, "max": 1}}
    (line,) = errors(pinned(*DESIGN, *WEIGHTS[:2]) | width)
    assert "nothing to search" in line


@pytest.mark.parametrize("held", [DESIGN, WEIGHTS])
def test_nested_needs_both_loops(held):
    nested = {"search.mode": "nested"}
    assert errors(nested | pinned(*held[1:])) == []
    (line,) = errors(nested | pinned(*held))
    assert line == "search.mode = 'nested': needs a free design variable and a free weight; use 'joint'"


def test_all_errors_at_once_within_and_between_sections():
    changes = {
        "serch": {},
        "funnel.confidence": 2,
        "search.population": "many",
        "search.objectve": "sum",
        "task.start": [0],
        "weights.r.0.min": 0,
        "design.mas": VARIABLE,
    }
    lines = errors(changes)
    assert {line.split(" =")[0].split(":")[0] for line in lines} == changes.keys()
    with pytest.raises(ConfigError, match=r"^here: 7 errors\n  "):
        parse(changed(changes), "here")


def test_no_mapping_at_all():
    with pytest.raises(ConfigError, match="the configuration = None: must be a mapping with the keys plant, task"):
        parse_yaml("")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("plant: {", "no valid YAML: line 1, column 9: expected the node content"),
        ("plant: 1\nplant: 2", "no valid YAML: line 2, column 1: the key 'plant' is given twice"),
        ("plant: \x00", "no valid YAML: unacceptable character"),
        ("[1]: 2\n[1]: 2", "no valid YAML: line 1, column 1: a key must be a text"),
    ],
)
def test_no_yaml(text, words):
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, "x.yaml")
    assert str(caught.value).startswith(f"x.yaml: {words}")


def test_exponent_without_a_dot_is_a_number():
    assert parse_yaml(EXAMPLE.replace("0.001", "1e-3")) == parse_yaml(EXAMPLE)


def test_missing_file_names_its_neighbours(tmp_path):
    with pytest.raises(ConfigError, match=r"no such file; did you mean '.*pendulum_rtcd.yaml'\? Valid: "):
        load(CONFIGS / "pendulum_rtcdd.yaml")
    with pytest.raises(ConfigError, match=r"no such file; .* has no YAML file"):
        load(tmp_path / "x.yaml")


def test_file_that_is_no_text(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_bytes(b"\xff\xfe\xfa")
    with pytest.raises(ConfigError, match="no valid YAML: "):
        load(path)


def shipped():
    """Those of one run; sweep.yaml is read in test_sweep.py."""
    return sorted(path for path in CONFIGS.glob("*.yaml") if path.stem != "sweep")


@pytest.mark.parametrize("path", shipped(), ids=lambda path: path.stem)
def test_shipped_configurations_survive_the_round_trip(path):
    config = load(path)
    assert parse_yaml(dump(config)) == config
    assert parse(config.model_dump()) == config


def test_infinity_survives_the_round_trip():
    config = parse(changed({"task.state_limits": [math.inf, 7]}))
    assert parse_yaml(dump(config)) == config
    assert config_hash(config) != config_hash(parse_yaml(EXAMPLE))


def test_the_hash_ignores_spelling_and_sees_values():
    config = parse_yaml(EXAMPLE)
    assert config_hash(parse(changed({"search.population": 128}))) == config_hash(config)
    assert config_hash(parse(changed({"design.mass.initial": 0.7, "weights.q.0.max": 10.0}))) == config_hash(config)
    reordered = changed({})
    reordered["design"] = dict(reversed(reordered["design"].items()))
    assert config_hash(parse(reordered)) == config_hash(config)
    assert config_hash(parse(changed({"plant.damping": math.nextafter(0.1, 1)}))) != config_hash(config)


def test_keys_that_came_later_leave_the_hash_of_those_who_do_not_use_them():
    """Stored runs carry their hash."""
    assert config_hash(parse_yaml(EXAMPLE)) == "699114ffc6eb"
    for change in {"search.at_least": {"push": 0.1}}, {"trajectory.input_share": 0.9}, {"uncertainty": {"age": 0.1}}:
        assert config_hash(parse(changed(change))) != "699114ffc6eb"


def test_differences_are_exactly_the_changes():
    old, new = parse_yaml(EXAMPLE), parse(changed({"search.seed": 1, "weights.q.1.max": 5, "task.start.0": 0.1}))
    assert differences(old, old) == {}
    assert differences(old, new) == {"search.seed": (0, 1), "weights.q.1.max": (10.0, 5.0), "task.start.0": (0.0, 0.1)}


def test_variables_come_in_the_plants_order_whatever_the_files():
    data = changed({})
    data["design"] = dict(reversed(data["design"].items()))
    assert list(parse(data).variables()) == [*DESIGN, *WEIGHTS]
    assert list(parse(data).design) == ["mass", "length"]


SEARCHED = {"initial": 0.3, "min": 0.05, "max": 1}


def test_a_policy_s_option_is_a_number_or_a_variable():
    fixed, searched = parse(changed({"policy.authority": 0.3})), parse(changed({"policy.authority": SEARCHED}))
    assert fixed.policy.variables() == {}
    assert fixed.policy.initial() == searched.policy.initial() == parse(resolved(searched)).policy.initial()
    assert searched.policy.initial() == {"input_weight": 1.0, "authority": 0.3, "discount": 0.0}
    assert list(searched.variables()) == [*DESIGN, *WEIGHTS, "policy.authority"]
    assert parse_yaml(dump(searched)) == searched


def test_a_searched_option_is_enough_to_search():
    pinned = {f"{key}.pinned": True for key in (*DESIGN, *WEIGHTS)}
    assert errors(pinned) == ["the configuration: nothing to search: every variable is pinned or has min = max"]
    assert errors({**pinned, "policy.discount": {"initial": 0, "min": 0, "max": 1}}) == []


def test_free_means_movable():
    assert Variable(initial=1, min=0, max=1).free
    assert not Variable(initial=1, min=0, max=1, pinned=True).free
    assert not Variable(initial=1, min=1, max=1).free


def test_the_example_is_the_shipped_problem():
    keys = differences(parse_yaml(EXAMPLE), load(CONFIGS / "pendulum_rtcd.yaml"))
    assert keys == {}


def test_the_shipped_problems_differ_only_in_their_design_boxes():
    rtcd = load(CONFIGS / "pendulum_rtcd.yaml")
    pins = {f"{key}.pinned": (False, True) for key in DESIGN}
    assert differences(rtcd, load(CONFIGS / "pendulum_rtc.yaml")) == pins
    assert differences(rtcd, load(CONFIGS / "pendulum_underactuated.yaml")) == {"design.mass.min": (0.6, 0.7)}


def test_the_underactuated_box_holds_no_motor_that_can_lift_the_bob():
    config = load(CONFIGS / "pendulum_underactuated.yaml")
    lightest = config.design["mass"].min * config.design["length"].min * config.plant.gravity
    assert lightest > config.plant.torque_limit


@pytest.mark.parametrize("name", PLANTS)
def test_plants_are_described_as_they_are(name):
    described = PLANTS[name]()
    plant = plants.make_plant(described, {})
    assert tuple(described.states.items()) == tuple(zip(plant.state_names, plant.state_units, strict=True))
    assert tuple(described.input_units.items()) == tuple(zip(plant.input_names, plant.input_units, strict=True))
    assert described.design == dict(plant.design_units)
    assert vars(plant) == described.values()


def leaves(model):
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and hasattr(field.annotation, "model_fields"):
            yield from leaves(field.annotation)
        else:
            yield f"{model.__name__}.{name}", field


@pytest.mark.parametrize("model", [Config, Variable, *PLANTS.values()])
def test_every_number_has_a_unit(model):
    numbers = [(key, field) for key, field in leaves(model) if field.annotation in (int, float)]
    assert numbers
    assert [key for key, field in numbers if "[" not in field.description] == []


def test_reading_a_configuration_imports_no_jax():
    code = "import sys; from rtcd_jax.config.load import *; parse_yaml(EXAMPLE); sys.exit('jax' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_frozen():
    with pytest.raises(ValueError, match="frozen"):
        parse_yaml(EXAMPLE).search.seed = 1
