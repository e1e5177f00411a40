"""With a certificate the exported monitors evaluate the proved funnel; the stated control rate keeps states in it."""

import json
import subprocess
from dataclasses import replace

import numpy as np
import pytest

from rtcd_jax.certificate.check import Node, Q, read_claim, read_interval
from rtcd_jax.certificate.check.file import read_goal
from rtcd_jax.export import rate, source, tables
from rtcd_jax.export.proof import ProvedFunnel
from rtcd_jax.export.rate import control_rate
from rtcd_jax.plants.model import CpuDynamics
from tests.export.conftest import module
from tests.export.test_controller import COMPILER, OPTIMIZED, STRICT, bind, needs_compiler

pytestmark = pytest.mark.thorough  # exports of proved funnels


@pytest.fixture(scope="module")
def claimed(proved):
    """Of the exported certificate, in exact numbers: its claim, its intervals and its goal's axes."""
    content = json.loads((proved.folder / "certificate.json").read_text())
    claim = read_claim(Node("claim", content["claim"]))
    pieces = [read_interval(Node("funnel", each), claim) for each in content["funnel"]]
    return claim, pieces, read_goal(Node("goal", content["goal"]), claim)[0]


def exactly_inside(claimed, t, x):
    """Whether a pendulum's x is in the claimed set at the time t > start, and how close |y|^2 is to 1; rational."""
    claim, pieces, goal = claimed
    t, x = Q(*t.as_integer_ratio()), [Q(*value.as_integer_ratio()) for value in x.tolist()]
    if t >= claim.dt * len(claim.u):
        center, axes = claim.x_goal, goal
    else:
        k = int(t / claim.dt)
        share = t / claim.dt - k
        piece = next(p for p in pieces if p.knot == k and p.start <= share <= p.end)
        center = [
            (1 + 2 * share) * (1 - share) ** 2 * a
            + share * (1 - share) ** 2 * claim.dt * va
            + share**2 * (3 - 2 * share) * b
            - share**2 * (1 - share) * claim.dt * vb
            for a, va, b, vb in zip(claim.x[k], claim.rates[k][0], claim.x[k + 1], claim.rates[k][1], strict=True)
        ]
        s = (2 * share - piece.start - piece.end) / (piece.end - piece.start)
        axes = [
            [
                (piece.first[i][j] * (1 - s) + piece.last[i][j] * (1 + s)) / 2
                + (1 - s * s) * (piece.bend[0][i][j] + piece.bend[1][i][j] * s)
                for j in range(2)
            ]
            for i in range(2)
        ]
    (a, b), (c, d) = axes
    e, f = (value - middle for value, middle in zip(x, center, strict=True))
    square = ((d * e - b * f) ** 2 + (a * f - c * e) ** 2) / (a * d - b * c) ** 2
    return square <= 1, abs(float(square - 1))


@pytest.fixture(params=["python", *(pytest.param(each, marks=needs_compiler) for each in ("-O2", "-O3 -ffast-math"))])
def monitor(request, proved, tmp_path):
    if request.param == "python":
        return proved.module.Controller().monitor
    library, code = tmp_path / "controller.so", proved.folder / "pendulum_000_controller.c"
    subprocess.run(
        [COMPILER, *STRICT, *request.param.split(), "-shared", "-fPIC", code, "-o", library, "-lm"], check=True
    )
    return bind(library, proved.bundle)[1]


def test_the_monitor_is_the_claims_set_by_exact_evaluation(proved, claimed, monitor):
    random, elite = np.random.default_rng(5), proved.bundle.elite
    verdicts = []
    for t in random.uniform(0, 1.2 * elite.time[-1], 300):
        direction = random.normal(size=2)
        y = random.uniform(0.8, 1.2) * direction / np.linalg.norm(direction)
        now = proved.bundle.at(t)
        x = now.x + now.axes @ y
        inside, close = exactly_inside(claimed, float(t), x)
        assert close > 1e-9  # of the rounding
        watch = monitor(t, x)
        assert bool(watch.proved)
        assert bool(watch.inside) == inside
        verdicts.append(inside)
    assert 50 < sum(verdicts) < 250


def test_the_sampled_funnel_is_another_set(proved):
    """Else the test above could not tell which one the monitor evaluates."""
    proved_axes = np.array([proved.bundle.at(t).axes for t in proved.bundle.elite.time])
    sampled = replace(proved.bundle, proof=None)
    sampled_axes = np.array([sampled.at(t).axes for t in proved.bundle.elite.time])
    ratio = np.linalg.det(proved_axes) / np.linalg.det(sampled_axes)
    assert np.abs(ratio - 1).max() > 0.01


