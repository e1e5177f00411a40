"""Cycles of tasks: values around resets against linear algebra, and which cycles are closed."""

import dataclasses
from functools import cache, partial
from typing import final

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from rtcd_jax.config.load import load, parse, resolved
from rtcd_jax.elite.closed_loop import ClosedLoop, outside_limits, runge_kutta
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import mark_of, resets_in_words
from rtcd_jax.elite.simulators import mujoco_of
from rtcd_jax.evaluation import make_evaluate, over_tasks
from rtcd_jax.genome import decode, encode, initial_genome
from rtcd_jax.plants import brachiation
from rtcd_jax.problem import initial_design, make_problem
from rtcd_jax.reset import closed, values_at_resets, worst_after_reset
from rtcd_jax.run.format import arrays_of, common_arrays, common_record, record_of
from rtcd_jax.run.optimize import optimize
from rtcd_jax.run.reevaluation import row
from rtcd_jax.run.tasks import store_task
from rtcd_jax.system.cluster import Cluster
from rtcd_jax.system.errors import ConfigError, UserError
from rtcd_jax.system.files import replace_json
from rtcd_jax.trajectory import plan
from rtcd_jax.types import Evaluation, Funnel, Status, Volumes
from tests import linear_system as linear
from tests.analysis.report.runs import run_folder
from tests.consoles import Output
from tests.paths import CONFIGS

JUMP = np.array([[0.9, 0.3], [-0.2, 1.6]])
MOTIONS = [linear.policy(us, 0.05).trajectory for us in ([3.0, -2.0, 1.0], [-1.0, 0.5, 2.0])]


@final
class Deaf(linear.Equations):
    """x1'' = 4 x1, whatever the input."""

    limit: float = linear.UNBOUNDED
    state_names = ("position", "speed")
    state_units = ("m", "m/s")

    def dynamics(self, design, x, u):
        return jnp.stack([x[1], 4 * x[0] + 0 * u[0]])


def _linear(**changes):
    problem = linear.problem_of([1e6, 1e6], intervals=3)
    return dataclasses.replace(problem, reset=lambda numbers, x: JUMP @ x, **changes)


def _stacked(trees):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def _values(problem):
    return values_at_resets(problem, _stacked([linear.candidate()] * 2), _stacked(MOTIONS))


def _expected():
    """S_N = J' S J with S = Y X^-1 of the stable subspace [X; Y] of the flow of state and costate over one period."""
    r = linear.B @ np.linalg.solve(linear.R, linear.B.T)
    hamiltonian = np.block([[linear.A, -r], [-linear.Q, -linear.A.T]])
    jump = scipy.linalg.block_diag(JUMP, np.linalg.inv(JUMP).T)
    monodromy = np.linalg.matrix_power(np.asarray(jump) @ scipy.linalg.expm(hamiltonian * 0.15), 2)
    basis = scipy.linalg.schur(monodromy, sort="iuc")[1]
    start = basis[2:, :2] @ np.linalg.inv(basis[:2, :2])
    return start, JUMP.T @ start @ JUMP


def test_values_are_those_of_the_dense_periodic_riccati_equation():
    np.testing.assert_allclose(_values(_linear()), [_expected()[1]] * 2, rtol=1e-6)


def test_what_no_input_reaches_has_no_values():
    assert np.isnan(_values(_linear(plant=Deaf()))).all()


def _evaluations(levels):
    """Those of one genome on two tasks at rest, with the periodic shapes and these first and last levels."""
    start, last = _expected()
    evaluations = []
    for first_level, last_level in levels:
        policy = dataclasses.replace(linear.policy([0.0] * 3, 0.05), values=jnp.stack([start, start, last, last]))
        funnel = Funnel(policy, jnp.array([first_level, 1.0, 1.0, last_level]), jnp.ones(4, int), policy.status)
        volumes = Volumes(jnp.ones(4), {"sum": jnp.ones(())})
        evaluations.append(Evaluation(jnp.zeros(1), linear.candidate(), funnel, volumes, policy.status))
    return over_tasks(_stacked(evaluations), "min")


