"""The exported controllers, Python and C, are the loop that the run has sampled and the verification simulates."""

import ctypes
import functools
import itertools
import shutil
import subprocess
import sys

import numpy as np
import pytest

from rtcd_jax.elite.closed_loop import ClosedLoop, Outcome, outside_limits, runge_kutta, settling_time, simulate
from rtcd_jax.elite.simulators import simulators_of
from rtcd_jax.export import export_run
from rtcd_jax.export.bundle import read_bundle
from rtcd_jax.system.errors import UserError
from tests.consoles import Output
from tests.export.folders import ELITES, run_folder

STEPS = 10  # in an interval
SETTLING_STEPS = 4
COMPILER = shutil.which("cc") or shutil.which("gcc")
needs_compiler = pytest.mark.skipif(COMPILER is None, reason="no C compiler: neither cc nor gcc is on the path")


STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic"]
OPTIMIZED = ["-O0", "-O2", "-O3 -ffast-math", "-Ofast"]


@pytest.fixture(scope="session")
def library(export, tmp_path_factory):
    """By the compiler's options: the C controller as (control, monitor), called as the Python one."""

    def compiled(options):
        path = tmp_path_factory.mktemp("c") / "controller.so"
        source = export.folder / f"{export.bundle.label}_controller.c"
        flags = [*STRICT, *options.split(), "-shared", "-fPIC"]
        subprocess.run([COMPILER, *flags, source, "-o", path, "-lm"], check=True)
        return bind(path, export.bundle)

    return functools.cache(compiled)


def bind(path, bundle):
    """The (control, monitor) of a compiled export."""
    compiled = ctypes.CDLL(str(path))
    n, m = bundle.elite.x_goal.size, bundle.elite.u_max.size
    vector = ctypes.c_double * n

    class Monitor(ctypes.Structure):
        _fields_ = (
            ("ratio", ctypes.c_double),
            ("margin", ctypes.c_double),
            ("inside", ctypes.c_int),
            ("abort", ctypes.c_int),
            ("proved", ctypes.c_int),
        )

    controller, watch = (getattr(compiled, f"{bundle.label}_{name}") for name in ("control", "watch"))
    controller.argtypes = [ctypes.c_double, vector, ctypes.c_double * m]
    controller.restype = None
    watch.argtypes = [ctypes.c_double, vector, ctypes.c_double]
    watch.restype = Monitor

    def control(t, x):
        u = (ctypes.c_double * m)()
        controller(t, vector(*x), u)
        return np.array(u)

    def monitor(t, x):
        return watch(t, vector(*x), 4.0)

    return control, monitor


@pytest.fixture(params=["python", *(pytest.param(each, marks=needs_compiler) for each in ("-O2", "-O3 -ffast-math"))])
def loop(request, export):
    """The exported (control, monitor) in one language, C with these options."""
    if request.param != "python":
        return request.getfixturevalue("library")(request.param)
    controller = export.module.Controller()
    return controller.control, controller.monitor


def around_the_funnel(bundle, count, reach, seed):
    """Times and states whose distance from x* is at most `reach` times the funnel's."""
    random, n = np.random.default_rng(seed), bundle.elite.x_goal.size
    for t in random.uniform(0, 1.3 * bundle.elite.time[-1], count):
        now = bundle.at(t)
        direction = random.normal(size=n)
        away = random.uniform(0, reach) * direction / np.linalg.norm(direction)
        yield t, now.x + now.axes @ away, away @ away


@pytest.mark.thorough
def test_the_input_is_that_of_the_verifications_loop(export, loop):
    elite, control = export.bundle.elite, loop[0]
    loop_of = ClosedLoop.of(elite, next(simulators_of(elite, 2)).dynamics)
    for t, x, _ in around_the_funnel(export.bundle, 200, reach=3, seed=0):
        k = int(t / elite.time[1])
        policy = loop_of.tracking(k) if t < elite.time[-1] else loop_of.holding()
        np.testing.assert_allclose(control(t, x), policy(t, x[None])[0], rtol=1e-8, atol=1e-8)


