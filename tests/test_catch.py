"""Motions that end in a catch set: known levels, and no time after the last knot anywhere."""

import dataclasses
import json
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import yaml

from rtcd_jax import rollout
from rtcd_jax.analysis.disturb import disturb_run
from rtcd_jax.analysis.replay.replay import replay_run
from rtcd_jax.analysis.report.motion import boundary_motions
from rtcd_jax.certificate import check
from rtcd_jax.certificate.prove.run import certify_run
from rtcd_jax.certificate.standing import standing
from rtcd_jax.config import load as configuration
from rtcd_jax.elite.closed_loop import ClosedLoop, runge_kutta, simulate
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import mark_of, write_elite
from rtcd_jax.elite.simulators import dynamics_of
from rtcd_jax.evaluation import make_evaluate
from rtcd_jax.export import export_run
from rtcd_jax.funnel import MARGIN, estimate_funnel
from rtcd_jax.genome import decode, initial_genome
from rtcd_jax.numerics.keep_out import sets_of
from rtcd_jax.policy import stabilize
from rtcd_jax.problem import make_problem
from rtcd_jax.run.dry import understood
from rtcd_jax.run.format import arrays_of, record_of
from rtcd_jax.run.refine import refine_run
from rtcd_jax.system.console import silent
from rtcd_jax.system.errors import ConfigError, UserError
from rtcd_jax.system.files import replace, replace_json
from rtcd_jax.types import Status
from rtcd_jax.validation import Dynamics, SamplingBudget
from tests import linear_system as linear
from tests.consoles import Output

WEIGHT = 0.07
STEERED = linear.policy([3.0, -2.0, 1.0, -4.0, 2.0, 0.5, -1.0, 2.0, -3.0, 1.0], 0.05)


def _candidate():
    return dataclasses.replace(linear.candidate(), policy={"catch_weight": jnp.asarray(WEIGHT)})


def _linear(limits, goal_horizon=2.0, keep_out=()):
    """The linear robot whose catch set has the shape of its LQR: gains and shapes are then constant."""
    problem = linear.problem_of(limits, goal={"horizon": goal_horizon})
    return dataclasses.replace(problem, catch=linear.S / WEIGHT, keep_out=sets_of(keep_out, np.zeros((2, 2))))


def _funnel(problem, policy=STEERED):
    physics = rollout.closed_form(problem.plant)
    budget = SamplingBudget(problem.config.funnel, Dynamics(physics, physics), rounds=3, samples_per_knot=64)
    estimate = partial(estimate_funnel, problem, _candidate(), budget=budget)
    return jax.jit(estimate)(policy, jax.random.key(0))


# ---- a linear robot


@pytest.mark.thorough
def test_the_funnel_is_that_of_linear_algebra_from_the_catch_set_backward():
    funnel = _funnel(_linear([1e6, 1e6]))
    expected = linear.levels(STEERED, [1e6, 1e6], WEIGHT, checks=8, margin=MARGIN)
    np.testing.assert_allclose(funnel.levels, expected, rtol=1e-3)
    assert funnel.levels[-1] == WEIGHT
    assert funnel.status == Status.OK
    assert np.all(funnel.trials == 64)


@pytest.mark.thorough
def test_what_happens_after_the_catch_is_not_looked_at():
    """A last gain that holds no goal leaves the last level and all trials; about a goal nothing would be left."""
    unheld = eqx.tree_at(lambda policy: policy.gains, STEERED, STEERED.gains.at[-1].set(0))
    problem = _linear([1e6, 1e6])
    funnel = _funnel(problem, unheld)
    assert funnel.status == Status.OK
    assert funnel.levels[-1] == WEIGHT
    assert np.all(funnel.trials == 64)
    other = _funnel(_linear([1e6, 1e6], goal_horizon=0.1), unheld)
    np.testing.assert_array_equal(funnel.levels, other.levels)
    held = _funnel(dataclasses.replace(problem, catch=None), unheld)
    assert held.status == Status.FUNNEL_EMPTY


