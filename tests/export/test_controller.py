"""The exported controllers, Python and C, are the loop that the run has sampled and the verification simulates."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest

from rtcd_jax.elite.closed_loop import ClosedLoop, Outcome, _outside, runge_kutta, settling_time, simulate
from rtcd_jax.elite.simulators import simulators_of

STEPS = 10  # in an interval
SETTLING_STEPS = 4
COMPILER = shutil.which("cc") or shutil.which("gcc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler: neither cc nor gcc is on the path")


@pytest.fixture(scope="session")
def library(export, tmp_path_factory):
    """The C controller as (control, monitor), called as the Python one."""
    path = tmp_path_factory.mktemp("c") / "controller.so"
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]
    subprocess.run([COMPILER, *flags, export.folder / "controller.c", "-o", path, "-lm"], check=True)
    return _bind(ctypes.CDLL(str(path)), export.bundle.elite)


def _bind(compiled, elite):
    n, m = elite.x_goal.size, elite.u_max.size
    vector = ctypes.c_double * n

    class Monitor(ctypes.Structure):
        _fields_ = (
            ("ratio", ctypes.c_double),
            ("margin", ctypes.c_double),
            ("inside", ctypes.c_int),
            ("abort", ctypes.c_int),
        )

    compiled.rtcd_control.argtypes = [ctypes.c_double, vector, ctypes.c_double * m]
    compiled.rtcd_control.restype = None
    compiled.rtcd_watch.argtypes = [ctypes.c_double, vector, ctypes.c_double]
    compiled.rtcd_watch.restype = Monitor

    def control(t, x):
        u = (ctypes.c_double * m)()
        compiled.rtcd_control(t, vector(*x), u)
        return np.array(u)

    def monitor(t, x):
        return compiled.rtcd_watch(t, vector(*x), 4.0)

    return control, monitor


@pytest.fixture(params=["python", pytest.param("c", marks=needs_compiler)])
def loop(request, export):
    """The exported (control, monitor) in one language."""
    if request.param == "c":
        return request.getfixturevalue("library")
    controller = export.module.Controller()
    return controller.control, controller.monitor


def axes(now):
    """What takes the unit ball to the funnel's section, less its center."""
    return np.sqrt(now.level) * np.linalg.inv(np.linalg.cholesky(now.value)).T


def around_the_funnel(bundle, count, reach, seed):
    """Times and states whose distance from x* is at most `reach` times the funnel's."""
    random, n = np.random.default_rng(seed), bundle.elite.x_goal.size
    for t in random.uniform(0, 1.3 * bundle.elite.time[-1], count):
        now = bundle.at(t)
        direction = random.normal(size=n)
        away = random.uniform(0, reach) * direction / np.linalg.norm(direction)
        yield t, now.x + axes(now) @ away, away @ away


def test_the_input_is_that_of_the_verifications_loop(export, loop):
    elite, control = export.bundle.elite, loop[0]
    loop_of = ClosedLoop.of(elite, next(simulators_of(elite, 2)).dynamics)
    for t, x, _ in around_the_funnel(export.bundle, 200, reach=3, seed=0):
        k = int(t / elite.time[1])
        policy = loop_of.tracking(k) if t < elite.time[-1] else loop_of.holding()
        np.testing.assert_allclose(control(t, x), policy(t, x[None])[0], rtol=1e-8, atol=1e-8)


def test_the_ratio_is_one_on_the_boundary_and_v_over_rho_at_the_knots(export, loop):
    elite, monitor = export.bundle.elite, loop[1]
    for t, x, ratio in around_the_funnel(export.bundle, 100, reach=2, seed=1):
        np.testing.assert_allclose(monitor(t, x).ratio, ratio, rtol=1e-7)
    offsets = 0.01 * np.random.default_rng(2).normal(size=(len(elite.time), elite.x_goal.size))
    for k, offset in enumerate(offsets):
        x = (elite.x[k] if k < len(elite.u) else elite.x_goal) + offset
        expected = (elite.value(k, x[None]) if k < len(elite.u) else elite.value_of_goal(x[None]))[0] / elite.rho[k]
        np.testing.assert_allclose(monitor(elite.time[k], x).ratio, expected, rtol=1e-8)