@pytest.mark.parametrize(
    ("levels", "status"), [([(2, 1), (4, 1.5)], Status.OK), ([(2, 1), (4, 2.1)], Status.FUNNEL_EMPTY)]
)
def test_with_periodic_values_a_linear_reset_keeps_v(levels, status):
    """Each last rim is carried onto the level rho_N in the next task, whose first ellipsoid is at rho_0."""
    found = closed(_linear(), _evaluations(levels), jax.random.key(0), 50)
    expected = [levels[0][1] / levels[1][0], levels[1][1] / levels[0][0]]
    np.testing.assert_allclose(np.asarray(found.after_reset), expected, rtol=1e-9)
    assert found.status == status
    start, last = _expected()
    for (before, after), level, (_, rim), (first, _) in zip(
        np.asarray(found.worst_at_resets), expected, levels, levels[::-1], strict=True
    ):
        np.testing.assert_allclose(after, JUMP @ before, rtol=1e-12)
        np.testing.assert_allclose([before @ last @ before, after @ start @ after], [rim, level * first], rtol=1e-9)


def test_the_worst_state_of_a_reset_is_named():
    worst = {"before": [0.5, -1.25], "after": [1.0, 2e-5]}
    each = {"into": "left", "largest_level": 1.25, "samples": 50, "epsilon": None, "worst": worst}
    closes = each | {"largest_level": 0.5}
    line, other, infinite = resets_in_words(
        {"reset": {"right": each, "up": closes, "down": each | {"largest_level": None}}}
    )
    assert "right into left: the largest V/rho in the first ellipsoid there is 1.25, of 50 samples" in line
    assert line.endswith("; it leaves the cycle from (0.5, -1.25) to (1, 2e-05)")
    assert other.endswith("; it goes from (0.5, -1.25) to (1, 2e-05)")
    assert "is inf" in infinite
    del closes["worst"]  # as former runs have it
    assert next(resets_in_words({"reset": {"up": closes}})).endswith("on its rim")


# ---- AcroMonk


def cycle_folder(path):
    """A finished run's with the robot that was built as its best elite, without a search."""
    whole = closed(problem(), evaluated(), jax.random.key(1), 100)
    common = common_arrays(whole), common_record(problem(), whole)
    folder = run_folder(path, problem().config, common, common, generations=[])
    replace_json(folder / "format.json", mark_of(problem().config))
    for i, (name, alone) in enumerate(zip(problem().config.tasks, problem().tasks, strict=True)):
        one = row(whole.tasks, i)
        stored = arrays_of(alone, one), record_of(alone, one)
        store_task(folder, name, alone.config, np.asarray, [stored], stored)
    return folder


def _changed(name="acromonk_cycle", **sections):
    data = resolved(load(CONFIGS / f"{name}.yaml"))
    for section, keys in sections.items():
        data[section] = data.get(section, {}) | keys
    return data


@cache
def problem():
    return make_problem(parse(_changed()))


@cache
def evaluated():
    one = jax.jit(make_evaluate(problem()))(jnp.asarray(initial_genome(problem()))[None], jax.random.key(0))
    return row(one, 0)


def test_the_second_swing_is_that_of_the_robot_with_exchanged_arms():
    first, second = (vars(alone.plant) | vars(initial_design(alone)) for alone in problem().tasks)
    after = brachiation.exchanged(first)
    assert {name: float(second[name]) for name in after} == pytest.approx({k: float(v) for k, v in after.items()})


