"""`rtcd disturb` on a run folder: records and figures, deterministic by seed, and clear refusals."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from rtcd_jax.analysis import disturb
from rtcd_jax.analysis.disturb import comparison as comparing
from rtcd_jax.analysis.disturb import disturb_run, experiments
from rtcd_jax.analysis.disturb.comparison import Meter, motions, read_comparison, run
from rtcd_jax.analysis.disturb.experiments import SCORED
from rtcd_jax.analysis.disturb.scenarios import undisturbed
from rtcd_jax.elite.closed_loop import runge_kutta, simulate
from rtcd_jax.elite.records import read_elite, write_elite
from rtcd_jax.elite.simulators import simulators_of
from rtcd_jax.system.console import silent
from rtcd_jax.system.errors import UserError
from tests.consoles import Screen
from tests.export.folders import run_folder

NAMES = ("off_nominal", "impulse", "push_margin", "robustness")


SMALL = {
    experiments: {"FACTORS": (1, 4), "TIMES": 5, "SIZES": 7, "KICKS": 4, "LEVELS": 5, "REPEATS": 2, "PROFILES": 6},
    disturb: {"FACTORS": (1, 4), "TIMES": 5, "SIZES": 7, "KICKS": 4},
    comparing: {"BATCH": 256, "REPORTED": 0.0},
}


@pytest.fixture(scope="module", autouse=True)
def small():
    """Experiments that take a second."""
    with pytest.MonkeyPatch.context() as patch:
        for module, values in SMALL.items():
            for name, value in values.items():
                patch.setattr(module, name, value)
        yield


@pytest.fixture(scope="module")
def disturbed(small, tmp_path_factory):
    """A disturbed run folder, what it said, and the bytes of its records."""
    folder = run_folder(tmp_path_factory.mktemp("disturbed") / "run", "pendulum")
    screen = Screen()
    disturb_run(folder, 30, 5, screen.console)
    return folder, screen.text, {name: (folder / "disturbance" / f"{name}.json").read_bytes() for name in NAMES}


@pytest.mark.thorough
def test_every_experiment_leaves_its_record_and_its_figures(disturbed):
    folder, text, records = disturbed
    for name, content in records.items():
        record = json.loads(content)
        assert record["plant"] == "pendulum"
        assert record["config_hash"] == "0123456789ab"
        assert all(isinstance(row, dict) for row in record["summary"].values())
        for suffix in ("png", "pdf"):
            assert (folder / "disturbance" / f"{name}.{suffix}").stat().st_size > 1000
    robust = json.loads(records["robustness"])["summary"]
    for criteria in robust.values():
        assert criteria["score"] == pytest.approx(np.mean([criteria[name] for name in SCORED]))
    for words in (
        "robustness   100%  elapsed",
        "best ellipsoid x 1",
        "recovered",
        "score",
        "control rate",
        "sudden ones up to [N m s]",
        "4 records and 8 figures",
    ):
        assert words in text


@pytest.mark.thorough
def test_a_push_inside_the_funnel_is_recovered_from_and_one_that_only_a_false_level_contains_is_not(pendulums):
    """The margin is never above what is tolerated; with levels that are far too large it is, and 0 is tolerated."""
    false = dataclasses.replace(pendulums.elites[1], rho=900 * pendulums.elites[1].rho)
    comparison = dataclasses.replace(pendulums, elites=(pendulums.elites[0], false))
    record = experiments.push_margin(
        comparison, lambda rollouts, name, settles: run(comparison, rollouts, 0, name, Meter(silent(), 1), settles)
    )
    inside, tolerated = (
        np.array([record[key][name] for name in comparison.names]) for key in ("inside_funnel", "tolerated")
    )
    assert np.all(tolerated[0] >= inside[0])
    p = comparison.elites[0].parameters
    expected = p["m"] * p["l"] ** 2 * np.sqrt(comparison.elites[0].rho / comparison.elites[0].S[:, 1, 1])
    np.testing.assert_allclose(inside[0], expected, rtol=1e-8)
    assert np.all(tolerated[1] == 0)
    assert record["summary"]["initial"]["push_margin"] == pytest.approx(expected.min())
    assert record["summary"]["best"]["tolerated_at_all_times"] == 0


@pytest.mark.thorough
def test_the_same_seed_gives_the_same_records_and_another_one_others(disturbed, tmp_path):
    folder, _, records = disturbed
    copy = shutil.copytree(folder, tmp_path / "copy")
    disturb_run(copy, 30, 5, Screen().console)
    for name, content in records.items():
        assert (copy / "disturbance" / f"{name}.json").read_bytes() == content
    read = json.loads(records["off_nominal"])
    assert read["seed"] == 5
    assert read["states"] == 30
    assert read["factors"] == [1, 4]


@pytest.mark.thorough
def test_verdicts_are_the_verifications(tmp_path):
    """Uniform states of the first ellipsoid, and others twelve times as far: arrived or not, state by state."""
    folder = run_folder(tmp_path / "run", "pendulum")
    comparison = read_comparison(folder, Screen().console)
    elite = comparison.elites[1]
    x = elite.points(np.zeros(60, int), np.random.default_rng(0))
    x[::2] = elite.x[0] + 3 * (x[::2] - elite.x[0])
    rollouts = undisturbed(comparison.plant, comparison.design, np.ones(60, int), x.T)
    found = run(comparison, rollouts, 0, "", Meter(silent(), 1), settles=True)
    simulator = next(simulators_of(elite, 60))
    seen = simulate(elite, simulator.dynamics, runge_kutta(simulator.dynamics, 2e-3), np.zeros(60, int), x)
    lost = found.left_limits | ~(found.final <= 1e-3)
    assert 0 < lost.sum() < 60
    np.testing.assert_array_equal(lost, seen.left_limits | seen.missed_goal)


@pytest.mark.thorough
def test_a_batch_that_may_end_early_gives_the_verdicts_of_one_that_may_not(pendulums):
    elite = pendulums.elites[0]
    x = elite.points(np.zeros(40, int), np.random.default_rng(2))
    rollouts = undisturbed(pendulums.plant, pendulums.design, np.zeros(40, int), x.T)
    early, late = (run(pendulums, rollouts, 0, "", Meter(silent(), 1), settles) for settles in (True, False))
    np.testing.assert_array_equal(early.left_limits, late.left_limits)
    np.testing.assert_array_equal(early.final <= 1e-3, late.final <= 1e-3)
    assert np.all(late.final[~late.left_limits] <= late.held[~late.left_limits])


def test_batches_are_full_and_outcomes_are_as_many_as_lanes(pendulums):
    assert [motions(count) for count in (1, 256, 257)] == [256, 256, 512]
    x = np.tile(pendulums.elites[0].x[0], (259, 1))
    rollouts = undisturbed(pendulums.plant, pendulums.design, np.zeros(259, int), x.T)
    outcome = run(pendulums, rollouts, 0, "", Meter(silent(), 1), settles=True)
    assert outcome.final.shape == (259,)
    np.testing.assert_array_equal(outcome.final, outcome.final[0])


def test_an_initial_candidate_without_a_funnel_is_left_out(tmp_path):
    folder = run_folder(tmp_path / "run", "pendulum")
    arrays, record = read_elite(folder, "initial")
    write_elite(folder, "initial", arrays, record | {"status": "FUNNEL_EMPTY"})
    screen = Screen()
    assert read_comparison(folder, screen.console).names == ("best",)
    assert screen.text == "the initial candidate has no funnel (FUNNEL_EMPTY): the best elite is disturbed alone\n"


def test_a_run_without_elites_is_refused(tmp_path):
    (tmp_path / "format.json").touch()
    with pytest.raises(UserError, match="has no elites yet: finish the run first"):
        disturb_run(tmp_path, 10, 0, Screen().console)


def test_progress_on_a_terminal_says_what_is_left(monkeypatch):
    monkeypatch.setattr(comparing, "REPORTED", 0.0)
    screen = Screen()
    with screen.console as console:
        meter = Meter(console, 1000)
        meter.tick("impulse", 5)
        meter.tick("impulse", 245)
    assert "impulse        0%  elapsed 0:00  left unknown" in screen.text
    assert "impulse       25%  elapsed 0:00  left 0:00" in screen.text
