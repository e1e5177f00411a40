"""The value function optimized with the funnel: its linear programs beside differences, its funnels beside proofs."""

import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.enlarge import all_knots as joint
from rtcd_jax.certificate.prove import certify as elite
from rtcd_jax.certificate.prove.closed_loop import Loop
from rtcd_jax.certificate.prove.goal import goal_region
from rtcd_jax.certificate.prove.levels import DECAY_MARGIN, FRACTIONS, goal_level, leveled, merit, unit_directions
from rtcd_jax.elite.elite import Elite
from tests.certificate import swing
from tests.certificate.folder import folder_with
from tests.certificate.test_certify import claimed
from tests.certificate.test_goal import PAPER, Upright

DIRECTIONS = unit_directions(2)


def loop_of(arrays=None, **record):
    stored, told = swing.elite()
    elite = Elite.of({**stored, **(arrays or {})}, {**told, **record})
    return Loop(claimed(elite), elite)


@pytest.fixture(scope="module")
def funnel():
    """A funnel of TVLQR's shapes, its levels 1, without a limit on the speed."""
    return leveled(loop_of(state_limits=[None, None]), DIRECTIONS)


def fastest(loop):
    """The largest V' / V on the boundaries of every interval's instants, and at the goal."""
    growth = [loop.growth(k, fraction, 1.0, DIRECTIONS) for k in range(len(loop.u)) for fraction in FRACTIONS]
    return np.array([*growth, loop.goal_growth(1.0, DIRECTIONS)])


@pytest.mark.thorough
def test_levels_become_one(funnel):
    """V falls everywhere at the decay margin, no faster where the funnel is tightest; the goal's level is 1."""
    assert goal_level(funnel, DIRECTIONS) == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(fastest(funnel)[:-1], -DECAY_MARGIN, atol=3e-3)
    again = leveled(funnel, DIRECTIONS)
    np.testing.assert_allclose(np.linalg.det(again.values), np.linalg.det(funnel.values), rtol=2e-3)


def test_what_a_program_gains_is_the_merit_s_derivative(funnel):
    program, random = joint.Program(funnel, 1.0), np.random.default_rng(0)
    for _ in range(3):
        x = random.normal(size=program.radius.size)
        step = 1e-5
        ahead, behind = (merit(program.changed(sign * step * x)) for sign in (1, -1))
        assert program.gain() @ x == pytest.approx((ahead - behind) / (2 * step), rel=1e-6)


def test_a_short_step_keeps_v_falling_to_first_order(funnel, monkeypatch):
    """What it makes of V' beyond the decay margin in the directions asked for is of second order, the gain of first."""
    monkeypatch.setattr(joint, "DIRECTION_STRIDE", 1)
    monkeypatch.setattr(joint, "DIRECTIONS_PER_INSTANT", DIRECTIONS.shape[1])
    beyond, gains = [], []
    for trust in (0.02, 0.01):
        after = joint.changed(funnel, trust)
        beyond.append(np.max(fastest(after) - np.maximum(fastest(funnel), -DECAY_MARGIN)))
        gains.append(merit(after) - merit(funnel))
    assert beyond[0] < 2 * 0.02**2
    assert beyond[1] < 2 * 0.01**2
    assert gains[1] == pytest.approx(gains[0] / 2, rel=0.05)
    assert gains[1] > 0.005


def test_limits_on_the_states_are_kept_to_first_order():
    loop = leveled(loop_of(state_limits=[0.7, 6.0]), DIRECTIONS)
    most = 0.0
    for _ in range(6):
        loop = joint.changed(loop, 0.1)
        loop = leveled(loop, DIRECTIONS)
        for k in range(len(loop.u)):
            for fraction in FRACTIONS:
                widths = np.sqrt(np.diag(np.linalg.inv(loop.value(k, fraction)[0])))
                most = max(most, np.max(widths / loop.clearance(k, fraction)))
    assert 0.97 < most < 1.005


def test_a_loop_without_a_funnel_stays_as_it_is():
    arrays, _ = swing.elite()
    loop = loop_of({"K_goal": -arrays["K_goal"]})
    assert elite.largest(loop) is loop


@pytest.mark.thorough
def test_its_funnels_are_larger_and_proved(tmp_path):
    arrays, record = swing.elite()
    sums = []
    for name, freed in (("tvlqr", False), ("free", True)):
        run = folder_with(tmp_path / name, arrays, record)
        outcome = elite.certify_elite(run, "000", "proved", lambda step: None, optimize_value=freed)
        assert outcome.whole
        assert check.check_file(run / "certificates" / "000.json").volumes == outcome.volumes
        sums.append(outcome.volumes["sum"])
    assert sums[1] > 1.5 * sums[0]


@pytest.mark.thorough
def test_a_goal_region_of_free_shape_is_larger_and_all_of_it_arrives():
    upright = Upright(PAPER, (10.0, 1.0), 1.0)
    free = elite.largest(upright.loop)
    region = goal_region(upright.claim, free, exact=True)
    axes = np.array([[float(c) for c in row] for row in region.axes])
    assert np.pi * np.linalg.det(axes) > 1.5 * upright.area(upright.rho)
    upright.S, upright.rho = np.linalg.inv(axes @ axes.T), 1.0
    error, _ = upright.grid()
    assert np.all(upright.arrive(error[:, upright.value(error) <= 1], duration=20.0))