@pytest.mark.thorough
def test_the_ratio_is_one_on_the_boundary_and_v_over_rho_at_the_knots(export, loop):
    elite, monitor = export.bundle.elite, loop[1]
    for t, x, ratio in around_the_funnel(export.bundle, 100, reach=2, seed=1):
        np.testing.assert_allclose(monitor(t, x).ratio, ratio, rtol=1e-7)
    offsets = 0.01 * np.random.default_rng(2).normal(size=(len(elite.time), elite.x_goal.size))
    for k, offset in enumerate(offsets):
        x = (elite.x[k] if k < len(elite.u) else elite.x_goal) + offset
        expected = (elite.value(k, x[None]) if k < len(elite.u) else elite.value_of_goal(x[None]))[0] / elite.rho[k]
        np.testing.assert_allclose(monitor(elite.time[k], x).ratio, expected, rtol=1e-8)


@pytest.mark.thorough
def test_the_monitor_says_inside_and_abort_on_both_sides_of_the_boundary(export, loop):
    bundle, monitor = export.bundle, loop[1]
    t = 0.6 * bundle.elite.time[-1]
    now = bundle.at(t)
    direction = now.axes[:, 0]
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
        for t in (0.01, 2 * elite.time[-1]):
            np.testing.assert_array_equal(control(t, x), 0)
            assert bool(monitor(t, x).abort)
            assert not monitor(t, x).inside
    np.testing.assert_array_equal(control(bad, elite.x[0] + 0.1), 0)
    assert bool(monitor(bad, elite.x[0]).abort)
    assert not monitor(bad, elite.x[0]).inside


def test_a_state_too_large_for_the_arithmetic_is_outside_and_gives_no_number_to_the_motor(export, loop):
    """V and K x overflow, with both signs among their terms."""
    elite, (control, monitor) = export.bundle.elite, loop
    for signs in itertools.product((-1, 1), repeat=elite.x_goal.size):
        for t in (0.01, 2 * elite.time[-1]):
            x = 1.7e308 * np.array(signs)
            assert np.abs(control(t, x)) <= elite.u_max
            assert bool(monitor(t, x).abort)
            assert not monitor(t, x).inside


def test_before_the_start_its_first_instant_is_held(export, loop):
    elite, (control, monitor) = export.bundle.elite, loop
    x = elite.x[0] + 0.01
    np.testing.assert_array_equal(control(-1.0, x), control(0.0, x))
    assert monitor(-1.0, x).ratio == monitor(0.0, x).ratio


@pytest.mark.thorough
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
    outside, left = outside_limits(elite, x), np.zeros(len(x), bool)
    dt, last = elite.time[1], elite.time[-1]

    def advance(moving, start, end):
        # The input jumps at a knot: what is asked for at an interval's end belongs to that interval.
        def policy(t, xs):
            return np.array([control(min(t, end - 1e-12) if end <= last else t, row) for row in xs])

        beyond = np.zeros(moving.size, bool)
        for now in march(policy, start, end, x[moving]):
            beyond |= outside_limits(elite, now)
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


def changed(folder, row, column, value):
    """The test vectors with one cell replaced."""
    path = folder / "test_vectors.csv"
    lines = path.read_text().splitlines()
    cells = lines[row].split(",")
    cells[column] = value
    lines[row] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


WRONG = {
    "ratio": (7, -4, "1.25"),
    "inside": (-1, -3, "1"),
    "input of no number": (-1, -5, "1.0"),
    "abort": (-1, -2, "0"),
}


@pytest.mark.parametrize("where", WRONG)
def test_the_self_test_passes_and_can_fail(export, tmp_path, where):
    folder = shutil.copytree(export.folder, tmp_path / "copy")
    assert export.module.self_test(folder) < 1e-9
    row, column, value = WRONG[where]
    changed(folder, row, column, value)
    assert export.module.self_test(folder) > 1e-3