def random_proof(bundle, first):
    """Ellipsoids from the knot `first` on, of all shapes, two to an interval; nothing that anybody has proved."""
    random, n, last = np.random.default_rng(6), bundle.elite.x_goal.size, len(bundle.elite.u)
    begins = np.append(np.arange(first, last, 0.5), last)
    axes = random.normal(size=(len(begins), 4, n, n)) * [[[[1.0]], [[0.1]], [[0.05]], [[0.02]]]]
    axes[-1, 1:] = 0
    axes[0, 0, 0, 0] = 0.0  # asks for a pivot
    return ProvedFunnel(begins, axes, bundle.rates, np.zeros(len(begins)))


@needs_compiler
@pytest.mark.parametrize("first", [0, 1])
def test_both_languages_evaluate_any_ellipsoids_and_the_sampled_ones_before_they_begin(export, tmp_path, first):
    bundle = replace(export.bundle, proof=random_proof(export.bundle, first))
    for name, text in {**source.sources(bundle), "test_vectors.csv": tables.vectors(bundle)}.items():
        (tmp_path / name).write_text(text)
    np.savez(tmp_path / f"{bundle.label}_controller.npz", **bundle.arrays())
    begun = np.loadtxt(tmp_path / "test_vectors.csv", delimiter=",", skiprows=1)[:400, -1]
    assert begun.all() == (first == 0)
    assert begun.any()
    assert module(tmp_path / f"{bundle.label}_controller.py").self_test(tmp_path) < 1e-7
    sources = [f"{bundle.label}_controller_test.c", f"{bundle.label}_controller.c"]
    for options in OPTIMIZED:
        subprocess.run([COMPILER, *STRICT, *options.split(), *sources, "-lm", "-o", "t"], cwd=tmp_path, check=True)
        subprocess.run(["./t"], cwd=tmp_path, check=True, capture_output=True)


def test_called_at_the_stated_rate_the_exported_controller_keeps_the_boundary_inside(proved):
    """The Python controller and its own monitor, C MuJoCo as the robot; calls fall on every knot."""
    found, elite = proved.bundle.control_rate, proved.bundle.elite
    told = json.loads((proved.folder / "pendulum_000_controller.json").read_text())["control_rate"]
    assert (told["least"], told["period"], told["calls_an_interval"]) == (found.rate, found.period, found.divisor)
    assert f"{found.states} states on the funnel's boundary" in (proved.folder / "README.md").read_text()
    assert found.divisor * found.period == pytest.approx(elite.time[1], rel=1e-15)
    controller, f = proved.module.Controller(), CpuDynamics(proved.bundle.model, 3)
    random = np.random.default_rng(7)
    for k in np.arange(20) % len(elite.u):
        direction = random.normal(size=2)
        t, x = elite.time[k], elite.x[k] + proved.bundle.at(elite.time[k]).axes @ direction / np.linalg.norm(direction)
        for call in range(found.divisor * (len(elite.u) - k)):
            t = elite.time[k] + call * found.period + 1e-12  # on the knot's later side
            x = held(f, x, controller.control(t, x), found.period)
            assert controller.monitor(t + found.period, x).ratio <= 1 + 1e-6


def held(f, x, u, period):
    h = period / 4
    for _ in range(4):
        k1 = f(x[None], u[None])[0]
        k2 = f((x + h / 2 * k1)[None], u[None])[0]
        k3 = f((x + h / 2 * k2)[None], u[None])[0]
        k4 = f((x + h * k3)[None], u[None])[0]
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def test_the_next_slower_tried_rate_loses_some(export):
    """And where no tried rate keeps all, that is said."""
    found = export.bundle.control_rate
    slower = [divisor for divisor in rate.DIVISORS if found.divisor and divisor < found.divisor]
    if slower:
        assert found.failed[slower[-1]] > 0
    assert found.failed[found.divisor] == 0


def test_where_no_tried_rate_suffices_that_is_said(export, monkeypatch):
    elite = export.bundle.elite
    gains = replace(elite, K=30 * elite.K, K_goal=30 * elite.K_goal)  # a loop that no slow call can hold
    monkeypatch.setattr(rate, "DIVISORS", (1, 2))
    found = control_rate(gains, None)
    assert (found.divisor, found.rate, found.period) == (None, None, None)
    assert found.sentence.startswith("no tried rate suffices for ")
    assert all(found.failed.values())