@pytest.mark.thorough
def test_a_catch_set_that_reaches_into_what_is_kept_out_shrinks():
    within = {"normal": [1, 0], "offset": 0.05}
    touching = 0.05**2 / np.linalg.inv(linear.S)[0, 0]
    assert touching < WEIGHT
    assert _funnel(_linear([1e6, 1e6], keep_out=[within])).levels[-1] == pytest.approx(touching)
    assert _funnel(_linear([0.05, 1e6])).levels[-1] == pytest.approx(touching)


def test_values_solve_the_riccati_equation_from_the_catch_set_backward():
    """S = Y X^-1 with the Hamiltonian flow from (I, weight C) at t_N, for a C that is no LQR's."""
    shape = np.diag([9.0, 0.25])
    problem = dataclasses.replace(_linear([1e6, 1e6]), catch=shape)
    policy = stabilize(problem, _candidate(), STEERED.trajectory)
    r = linear.B @ np.linalg.solve(linear.R, linear.B.T)
    hamiltonian = np.block([[linear.A, -r], [-linear.Q, -linear.A.T]])
    times = float(STEERED.trajectory.dt) * (np.arange(len(policy.values)) - len(policy.values) + 1)
    for time, value, gain in zip(times, policy.values, policy.gains, strict=True):
        flow = scipy.linalg.expm(hamiltonian * time) @ np.vstack([np.eye(2), WEIGHT * shape])
        expected = flow[2:] @ np.linalg.inv(flow[:2])
        np.testing.assert_allclose(value, expected, rtol=1e-6)
        np.testing.assert_allclose(gain, np.linalg.solve(linear.R, linear.B.T @ expected), rtol=1e-6)


# ---- a pendulum that is caught at its side, at speed

CAUGHT = {
    "task": {"start": [0, 0], "goal": [2, 2], "state_limits": ["2*pi", 7], "catch": {"half_widths": [0.2, 1]}},
    "policy": {"catch_weight": {"initial": 1, "min": 0.1, "max": 10}},
    "funnel": {"rollouts": "closed_form"},
    "trajectory": {"knots": 21, "step": {"min": 0.02, "max": 0.2}},
}


def experiment(**changes):
    data = yaml.safe_load(configuration.EXAMPLE) | CAUGHT
    for section, keys in changes.items():
        data[section] = data.get(section, {}) | keys
    return configuration.parse(data)


@cache
def problem():
    return make_problem(experiment())


@cache
def evaluated():
    one = jax.jit(make_evaluate(problem()))(jnp.asarray(initial_genome(problem()))[None], jax.random.key(0))
    return jax.tree.map(lambda leaf: leaf[0], one)


@cache
def stored():
    record = record_of(problem(), evaluated())
    return arrays_of(problem(), evaluated()), json.loads(json.dumps(record, default=lambda x: np.asarray(x).tolist()))


@cache
def elite():
    return Elite.of(*stored())


def test_a_goal_that_is_no_equilibrium_is_refused_without_a_catch_set_alone():
    assert problem().catch.tolist() == [[pytest.approx(25), 0], [0, 1]]
    assert any(line.startswith("catch ") and "theta ± 0.2 rad" in line for line in understood(problem()))
    data = configuration.resolved(experiment())
    del data["task"]["catch"], data["policy"]["catch_weight"]
    with pytest.raises(ConfigError, match=r"task\.goal = \[2\.0, 2\.0\]: is no equilibrium"):
        make_problem(configuration.parse(data))


def test_the_catch_weight_is_searched_like_the_policy_s_options():
    assert "policy.catch_weight" in [variable.name for variable in problem().free]
    genome = initial_genome(problem())
    genome[-1] = 1.0
    assert decode(problem(), jnp.asarray(genome)).policy["catch_weight"] == pytest.approx(10)


@pytest.mark.thorough
def test_the_last_ellipsoid_is_the_catch_set_for_every_weight():
    one = evaluated()
    assert one.status == Status.OK
    np.testing.assert_allclose(one.funnel.policy.values[-1] / one.funnel.levels[-1], problem().catch, rtol=1e-14)
    assert one.volumes["goal"] == pytest.approx(np.pi * 0.2 * 1)