@needs_compiler
@pytest.mark.parametrize("options", OPTIMIZED)
def test_the_c_self_test_compiles_without_warnings_passes_and_can_fail(export, tmp_path, options):
    folder, label = shutil.copytree(export.folder, tmp_path / "copy"), export.bundle.label
    sources = [f"{label}_controller_test.c", f"{label}_controller.c"]
    subprocess.run([COMPILER, *STRICT, *options.split(), *sources, "-lm", "-o", "t"], cwd=folder, check=True)
    rows = 400 + 3 * (1 + export.bundle.elite.x_goal.size)
    done = subprocess.run(["./t"], cwd=folder, capture_output=True, text=True)
    assert (done.returncode, done.stdout[:16]) == (0, f"ok: {rows} vectors,")
    original = (folder / "test_vectors.csv").read_text()
    for row, column, value in WRONG.values():
        changed(folder, row, column, value)
        assert subprocess.run(["./t"], cwd=folder, capture_output=True).returncode == 1
        (folder / "test_vectors.csv").write_text(original)
    assert subprocess.run(["./t", "none.csv"], cwd=folder, capture_output=True).returncode == 2


TWO = """
#include <stdio.h>
#include "{one}_controller.h"
#include "{two}_controller.h"

int main(void)
{{
    double x[{ONE}_STATES], y[{TWO}_STATES], u[{ONE}_INPUTS], v[{TWO}_INPUTS];
    {one}_nominal(0.01, x);
    {two}_nominal(0.01, y);
    {one}_control(0.01, x, u);
    {two}_control(0.01, y, v);
    const {one}_monitor a = {one}_watch(0.01, x, {ONE}_ABORT_RATIO);
    const {two}_monitor b = {two}_watch(0.01, y, {TWO}_ABORT_RATIO);
    printf("%.17g %.17g %d %d", u[0], v[0], a.inside, b.inside);
    return 0;
}}
"""


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """The exports of two robots in one folder each, with their bundles."""
    path = tmp_path_factory.mktemp("two")
    bundles = {}
    for plant in ELITES:
        run = run_folder(path / plant, plant)
        export_run(run, 0, path / f"lab_{plant}", Output().console)
        bundles[plant] = read_bundle(run, "000")
    return path, bundles


@pytest.mark.thorough
@needs_compiler
def test_two_exports_live_in_one_c_program(two):
    path, bundles = two
    (one, first), (other, second) = bundles.items()
    (path / "both.c").write_text(
        TWO.format(one=first.label, two=second.label, ONE=first.label.upper(), TWO=second.label.upper())
    )
    folders, sources = [path / f"lab_{plant}" for plant in (one, other)], ["both.c"]
    sources += [
        folder / f"{bundle.label}_controller.c" for folder, bundle in zip(folders, bundles.values(), strict=True)
    ]
    includes = [f"-I{folder}" for folder in folders]
    subprocess.run([COMPILER, *STRICT, *includes, *sources, "-lm", "-o", "both"], cwd=path, check=True)
    done = subprocess.run(["./both"], cwd=path, capture_output=True, text=True, check=True).stdout.split()
    expected = [float(bundle.at(0.01).u[0]) for bundle in bundles.values()]
    np.testing.assert_allclose([float(u) for u in done[:2]], expected, rtol=1e-12)
    assert done[2:] == ["1", "1"]


@pytest.mark.thorough
def test_two_exports_live_in_one_python_process(two):
    """As the folder's README imports them."""
    path, bundles = two
    program = "import sys\n"
    for plant, bundle in bundles.items():
        program += f"sys.path.insert(0, {str(path / f'lab_{plant}')!r})\n"
        program += f"import {bundle.label}_controller as {plant}\nprint(len({plant}.Controller().x_goal))\n"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["2", "4"]


@pytest.mark.thorough
@needs_compiler
def test_two_elites_of_one_robot_are_told_apart_by_a_name(tmp_path):
    run = run_folder(tmp_path / "run", "pendulum")
    for label in ("before", "after"):
        export_run(run, 0, tmp_path / label, Output().console, label)
        assert (tmp_path / label / f"{label}_controller.py").is_file()
        flags = [*STRICT, "-c", f"{label}_controller.c", "-o", f"../{label}.o"]
        subprocess.run([COMPILER, *flags], cwd=tmp_path / label, check=True)
    merged = subprocess.run([shutil.which("ld") or "ld", "-r", "before.o", "after.o", "-o", "both.o"], cwd=tmp_path)
    assert merged.returncode == 0
    with pytest.raises(UserError, match=r"name 'my-robot': must be a letter and up to 63 letters, digits and _"):
        export_run(run, 0, tmp_path / "third", Output().console, "my-robot")
