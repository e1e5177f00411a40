"""The cart-pole: four states, a mass matrix that turns with the pole, a rail."""

import json

import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.prove.certify import certify_elite
from tests.certificate import balance
from tests.certificate.folder import folder_with
from tests.certificate.loops import Simulated, floats
from tests.certificate.test_check import ROUNDING, nudged, refusal, resealed


@pytest.fixture(scope="module")
def proved(tmp_path_factory):
    run = folder_with(tmp_path_factory.mktemp("cartpole"), *balance.elite())
    outcome = certify_elite(run, "000", "proved", lambda step: None)
    assert outcome is not None
    assert outcome.whole
    return json.loads((run / "certificates" / "000.json").read_text())


def ball(count):
    """Half of them on the boundary of the unit ball, half uniform inside."""
    random = np.random.default_rng(0)
    y = random.normal(size=(4, count))
    radius = random.uniform(size=count) ** 0.25
    radius[::2] = 1
    return radius * y / np.linalg.norm(y, axis=0)


@pytest.mark.thorough
def test_the_report_names_the_rail(proved):
    report = check.check(proved)
    words = check.sentence(report)
    assert "|cart| <= 0.3 m all the while" in words
    assert "never exceeds 6 N" in words
    assert report.volumes["goal"] == pytest.approx(np.pi**2 / 2 * np.linalg.det(floats(proved["goal"]["axes"])))
    assert {"free", "high"} <= {case for piece in proved["funnel"] for case in piece["cases"]}


@pytest.mark.thorough
def test_no_motion_leaves_what_is_proved(proved):
    loop = Simulated(proved, rate=lambda x, u, p: balance.rate(x, u, balance.PARAMETERS | p))
    for first in range(len(loop.funnel)):
        levels, at_goal = loop.largest_levels(first, ball(300))
        assert max(levels) <= 1 + ROUNDING
        assert at_goal.max() <= 1 + ROUNDING
        assert at_goal[-1].max() < 0.2
    assert levels[0] > 0.9


@pytest.mark.thorough
def test_the_ellipsoids_are_large_enough_to_matter(proved):
    """The goal region touches the rail, and is far from where the linear model would do."""
    axes = floats(proved["goal"]["axes"])
    widths = np.linalg.norm(axes, axis=1)
    assert widths[0] > 0.2
    assert widths[1] > 0.2


@pytest.mark.parametrize(("name", "share"), [("Mp", 0.5), ("Beq", -0.9), ("lp", 0.7)])
def test_another_robot_is_refused_by_the_proof(proved, name, share):
    content = json.loads(json.dumps(proved))
    content["claim"]["parameters"][name] = nudged(content["claim"]["parameters"][name], share)
    assert refusal(resealed(content))


def test_a_weaker_motor_is_refused_by_the_proof(proved):
    content = json.loads(json.dumps(proved))
    content["claim"]["limit"] = nudged(content["claim"]["limit"], -0.6)
    assert refusal(resealed(content))


def test_a_shorter_rail_is_refused(proved):
    content = json.loads(json.dumps(proved))
    content["claim"]["state_limits"][0] = (0.25).hex()
    assert "the limit on |cart| is not kept" in refusal(resealed(content))