@pytest.mark.thorough
def test_held_out_motions_end_in_the_catch_set_and_are_followed_no_further():
    """From all ellipsoids none misses, from wider ones many do; no one is asked of the time after t_N."""
    f, ends = dynamics_of(elite()), []

    def march(policy, start, end, x):
        ends.append(end)
        yield from runge_kutta(f, float(elite().time[1]) / 8)(policy, start, end, x)

    knots, x = elite().sample(2000, np.random.default_rng(1))
    assert simulate(elite(), f, march, knots, x).failed.mean() < 0.01
    wide = elite().x[knots] + 6 * (x - elite().x[knots])
    lost = simulate(elite(), f, march, knots, wide)
    assert max(ends) == elite().time[-1]
    assert lost.missed_goal.mean() > 0.1
    other = dataclasses.replace(elite(), K_goal=-elite().K_goal)
    np.testing.assert_array_equal(simulate(other, f, march, knots, wide).failed, lost.failed)


@pytest.mark.thorough
def test_the_page_s_motions_end_with_the_last_knot():
    assert boundary_motions(elite()).time[-1] == elite().time[-1]


@pytest.mark.thorough
def test_a_stored_elite_says_that_it_ends_in_a_catch_set():
    arrays, record = stored()
    assert record["catch"] == {"half_widths": [0.2, 1.0]}
    assert record["policy"]["catch_weight"] == pytest.approx(1)
    assert elite().caught
    assert not Elite.of(arrays, {key: value for key, value in record.items() if key != "catch"}).caught


@pytest.fixture
def run(tmp_path):
    """The folder of a finished run with this elite."""
    config = experiment()
    replace_json(tmp_path / "format.json", mark_of(config))
    replace(tmp_path / "config.yaml", configuration.dump(config).encode())
    (tmp_path / "elites").mkdir()
    write_elite(tmp_path / "elites", "000", *stored())
    return tmp_path


@pytest.mark.thorough
def test_what_goes_on_after_the_last_knot_refuses(run):
    verbs = {
        "disturb": lambda: disturb_run(run, 10, 0, silent()),
        "refine": lambda: refine_run(run, 1, ("gains",), 1, silent()),
    }
    for verb, start in verbs.items():
        with pytest.raises(UserError, match=rf"ends in a catch set \(task\.catch\): rtcd {verb} needs a goal"):
            start()
    assert sorted(path.name for path in run.iterdir()) == ["config.yaml", "elites", "format.json"]


@pytest.mark.thorough
def test_a_run_that_ends_in_a_catch_set_is_proved(run):
    """Though S has a boundary layer before the catch: the gain on the speed grows from 4.6 to 89 in one interval."""
    output = Output()
    assert certify_run(run, 1, "proved", 1, output.console)
    report = check.check_file(run / "certificates" / "000.json")
    assert report.start == 0
    np.testing.assert_allclose(report.axes["catch"], [0.2, 1.0], rtol=1e-6)
    assert report.volumes["inlet"] > 0.05 * elite().volumes_per_knot[0]
    assert standing(run, "000").proved


@pytest.mark.thorough
def test_an_export_without_a_funnel_between_its_knots_is_refused(run):
    """So few knots that the interpolant of S is indefinite between two of them."""
    with pytest.raises(UserError, match=r"no ellipsoid at t = [\d.]+ s, between two knots: .* trajectory\.knots = 21"):
        export_run(run, 0, run / "lab", silent())
    assert not (run / "lab").exists()


@pytest.mark.thorough
def test_a_replay_judges_what_was_measured_until_the_catch(run, tmp_path):
    """Whatever the robot does after it: the same verdict and the same samples."""
    loop = ClosedLoop.of(elite(), dynamics_of(elite()))
    rows = [[t, *loop.elite.x[k]] for k, t in enumerate(loop.elite.time)]
    end = rows[-1][0]
    for name, after in (("still", []), ("wild", [[end + 0.1, 5.0, -6.0], [end + 0.2, 6.0, 6.0]])):
        lines = [",".join(map(repr, map(float, row))) for row in rows + after]
        (tmp_path / f"{name}.csv").write_text("\n".join(["time,theta,theta_dot", *lines]))
        assert replay_run(run, tmp_path / f"{name}.csv", 0, silent())
    results = [(run / "replay" / f"{name}_000.csv").read_text() for name in ("still", "wild")]
    assert results[0] == results[1]


