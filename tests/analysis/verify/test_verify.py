"""A funnel that holds is confirmed, one that does not is refuted, and both simulators simulate the defined loop."""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

import dataclasses
import json

import mujoco
import numpy as np
import pytest
import scipy.stats
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import solve_continuous_are

from rtcd_jax.analysis.verify.run import verify_run
from rtcd_jax.analysis.verify.verification import Trial, Verification
from rtcd_jax.config.plants import stored_plant
from rtcd_jax.elite.closed_loop import ClosedLoop, simulate
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import FORMAT, VERSION, write_elite
from rtcd_jax.elite.simulators import simulators_of
from rtcd_jax.plants import model_of
from rtcd_jax.system.errors import UserError
from tests.consoles import Screen, Stopped

PARAMETERS = {"m": 0.7, "l": 0.4, "b": 0.1, "g": 9.81, "torque_limit": 2.5}
INERTIA = PARAMETERS["m"] * PARAMETERS["l"] ** 2
WEIGHT = PARAMETERS["m"] * PARAMETERS["g"] * PARAMETERS["l"]
UPRIGHT = np.array([np.pi, 0.0])
HELD = 0.2  # a level whose ellipsoid reaches 0.14 rad, far inside the upright's region of attraction
SIMULATORS = ("C MuJoCo", "RK45")


def _pendulum(x, u):
    return np.array([x[1], (u - PARAMETERS["b"] * x[1] - WEIGHT * np.sin(x[0])) / INERTIA])


def _goal_lqr():
    a = np.array([[0, 1], [WEIGHT / INERTIA, -PARAMETERS["b"] / INERTIA]])
    b = np.array([[0], [1 / INERTIA]])
    q, r = np.diag([10.0, 1.0]), np.array([[0.1]])
    s = solve_continuous_are(a, b, q, r)
    return np.linalg.solve(r, b.T @ s), s


def _held(level: float, knots: int = 6) -> Elite:
    """The pendulum held upright: the nominal motion rests at the goal, every ellipsoid is the goal LQR's."""
    gain, value = _goal_lqr()
    return Elite(
        plant="pendulum",
        parameters=PARAMETERS,
        guarantee="sampled",
        epsilon=0.05,
        confidence=0.99,
        time=0.05 * np.arange(knots),
        x=np.tile(UPRIGHT, (knots, 1)),
        u=np.zeros((knots - 1, 1)),
        K=np.tile(gain, (knots, 1, 1)),
        S=np.tile(value, (knots, 1, 1)),
        rho=np.full(knots, level),
        Q=np.diag([10.0, 1.0]),
        R=np.array([[0.1]]),
        K_goal=gain,
        x_goal=UPRIGHT,
        u_max=np.array([2.5]),
        state_limits=np.array([2 * np.pi, 7.0]),
        volumes_per_knot=np.full(knots, np.pi * level / np.sqrt(np.linalg.det(value))),
    )


def _moving() -> Elite:
    """An open-loop motion from rest under changing torques, with gains that change from knot to knot."""
    elite = _held(HELD)
    torques = np.array([2.0, -1.0, 1.5, 0.5, -2.0])
    x = [np.zeros(2)]
    for torque in torques:
        x.append(_integrated(lambda _, x, u=torque: _pendulum(x, u), 0.0, 0.05, x[-1]))
    gains = elite.K * np.linspace(0.5, 1.5, len(x))[:, None, None]
    return dataclasses.replace(elite, x=np.array(x), u=torques[:, None], K=gains)


def _integrated(rate, start, end, x):
    return solve_ivp(rate, (start, end), x, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]


def _oracle(elite: Elite, k: int, x: np.ndarray) -> np.ndarray:
    """The end of interval k under the loop's definition, by scipy's interpolants and integrator."""
    start, end = ends = elite.time[k : k + 2]
    torque = elite.u[k, 0]
    nominal = CubicHermiteSpline(ends, elite.x[k : k + 2], [_pendulum(x, torque) for x in elite.x[k : k + 2]])

    def rate(t, x):
        gain = [np.interp(t, ends, elite.K[k : k + 2, 0, i]) for i in range(2)]
        return _pendulum(x, np.clip(torque - gain @ (x - nominal(t)), -elite.u_max[0], elite.u_max[0]))

    return _integrated(rate, start, end, x)