def test_the_monitor_says_inside_and_abort_on_both_sides_of_the_boundary(export, loop):
    bundle, monitor = export.bundle, loop[1]
    t = 0.6 * bundle.elite.time[-1]
    now = bundle.at(t)
    direction = axes(now)[:, 0]
    for radius, inside, abort in ((0.0, True, False), (0.999, True, False), (1.001, False, False), (2.01, False, True)):
        watch = monitor(t, now.x + radius * direction)
        assert (bool(watch.inside), bool(watch.abort)) == (inside, abort)
        np.testing.assert_allclose(watch.margin, 1 - radius**2, atol=1e-9)


def test_a_state_is_flat_or_positions_and_velocities(export):
    """As the folder's README calls it, for one joint or several."""
    controller, x = export.module.Controller(), export.bundle.elite.x[1] + 0.01
    pos, vel = x.reshape(2, -1)
    measured = (pos[0], vel[0]) if pos.size == 1 else (pos, vel)
    assert controller.monitor(0.01, [*measured]) == controller.monitor(0.01, x)
    np.testing.assert_array_equal(controller.control(0.01, [*measured]), controller.control(0.01, x))


def test_beyond_a_limit_of_the_states_the_monitor_advises_to_abort(export, loop):
    elite, monitor = export.bundle.elite, loop[1]
    limited = int(np.argmax(np.isfinite(elite.state_limits)))
    for sign in (-1, 1):
        x = elite.x_goal.copy()
        x[limited] = sign * (elite.state_limits[limited] + 1e-9)
        assert bool(monitor(2 * elite.time[-1], x).abort)
        assert not monitor(2 * elite.time[-1], x).inside


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_gives_no_input_and_the_advice_to_abort(export, loop, bad):
    elite, (control, monitor) = export.bundle.elite, loop
    for i in range(elite.x_goal.size):
        x = elite.x[0] + 0.1
        x[i] = bad
        np.testing.assert_array_equal(control(0.01, x), 0)
        assert bool(monitor(0.01, x).abort)
        assert not monitor(0.01, x).inside
    np.testing.assert_array_equal(control(bad, elite.x[0] + 0.1), 0)
    assert bool(monitor(bad, elite.x[0]).abort)


def test_before_the_start_its_first_instant_is_held(export, loop):
    elite, (control, monitor) = export.bundle.elite, loop
    x = elite.x[0] + 0.01
    np.testing.assert_array_equal(control(-1.0, x), control(0.0, x))
    assert monitor(-1.0, x).ratio == monitor(0.0, x).ratio


def test_c_mujoco_under_the_exported_controller_gives_the_verifications_outcome(export, loop):
    """The same states, half of them far outside the funnel, step by step: the same verdicts on every one."""
    elite, (control, monitor) = export.bundle.elite, loop
    simulator = next(simulators_of(elite, 24))
    knots, states = elite.sample(24, np.random.default_rng(3))
    states[::2] = elite.x[knots[::2]] + 4 * (states[::2] - elite.x[knots[::2]])
    march = runge_kutta(simulator.dynamics, elite.time[1] / STEPS)
    expected = simulate(elite, simulator.dynamics, march, knots, states)
    assert 0 < expected.failed.sum() < len(states)

    exported = _driven(elite, control, monitor, march, simulator.dynamics, knots, states)
    for kind in ("left_funnel", "left_limits", "missed_goal"):
        np.testing.assert_array_equal(getattr(exported, kind), getattr(expected, kind))