@pytest.mark.thorough
def test_the_cost_counts_from_its_center():
    """J = h sum 1/2 ((x - c)'Q (x - c) + u'R u) + w_t h N along the motion, which a center elsewhere changes."""
    costs = {}
    for center in ([2, 2], [0, 0]):
        centered = make_problem(experiment(task={**CAUGHT["task"], "cost_center": center}))
        genomes = jnp.asarray(initial_genome(centered))[None]
        one = jax.tree.map(lambda leaf: leaf[0], jax.jit(make_evaluate(centered))(genomes, jax.random.key(0)))
        motion, candidate = one.funnel.policy.trajectory, one.candidate
        error = np.asarray(motion.xs[:-1]) - center
        running = 0.5 * (error**2 @ np.asarray(candidate.q) + np.asarray(motion.us) ** 2 @ np.asarray(candidate.r))
        whole = float(motion.dt) * np.sum(running + centered.config.trajectory.time_weight)
        assert float(motion.cost) == pytest.approx(whole, rel=1e-9)
        costs[tuple(center)] = float(motion.cost), np.asarray(motion.xs)
    np.testing.assert_array_equal(costs[2, 2][1], evaluated().funnel.policy.trajectory.xs)
    assert costs[0, 0][0] != pytest.approx(costs[2, 2][0], rel=0.01)


# ---- the configuration


def test_without_the_keys_nothing_of_a_configuration_changes():
    plain = configuration.parse(yaml.safe_load(configuration.EXAMPLE))
    assert not {"catch", "cost_center"} & configuration.resolved(plain)["task"].keys()
    assert "catch_weight" not in configuration.resolved(plain)["policy"]
    assert configuration.config_hash(plain) == "699114ffc6eb"  # as it was before there were any
    assert "catch_weight" not in plain.policy.initial()


def test_a_configuration_with_a_catch_set_is_read_back():
    assert configuration.parse_yaml(configuration.dump(experiment())) == experiment()


def test_several_tasks_have_the_catch_set_about_their_own_goals():
    one, other = make_problem(experiment(tasks={"right": {}, "left": {"goal": [-2, -2]}})).tasks
    np.testing.assert_array_equal(one.catch, other.catch)
    assert other.goal.tolist() == [-2, -2]


NARROW, WIDE = {"half_widths": [0.2]}, {"half_widths": [0.2, 5.5]}


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"task": {"catch": NARROW}}, r"task.catch.half_widths: must have 2 entries \(theta, theta_dot\), has 1"),
        ({"task": {"catch": {"half_widths": [0.2, 0]}}}, r"task.catch.half_widths.1 = 0: must be >= 1e-06"),
        ({"task": {"catch": {"half_widths": [0.2, np.inf]}}}, "task.catch.half_widths.1 = inf: must be"),
        ({"task": {"catch": {"widths": 1}}}, "task.catch.widths = 1: unknown key; did you mean 'half_widths'"),
        ({"task": {"catch": WIDE}}, r"task.goal.1 = 2.0: must lie in \[-1.5, 1.5\]: the catch set reaches 5.5"),
        ({"task": {"cost_center": [1]}}, "task.cost_center: must have 2 entries"),
        ({"policy": {"catch_weight": 0}}, "policy.catch_weight = 0: must be >= 1e-09"),
        ({"search": {"objective": "goal"}}, "search.objective = 'goal': must be another one with task.catch"),
        ({"search": {"refine": True}}, "search.refine = True: must be false with task.catch"),
        ({"tasks": {"a": {"goal": [1, 6.5]}}}, r"tasks.a.goal.1 = 6.5: must lie in \[-6, 6\]: the catch set reaches"),
    ],
)
def test_what_is_wrong_is_told_in_one_line(changes, line):
    with pytest.raises(ConfigError, match=f"^configuration: ({line})") as error:
        experiment(**changes)
    assert "\n" not in str(error.value)


def test_a_catch_weight_belongs_to_a_catch_set():
    plain = yaml.safe_load(configuration.EXAMPLE)
    with pytest.raises(ConfigError, match=r"policy\.catch_weight: needs task\.catch"):
        configuration.parse(plain | {"policy": {"catch_weight": 2}})
    assert configuration.parse(plain | {"task": CAUGHT["task"]}).policy.catch_weight == 1