def _outcomes(elite: Elite, knots, states):
    states = np.atleast_2d(np.asarray(states, float))
    return [
        simulate(elite, f, march, np.asarray(knots), states) for _, f, march, _ in simulators_of(elite, len(states))
    ]


def verified(elite: Elite, states: int = 60, seed: int = 0) -> Verification:
    """All chunks of a trial, one after the other."""
    trial = Trial(elite, states, seed)
    chunks = [(simulator, chunk) for simulator in trial.names for chunk in range(trial.chunks)]
    return trial.verification({each: trial.outcome(*each) for each in chunks})


def test_a_small_funnel_about_the_upright_keeps_its_promise():
    result = verified(_held(HELD))
    assert tuple(result.outcomes) == SIMULATORS
    for simulator in SIMULATORS:
        assert result.failures(simulator) == 0
        assert result.interval(simulator)[0] == 0
    assert not result.refuted


def test_a_funnel_a_hundred_times_too_large_is_refuted_by_both_simulators():
    result = verified(_held(100 * HELD))
    for simulator in SIMULATORS:
        outcome = result.outcomes[simulator]
        assert result.interval(simulator)[0] > result.epsilon
        assert outcome.left_funnel.any()
        assert outcome.missed_goal.any()
        np.testing.assert_array_equal(outcome.failed, outcome.left_funnel | outcome.left_limits | outcome.missed_goal)
    assert result.refuted


@pytest.mark.parametrize("level", [HELD, 10 * HELD, 100 * HELD])
def test_the_simulators_agree_on_every_state(level):
    result = verified(_held(level), states=120, seed=1)
    mujoco_saw, closed_form_saw = result.outcomes.values()
    for kind in ("left_funnel", "left_limits", "missed_goal"):
        np.testing.assert_array_equal(getattr(mujoco_saw, kind), getattr(closed_form_saw, kind))
    assert result.disagreements == 0


@pytest.mark.parametrize(("simulator", "smooth", "kinked"), [(0, 1e-6, 2e-4), (1, 1e-8, 2e-6)], ids=SIMULATORS)
def test_an_interval_under_the_loop_is_that_of_its_definition(simulator, smooth, kinked):
    """The last state crosses the torque limit inside a step: there a method of any order is one of the second."""
    elite = _moving()
    _, f, march, _ = list(simulators_of(elite, 4))[simulator]
    offsets = np.array([[0.0, 0.0], [0.05, -0.1], [-0.1, 0.2], [0.6, 1.0]])
    tolerances = np.array([smooth, smooth, smooth, kinked])[:, None]
    for k in range(len(elite.u)):
        policy = ClosedLoop.of(elite, f).tracking(k)
        start, end = elite.time[k : k + 2]
        *_, reached = march(policy, start, end, elite.x[k] + offsets)
        expected = np.array([_oracle(elite, k, x) for x in elite.x[k] + offsets])
        assert np.all(np.abs(reached - expected) < tolerances)
        np.testing.assert_array_equal(np.abs(policy(start, elite.x[k] + offsets))[:, 0] == 2.5, [0, 0, 0, 1])


def test_mujocos_own_steps_with_held_inputs_converge_to_the_loop():
    """An input held over `mj_step` lags: its error falls with the first power of the step, towards our end state."""
    elite, x0 = _held(HELD), np.array([np.pi + 0.1, -0.2])

    def stepped(steps):
        model = model_of(stored_plant("pendulum"), PARAMETERS)
        model.opt.timestep = 0.05 / steps
        data = mujoco.MjData(model)
        data.qpos, data.qvel = x0[:1], x0[1:]
        for _ in range(steps):
            data.ctrl = np.clip(-elite.K_goal @ (np.concatenate([data.qpos, data.qvel]) - UPRIGHT), -2.5, 2.5)
            mujoco.mj_step(model, data)
        return np.concatenate([data.qpos, data.qvel])

    _, f, march, _ = next(simulators_of(elite, 1))
    *_, end = march(ClosedLoop.of(elite, f).tracking(0), 0.0, 0.05, x0[None])
    coarse, fine = (np.linalg.norm(stepped(steps) - end[0]) for steps in (200, 400))
    assert fine < 1e-3
    assert coarse / fine == pytest.approx(2, rel=0.02)