WRONG = {
    "both kinds of end": (
        {"task": {"catch": {"reset": "brachiation", "half_widths": [1, 1, 1, 1]}}},
        r"task\.catch\.reset = 'brachiation': must be left away where there are half_widths",
    ),
    "own motions": (
        {"uncertainty": {"design": {"swing_mass": 0.1}, "center": "moving"}},
        r"uncertainty\.center = 'moving': must be common with task\.catch\.reset",
    ),
    "an arm that is uncertain": (
        {"uncertainty": {"design": {"support_mass": 0.1, "swing_mass": 0.05}}},
        r"uncertainty\.design\.support_mass = 0\.1: must be that of swing_mass, which is 0\.05: at a reset",
    ),
    "an uncertain length": (
        {"uncertainty": {"design": {"arm_length": 0.1}}},
        r"uncertainty\.design\.arm_length = 0\.1: must be 0 with task\.catch\.reset",
    ),
    "another start": (
        {"task": {"start": [-0.5, -2, 0, 0]}},
        r"tasks\.light_holds\.start = \[-0\.5, .*: must be \[-0\.572082\d+, -1\.99742\d+, .*end of heavy_holds",
    ),
    "another robot": (
        {"tasks": {"light_holds": {"plant": {"support_mass": "swing_mass"}}}},
        r"tasks\.light_holds\.plant\.support_center = 0\.23347: must be 0\.189234, what it is after the reset",
    ),
}


@pytest.mark.parametrize(("changes", "text"), [pytest.param(*case, id=name) for name, case in WRONG.items()])
def test_what_is_no_cycle_is_refused(changes, text):
    with pytest.raises(ConfigError, match=text):
        make_problem(parse(_changed(**changes)))


@pytest.mark.thorough
def test_the_worst_robot_of_the_box_is_at_a_corner():
    """No robot within the box goes farther than the corners do, from the states from which those go farthest."""
    box = {"design": {"support_mass": 0.1, "swing_mass": 0.1}, "input": 0.1}
    uncertain, whole = make_problem(parse(_changed(uncertainty=box))), evaluated()
    key, count = jax.random.key(3), 200
    exact, _ = worst_after_reset(problem(), whole.tasks, key, count)
    worst, states = worst_after_reset(uncertain, whole.tasks, key, count)
    assert np.all(worst > 1.01 * exact)
    random = np.random.default_rng(0)
    for _ in range(20):
        factors = dict(zip(("support_mass", "swing_mass"), 1 + random.uniform(-0.1, 0.1, 2), strict=True))
        for task in range(2):
            robot = problem().numbers(row(whole.tasks.candidate, task))
            robot |= {name: robot[name] * factor for name, factor in factors.items()}
            following = row(whole.tasks.funnel, 1 - task)
            off = brachiation.catch(robot, states[task, 0]) - following.policy.trajectory.xs[0]
            assert off @ following.policy.values[0] @ off / following.levels[0] <= worst[task] * (1 + 1e-9)


def test_a_cycle_needs_tasks():
    data = _changed()
    del data["tasks"]
    with pytest.raises(UserError, match="it needs `tasks`"):
        parse(data)


def test_a_cycle_of_one_task_is_not_searched():
    data = _changed()
    del data["tasks"]["light_holds"]
    with pytest.raises(UserError, match="it needs `tasks`"):
        make_evaluate(make_problem(parse(data)))


ARM = 0.3
"""Of another robot than the one that was built [m]."""


def _of_numbers():
    """The configuration in which arithmetic of the arms' length has become its numbers."""
    angle = float(np.arcsin(0.17 / ARM))
    data = _changed(
        task={"start": [-angle, 2 * angle - np.pi, 0, 0], "goal": [angle, np.pi - 2 * angle, 0, 0]},
        design={"arm_length": {"initial": ARM, "min": ARM, "max": ARM}},
    )
    data["tasks"]["light_holds"]["plant"] |= {"support_center": ARM - 0.124776, "swing_center": ARM - 0.23347}
    return make_problem(parse(data))


def _that_follows():
    """The problem in which they follow from the arms' length, and the genome of that length."""
    follows = make_problem(parse(_changed("acromonk_arm")))
    values = [ARM if variable.name == "design.arm_length" else variable.initial for variable in follows.variables]
    return follows, jnp.asarray(encode(follows, values))