def _driven(elite, control, monitor, march, f, knots, states) -> Outcome:
    """`simulate` with a controller that knows the time alone, and the monitor's verdicts at the knots."""
    x = states.copy()
    outside, left = _outside(elite, x), np.zeros(len(x), bool)
    dt, last = elite.time[1], elite.time[-1]

    def advance(moving, start, end):
        # The input jumps at a knot: what is asked for at an interval's end belongs to that interval.
        def policy(t, xs):
            return np.array([control(min(t, end - 1e-12) if end <= last else t, row) for row in xs])

        beyond = np.zeros(moving.size, bool)
        for now in march(policy, start, end, x[moving]):
            beyond |= _outside(elite, now)
            x[moving] = now
        outside[moving] |= beyond

    for k in range(len(elite.u)):
        moving = np.flatnonzero((knots <= k) & ~outside)
        advance(moving, elite.time[k], elite.time[k + 1])
        for index in moving:
            left[index] |= not monitor(elite.time[k + 1], x[index]).ratio <= 1 + 1e-6
    arrived = 1e-3
    for step in range(int(np.ceil(settling_time(elite, f) / dt))):
        ratios = np.array([monitor(2 * last, row).ratio for row in x])
        moving = np.flatnonzero(~outside & ~(ratios <= 0.1 * arrived))
        if moving.size:
            advance(moving, last + (step + 1) * dt, last + (step + 2) * dt)
    missed = np.array([not monitor(2 * last, row).ratio <= arrived for row in x])
    return Outcome(left, outside, outside | missed)


def test_the_dfki_interface_speaks_of_joints(export):
    bundle, controller = export.bundle, export.module.Controller()
    elite, half = bundle.elite, bundle.elite.x_goal.size // 2
    t = 0.3 * elite.time[-1]
    x = bundle.at(t).x + 0.01
    controller.init(elite.x[0])
    controller.set_goal(elite.x_goal)
    pos, vel, tau = controller.get_control_output(x[:half], x[half:], np.zeros(half), t)
    np.testing.assert_allclose(np.concatenate([pos, vel]), bundle.at(t).x, rtol=1e-12)
    np.testing.assert_array_equal(tau[bundle.joints], controller.control(t, x))
    np.testing.assert_array_equal(np.delete(tau, bundle.joints), 0)
    if half == 1:
        floats = controller.get_control_output(x[0], x[1], 0.0, t)
        assert all(type(value) is float for value in floats)
        assert floats == (pos[0], vel[0], tau[0])


def test_what_is_returned_may_be_changed(export):
    """Nothing that a robot's program does to the outputs reaches the controller."""
    controller = export.module.Controller()
    for t in (0.0, 2 * controller.duration):
        before = controller.get_control_output(*np.split(export.bundle.elite.x[0], 2), None, t)
        kept = [np.array(part) for part in before]
        for part in (*before, controller.control(np.nan, export.bundle.elite.x[0])):
            part += 1.0
        for part, old in zip(
            controller.get_control_output(*np.split(export.bundle.elite.x[0], 2), None, t), kept, strict=True
        ):
            np.testing.assert_array_equal(part, old)
    np.testing.assert_array_equal(controller.control(np.nan, export.bundle.elite.x[0]), 0)


def test_both_self_tests_pass_and_can_fail(export, tmp_path):
    folder = shutil.copytree(export.folder, tmp_path / "copy")
    assert export.module.self_test(folder) < 1e-9
    lines = (folder / "test_vectors.csv").read_text().splitlines()
    cells = lines[7].split(",")
    cells[-1] = repr(float(cells[-1]) + 0.01)
    lines[7] = ",".join(cells)
    (folder / "test_vectors.csv").write_text("\n".join(lines) + "\n")
    assert export.module.self_test(folder) > 1e-3


@needs_compiler
def test_the_c_self_test_compiles_without_warnings_passes_and_can_fail(export, tmp_path):
    folder = shutil.copytree(export.folder, tmp_path / "copy")
    flags = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    subprocess.run([COMPILER, *flags, "controller_test.c", "controller.c", "-lm", "-o", "t"], cwd=folder, check=True)
    done = subprocess.run(["./t"], cwd=folder, capture_output=True, text=True)
    assert (done.returncode, done.stdout[:16]) == (0, "ok: 400 vectors,")
    text = (folder / "test_vectors.csv").read_text()
    (folder / "test_vectors.csv").write_text(text.replace("\n", "\n0.01,", 1).replace("0.01,0.", "0.011,0.", 1))
    assert subprocess.run(["./t"], cwd=folder, capture_output=True).returncode == 1
    assert subprocess.run(["./t", "none.csv"], cwd=folder, capture_output=True).returncode == 2