def test_states_are_uniform_in_every_ellipsoid():
    """In n = 2 dimensions V / rho of a uniform state is uniform on [0, 1], and its angle uniform on the circle."""
    elite = dataclasses.replace(_moving(), rho=np.linspace(0.1, 0.6, 6))
    knots, x = elite.sample(6001, np.random.default_rng(0))
    assert sorted(np.bincount(knots)) == [1000] * 5 + [1001]
    factor = np.linalg.cholesky(elite.S[0])
    for k in range(6):
        inside = x[knots == k]
        assert scipy.stats.kstest(elite.value(k, inside) / elite.rho[k], "uniform").pvalue > 1e-3
        angle = np.arctan2(*((inside - elite.x[k]) @ factor).T)
        assert scipy.stats.kstest(angle, "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 1e-3


def test_a_state_leaves_the_funnel_where_its_value_exceeds_the_level():
    """Both sides of the threshold, one part in a thousand beside the oracle's value at knot 2."""
    elite, x = _moving(), _moving().x[0] + [0.02, -0.05]
    reached = elite.value(2, _oracle(elite, 1, _oracle(elite, 0, x))[None])[0]
    for share, leaves in ((0.999, True), (1.001, False)):
        rho = np.full(6, 1e9)
        rho[2] = share * reached
        for outcome in _outcomes(dataclasses.replace(elite, rho=rho), [0], x):
            assert outcome.left_funnel[0] == leaves


def test_a_state_starts_at_its_own_knot():
    """From the last knot no later ellipsoid can be left, from the first one the same state leaves one."""
    elite = _held(HELD)
    elite = dataclasses.replace(elite, rho=np.array([HELD, HELD, 1e-9, HELD, HELD, HELD]))
    for outcome in _outcomes(elite, [0, 1, 2, 5], np.tile(UPRIGHT + np.array([0.05, 0]), (4, 1))):
        np.testing.assert_array_equal(outcome.left_funnel, [True, True, False, False])


def test_only_states_that_torque_can_hold_arrive():
    """Beyond asin(2.5 / mgl) = 1.14 rad from the upright gravity wins over any torque, at rest and from any knot."""
    reach = np.arcsin(2.5 / WEIGHT)
    for outcome in _outcomes(_held(HELD), [0, 0, 5], UPRIGHT + np.array([[0.1, 0], [reach + 0.05, 0], [0.3, 0]])):
        np.testing.assert_array_equal(outcome.missed_goal, [False, True, False])


@pytest.mark.parametrize("speed_limit", [0.99, 1.01])
def test_limits_are_watched_between_the_knots(speed_limit):
    """From rest at 0.1 rad the speed is zero at the start and at the end; its peak is the oracle's."""
    elite = _held(1e3)
    solution = solve_ivp(
        lambda _, x: _pendulum(x, np.clip(-elite.K_goal[0] @ (x - UPRIGHT), -2.5, 2.5)),
        (0, 1), UPRIGHT + np.array([0.1, 0]), rtol=1e-10, atol=1e-10, max_step=1e-3,
    )  # fmt: skip
    peak = np.abs(solution.y[1]).max()
    limited = dataclasses.replace(elite, state_limits=np.array([np.inf, speed_limit * peak]))
    for outcome in _outcomes(limited, [0], UPRIGHT + np.array([0.1, 0])):
        assert outcome.left_limits[0] == (speed_limit < 1)
        assert outcome.failed[0] == (speed_limit < 1)


def test_a_promise_is_refuted_only_where_the_interval_lies_above_it():
    """The same failures refute a small epsilon and not one above their lower bound."""
    result = verified(_held(10 * HELD))
    lower, _ = result.interval("RK45")
    assert lower > 0
    assert not dataclasses.replace(result, epsilon=1.001 * lower).refutes("RK45")
    assert dataclasses.replace(result, epsilon=0.999 * lower).refutes("RK45")


def _store(folder, name: str, elite: Elite, **changes) -> None:
    record = {key: getattr(elite, key) for key in ("plant", "parameters", "epsilon", "confidence")}
    limits = [limit if np.isfinite(limit) else None for limit in elite.state_limits]
    folder.mkdir(parents=True, exist_ok=True)
    promise = {"state_limits": limits, "status": "OK", "rung": elite.guarantee}
    write_elite(folder, name, _arrays(elite), record | promise | changes)


def _arrays(elite: Elite) -> dict[str, np.ndarray]:
    values = ((field.name, getattr(elite, field.name)) for field in dataclasses.fields(elite))
    return {name: value for name, value in values if isinstance(value, np.ndarray) and name != "state_limits"}


def test_verify_run_stores_what_it_found_and_tells_it(tmp_path):
    limited = dataclasses.replace(_held(HELD), state_limits=np.array([np.inf, 7.0]))
    _store(tmp_path / "elites", "000", limited)
    _store(tmp_path, "initial", _held(100 * HELD))
    screen = Screen()
    assert not verify_run(tmp_path, 60, 3, 1, screen.console)
    kept, broken = (json.loads((tmp_path / "verification" / f"{name}.json").read_text()) for name in ("000", "initial"))
    assert (kept["kept"], broken["kept"]) == (True, False)
    for record in (kept, broken):
        assert (record["states"], record["seed"], record["epsilon"]) == (60, 3, 0.05)
        for found in record["witnesses"].values():
            assert sum(found["failures_per_knot"]) == found["failures"]
            assert found["rate_lower"] <= found["rate"] == found["failures"] / 60 <= found["rate_upper"]
    assert broken["witnesses"]["RK45"]["failures"] > 0
    rows = [line.split() for line in screen.text.splitlines()]
    verdicts = [(row[0], " ".join(row[-2:])) for row in rows if row and row[0] in ("000", "initial")]
    refuted = [("initial", "(0.99) REFUTED")] * 2
    assert verdicts == [("000", "not refuted")] * 2 + refuted
    for name, record in (("000", kept), ("initial", broken)):
        for found in record["witnesses"].values():
            interval = f"[{found['rate_lower']:.2g}, {found['rate_upper']:.2g}]"
            assert any(line.split()[:1] == [name] and interval in line for line in screen.text.splitlines())


def test_verify_run_reports_an_initial_candidate_without_a_funnel(tmp_path):
    _store(tmp_path / "elites", "000", _held(HELD))
    _store(tmp_path, "initial", _held(HELD), status="FUNNEL_EMPTY")
    screen = Screen()
    assert verify_run(tmp_path, 60, 0, 1, screen.console)
    assert "initial: nothing to verify, it has no funnel (FUNNEL_EMPTY)" in screen.text
    assert not (tmp_path / "verification" / "initial.json").exists()


@pytest.mark.thorough
def test_chunks_do_not_change_a_verdict(monkeypatch):
    elite = _held(10 * HELD)
    whole = verified(elite, states=50).outcomes["RK45"]
    monkeypatch.setattr("rtcd_jax.analysis.verify.verification.CHUNK", 7)
    parts = verified(elite, states=50).outcomes["RK45"]
    assert whole.failed.any()
    for kind in ("left_funnel", "left_limits", "missed_goal"):
        np.testing.assert_array_equal(getattr(parts, kind), getattr(whole, kind))


@pytest.mark.thorough
def test_a_stopped_verification_goes_on_and_ends_with_the_same_files(tmp_path, monkeypatch):
    monkeypatch.setattr("rtcd_jax.analysis.verify.verification.CHUNK", 20)
    for name in ("whole", "stopped"):
        _store(tmp_path / name / "elites", "000", _held(10 * HELD))
        _store(tmp_path / name, "initial", _held(HELD))
    verify_run(tmp_path / "whole", 60, 3, 1, Screen().console)

    folder = tmp_path / "stopped"
    with pytest.raises(Stopped):
        verify_run(folder, 60, 3, 1, Screen(stop="5/12 chunks").console)
    screen = Screen()
    verify_run(folder, 60, 3, 1, screen.console)
    assert "6/12 chunks" in screen.text
    assert "5/12 chunks" not in screen.text
    for name in ("000.json", "initial.json"):
        whole, stopped = (tmp_path / run / "verification" / name for run in ("whole", "stopped"))
        assert whole.read_bytes() == stopped.read_bytes()
    assert sorted(path.name for path in (folder / "verification").iterdir()) == ["000.json", "initial.json"]


@pytest.mark.thorough
def test_chunks_of_a_funnel_that_has_changed_are_simulated_again(tmp_path, monkeypatch):
    monkeypatch.setattr("rtcd_jax.analysis.verify.verification.CHUNK", 20)
    _store(tmp_path / "elites", "000", _held(10 * HELD))
    _store(tmp_path, "initial", _held(HELD))
    with pytest.raises(Stopped):
        verify_run(tmp_path, 60, 3, 1, Screen(stop="8/12 chunks").console)
    _store(tmp_path, "initial", _held(0.9 * HELD))
    screen = Screen()
    verify_run(tmp_path, 60, 3, 1, screen.console)
    assert "7/12 chunks" in screen.text  # the six of 000 stay
    assert "6/12 chunks" not in screen.text


@pytest.mark.thorough
def test_the_number_of_processes_changes_nothing(tmp_path):
    _store(tmp_path / "elites", "000", _held(10 * HELD))
    _store(tmp_path, "initial", _held(HELD))
    found = []
    for workers in (1, 2):
        verify_run(tmp_path, 60, 3, workers, Screen().console)
        found.append([path.read_bytes() for path in sorted((tmp_path / "verification").iterdir())])
    assert found[0] == found[1]


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_states():
    first, again, other = (verified(_held(HELD), states=6, seed=seed).states for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.any(first == other)


def test_verify_run_refuses_what_is_no_finished_run(tmp_path):
    with pytest.raises(UserError, match=r"nowhere is no run folder: it has no format\.json"):
        verify_run(tmp_path / "nowhere", 60, 0, 1, Screen().console)
    (tmp_path / "format.json").write_text(json.dumps({"format": FORMAT, "version": VERSION}))
    with pytest.raises(UserError, match="has no elites yet: finish the run first"):
        verify_run(tmp_path, 60, 0, 1, Screen().console)
    _store(tmp_path / "elites", "000", _held(HELD))
    with pytest.raises(UserError, match=r"has no initial\.npz"):
        verify_run(tmp_path, 60, 0, 1, Screen().console)


def test_too_few_states_for_the_knots_are_refused():
    with pytest.raises(UserError, match="states = 5: must be at least 6, one for each knot's ellipsoid"):
        verified(_held(HELD), states=5)


def test_a_goal_that_is_not_held_is_refused():
    with pytest.raises(UserError, match="K_goal does not hold the goal: a mode of its loop grows at"):
        verified(dataclasses.replace(_held(HELD), K_goal=np.zeros((1, 2))), states=6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rho": np.ones(5)}, r"6 knots, 2 states and 1 inputs cannot have rho \(5,\): must be .*rho \(6,\)"),
        ({"rho": np.array([1, 1, 0.0, 1, 1, 1])}, r"no funnel: rho\[2\] = 0: must be > 0"),
        ({"rho": np.array([1, np.nan, 1.0, 1, 1, 1])}, "numbers in rho that are not finite"),
        ({"S": np.tile(np.diag([1.0, -1.0]), (6, 1, 1))}, "no funnel: an S is not positive definite"),
    ],
)
def test_an_elite_without_a_funnel_is_refused(changes, message):
    with pytest.raises(UserError, match=message):
        dataclasses.replace(_held(HELD), **changes)


def test_an_elite_that_lacks_something_says_what():
    arrays = {name: array for name, array in _arrays(_held(HELD)).items() if name != "rho"}
    with pytest.raises(UserError, match="the elite lacks rung, epsilon, rho, state_limits"):
        Elite.of(arrays, {"plant": "pendulum", "parameters": PARAMETERS, "confidence": 0.9})