def test_what_follows_from_the_design_is_that_of_numbers():
    follows, genome = _that_follows()
    for task, alone in enumerate(_of_numbers().tasks):
        own = follows.of(decode(follows, genome, jnp.asarray(task)))
        np.testing.assert_allclose(own.start, alone.start, atol=1e-15)
        np.testing.assert_allclose(own.goal, alone.goal, atol=1e-15)
        found, expected = (jax.tree.map(float, vars(each.plant)) for each in (own, alone))
        assert found == pytest.approx(expected, abs=1e-15)


@pytest.mark.thorough
def test_motions_follow_the_design():
    follows, numbers = _that_follows(), _of_numbers()
    motions = []
    for problem, genome in (follows, (numbers, jnp.asarray(initial_genome(numbers)))):
        candidates = _stacked([decode(problem, genome, jnp.asarray(task)) for task in (0, 1)])
        motions.append(jax.jit(partial(plan, problem))(candidates))
    assert [each.status.tolist() for each in motions] == [[Status.OK] * 2] * 2
    np.testing.assert_allclose(motions[0].xs, motions[1].xs, atol=1e-6)


def test_a_cycle_must_be_one_for_every_design():
    heavy = {"heavy_holds": {"goal": ["asin(0.17/arm_length)", "pi - 2*asin(0.17/0.31401)", 0, 0]}}
    with pytest.raises(ConfigError, match=r"tasks\.light_holds\.start = .* must be .*the end of heavy_holds"):
        make_problem(parse(_changed("acromonk_arm", tasks=heavy)))


@pytest.mark.slow
def test_a_search_in_which_no_cycle_closes_names_the_state_that_leaves(tmp_path):
    config = parse(_changed(search={"population": 4, "generations": 1}, policy={"catch_weight": 1.0}))
    with pytest.raises(UserError, match="FUNNEL_EMPTY") as error:
        optimize(config, tmp_path / "run", Output().console, Cluster.of())
    *_, head, first, second = str(error.value).splitlines()
    assert head == "nearest to a closed cycle:"
    assert first.startswith("reset of heavy_holds into light_holds: the largest V/rho")
    assert second.startswith("reset of light_holds into heavy_holds: the largest V/rho")
    assert "it leaves the cycle from (" in first + second


@pytest.mark.slow
def test_the_robot_that_was_built_closes_its_cycle_and_stays_in_the_funnels_for_eight_swings():
    """From uniform states of the first ellipsoid, in C MuJoCo, with the reset between the swings."""
    whole = evaluated()
    assert whole.status == Status.OK
    assert np.all(whole.after_reset <= 1)
    whole = closed(problem(), whole, jax.random.key(1), 1000)
    record = common_record(problem(), whole)["reset"]
    assert all(np.shape(each["worst"]["before"]) == (4,) for each in record.values())
    assert [each["into"] for each in record.values()] == ["light_holds", "heavy_holds"]
    elites = []
    for task, alone in enumerate(problem().tasks):
        one = row(whole.tasks, task)
        stored = jax.tree.map(lambda leaf: np.asarray(leaf).tolist(), record_of(alone, one))
        elites.append(Elite.of(arrays_of(alone, one), stored))
    x = elites[0].points(np.zeros(100, int), np.random.default_rng(0))
    for swing in range(8):
        elite = elites[swing % 2]
        assert np.all(elite.value(0, x) <= elite.rho[0])
        f = mujoco_of(elite, 200)
        march, loop = runge_kutta(f, float(elite.time[1]) / 4), ClosedLoop.of(elite, f)
        for k, (begin, end) in enumerate(zip(elite.time[:-1], elite.time[1:], strict=True)):
            for after in march(loop.tracking(k), begin, end, x):
                assert not outside_limits(elite, after).any()
                x = after
        assert np.all(elite.value(len(elite.u), x) <= elite.rho[-1])
        x = np.asarray(brachiation.catch(elite.parameters, jnp.asarray(x.T))).T
