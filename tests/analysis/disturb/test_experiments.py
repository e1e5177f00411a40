"""Shares, heat maps and scores are what their definitions say, from outcomes made by hand and from simulations."""

import numpy as np
import pytest
import scipy.stats

from rtcd_jax.analysis.disturb import experiments
from rtcd_jax.analysis.disturb.experiments import (
    FACTORS,
    LARGEST_PUSH,
    LEVELS,
    MODEL_ERROR,
    PROFILES,
    PUSH_WIDTH,
    SCORED,
    SIZES,
    TIMES,
    impulse,
    off_nominal,
    perturbations,
    robustness,
)
from rtcd_jax.analysis.disturb.scenarios import STEP, Outcome
from rtcd_jax.export.rate import control_rate


class Judge:
    """In the place of a simulation: remembers the rollouts and lets `verdict(rollouts)` [L] say who succeeds."""

    def __init__(self, verdict):
        self.verdict = verdict

    def __call__(self, rollouts, experiment, settles):
        self.rollouts, self.experiment, self.settles = rollouts, experiment, settles
        good = np.asarray(self.verdict(rollouts))
        return Outcome(np.zeros(len(good), bool), np.where(good, 0.0, 9.0), np.where(good, 1.0, 1.01))


def test_off_nominal_states_fill_the_ellipsoids_and_both_controllers_get_the_same(robots):
    judge = Judge(lambda rollouts: np.arange(len(rollouts.loop)) % 4 != 0)
    record = off_nominal(robots, 40, 3, judge)
    places, loops = len(FACTORS) * 2, 2
    x = np.asarray(judge.rollouts.x).T.reshape(places, loops, 40, -1)
    np.testing.assert_array_equal(x[:, 0], x[:, 1])
    np.testing.assert_array_equal(np.asarray(judge.rollouts.loop).reshape(places, loops, 40)[:, 1], 1)
    for place, states in enumerate(x[:, 0]):
        elite, factor = robots.elites[place // len(FACTORS)], FACTORS[place % len(FACTORS)]
        reach = np.sqrt(elite.value(0, states) / elite.rho[0])
        assert np.all(reach <= factor)
        assert np.all(np.abs(states) <= elite.state_limits)
        if factor == 1 and np.all(np.isinf(elite.state_limits[1:])):
            assert reach.max() > 0.8
    assert list(record["summary"]) == [f"{name} ellipsoid x {f}" for name in ("initial", "best") for f in FACTORS]
    row = record["summary"]["best ellipsoid x 4"]
    assert (row["initial"], row["best"]) == (0.75, 0.75)
    exact = scipy.stats.binomtest(30, 40).proportion_ci(0.95, "exact")
    np.testing.assert_allclose([row["best lower"], row["best upper"]], exact, rtol=1e-12)


def test_pushes_have_the_impulse_and_the_time_of_their_cell(robots):
    """Recovered where the impulse is above a line that rises in time: the map shows that line."""
    limit = robots.elites[0].u_max[0]
    judge = Judge(lambda rollouts: np.asarray(rollouts.heights[0, 0]) > -2 * limit)
    record = impulse(robots, judge)
    assert judge.settles
    area = np.asarray(judge.rollouts.heights[0, 0]) * PUSH_WIDTH * np.sqrt(2 * np.pi)
    cells = area.reshape(2, TIMES, SIZES)
    np.testing.assert_allclose(cells, np.broadcast_to(record["impulses"], cells.shape), atol=1e-12)
    np.testing.assert_allclose(record["impulses"][[0, -1]], [-LARGEST_PUSH * limit, LARGEST_PUSH * limit])
    centers = np.asarray(judge.rollouts.centers[0]).reshape(2, TIMES, SIZES)
    for index, (name, elite) in enumerate(zip(robots.names, robots.elites, strict=True)):
        np.testing.assert_allclose(centers[index, :, 0], record["times"][name])
        np.testing.assert_allclose(record["times"][name][[0, -1]], [3 * PUSH_WIDTH, elite.time[-1]])
        good = record["impulses"] > -2 * limit * PUSH_WIDTH * np.sqrt(2 * np.pi)
        np.testing.assert_array_equal(record["recovered"][name], np.broadcast_to(good, (TIMES, SIZES)))
        told = record["summary"][name]
        assert told["recovered"] == pytest.approx(good.mean())
        assert told["largest_at_all_times"] == pytest.approx(-record["impulses"][good].min())


@pytest.mark.parametrize(
    ("lost", "borne"), [([], 2.0), ([(0, 0)], 1.0), ([(1, 1)], 0.0), ([(1, 2)], 0.0), ([(0, 3), (1, 4)], 0.0)]
)
def test_what_is_borne_at_all_times_ends_below_the_smallest_lost_push(lost, borne):
    impulses = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    recovered = np.ones((2, 5), bool)
    for cell in lost:
        recovered[cell] = False
    assert experiments.largest_tolerated(impulses, recovered) == borne


def test_every_trouble_changes_what_it_names_and_nothing_else(robots):
    random = np.random.default_rng(0)
    plain = experiments.from_start(robots, np.zeros(2, int))
    level = np.array([0.0, 0.01])
    changed = {
        "velocity noise": "velocity_noise", "torque noise": "input_noise", "response time": "lag", "delay": "delay",
        "input limit": "actuator_scale", "dry friction": "friction",
    }  # fmt: skip
    for perturbation in perturbations(robots):
        if perturbation.name in ("perturbation", "control rate", "hold"):
            continue
        rollouts = perturbation.apply(plain, level, random)
        if perturbation.name in changed:
            before, after = (
                np.asarray(getattr(plain, changed[perturbation.name])),
                getattr(rollouts, changed[perturbation.name]),
            )
        else:
            owner = "design" if perturbation.name in robots.plant.design_units else "plant"
            before, after = (
                np.asarray(getattr(getattr(which, owner), perturbation.name)) for which in (plain, rollouts)
            )
            np.testing.assert_allclose(after, before * (1 + level), rtol=1e-12)
        np.testing.assert_array_equal(np.asarray(after)[..., 0], before[..., 0])
        assert np.all(np.asarray(after)[..., 1] != before[..., 1])
    names = [perturbation.name for perturbation in perturbations(robots) if perturbation.criterion == "model"]
    assert "gravity" not in names
    assert "input limit" in names
    assert set(robots.plant.design_units) < set(names)


@pytest.mark.thorough
def test_a_hold_is_so_many_periods_of_the_loop_s_own_export(robots):
    """To whole steps of the simulation, one at least."""
    (hold,) = (perturbation for perturbation in perturbations(robots) if perturbation.name == "hold")
    plain = experiments.from_start(robots, np.repeat([0, 1], len(hold.levels)))
    held = hold.apply(plain, np.tile(hold.levels, 2), None)
    expected = np.outer([control_rate(elite, None).period or STEP for elite in robots.elites], hold.levels)
    np.testing.assert_allclose(np.asarray(held.period).reshape(2, -1) * STEP, expected, atol=0.51 * STEP)
    assert np.all(held.period >= 1)


def test_rates_and_delays_are_whole_steps(robots):
    found = {perturbation.name: perturbation for perturbation in perturbations(robots)}
    for name, seconds in (("delay", found["delay"].levels), ("control rate", 1 / found["control rate"].levels)):
        np.testing.assert_allclose(seconds / STEP, np.round(seconds / STEP), atol=1e-9, err_msg=name)


@pytest.mark.thorough
def test_the_score_is_the_mean_of_six_criteria(robots):
    """Those with a wrong model all fail: the best loop's others succeed, of the initial one's half."""

    def verdict(rollouts):
        nominal = np.isclose(np.asarray(rollouts.actuator_scale), 1)
        for tree, own in ((rollouts.design, robots.design), (rollouts.plant, robots.plant)):
            for name in (field for field in vars(own) if hasattr(getattr(own, field), "shape")):
                truth = np.asarray(getattr(own, name))[np.asarray(rollouts.loop)]
                nominal &= np.isclose(np.asarray(getattr(tree, name)), truth)
        half = np.arange(len(nominal)) % 2 == 0
        return nominal & ((np.asarray(rollouts.loop) == 1) | half)

    judge = Judge(verdict)
    record = robustness(robots, 0, judge)
    assert not judge.settles
    summary = record["summary"]
    assert summary["best"]["model"] == pytest.approx(1 / LEVELS)  # where the error is zero
    for criterion in SCORED[1:]:
        assert summary["best"][criterion] == 1
        assert 0.4 < summary["initial"][criterion] < 0.6
    assert summary["best"]["score"] == pytest.approx((5 + 1 / LEVELS) / 6)
    assert summary["best"]["control rate"] == 1
    told = {perturbation["name"]: perturbation for perturbation in record["troubles"]}
    np.testing.assert_allclose(told["input limit"]["levels"][[0, -1]], [-MODEL_ERROR, MODEL_ERROR])
    np.testing.assert_array_equal(told["input limit"]["success"]["best"], np.arange(LEVELS) == LEVELS // 2)
    assert len(told["perturbation"]["levels"]) == PROFILES


def test_perturbations_are_the_same_for_both_loops(robots):
    rollouts = experiments.pulsed(
        robots, experiments.from_start(robots, np.repeat([0, 1], PROFILES)), np.random.default_rng(1)
    )
    heights = np.asarray(rollouts.heights)
    np.testing.assert_array_equal(heights[..., :PROFILES], heights[..., PROFILES:])
    limit = robots.elites[0].u_max[0]
    assert np.all((np.abs(heights) > 0.07 * limit) & (np.abs(heights) < 0.84 * limit))
    assert 0.3 < np.mean(heights > 0) < 0.7
