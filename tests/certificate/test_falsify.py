"""Falsification: what is proved survives, what is claimed wrongly does not, the integrator's error is as it says."""

import copy
import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rtcd_jax.certificate.falsify import falsify
from rtcd_jax.certificate.falsify.falsify import TOLERANCE, Part, enough_steps, falsify_file, summed
from rtcd_jax.certificate.falsify.robots import draw
from rtcd_jax.certificate.falsify.simulation import TOGETHER, Acting, Motions
from rtcd_jax.cli import main as cli
from tests.certificate import swing
from tests.certificate.loops import floats
from tests.certificate.test_check import nudged, resealed
from tests.consoles import Screen, Stopped


def random():
    return np.random.default_rng(3)


def test_what_is_proved_is_not_falsified(content):
    motions = Motions(content)
    steps = enough_steps(motions, seed=0)
    found = summed([Part.of(motions.follow(600, steps, random()))], steps)
    assert found.broken == 0
    assert found.rollouts == 600
    assert 0.999 < found.level < 1
    assert 0.9 < found.share_of_limit < 1
    assert 0 < found.error <= 2 * TOLERANCE
    assert found.allowance == pytest.approx(2 * found.error)


FALSE = {
    "a weaker motor": (lambda c: c["claim"], "limit", -0.6, "left_funnel"),
    "a gain of the other sign": (lambda c: c["claim"]["K"][2], 0, -3.0, "left_funnel"),
    "a weaker gain at the goal": (lambda c: c["claim"]["K_goal"], 0, -0.9, "not_arrived"),
    "a slower limit": (lambda c: c["claim"]["state_limits"], 1, -0.1, "left_limits"),
}


@pytest.mark.parametrize("claim", FALSE)
def test_what_is_wrong_is_falsified(content, claim):
    container, key, share, broken = FALSE[claim]
    wrong = copy.deepcopy(content)
    where = container(wrong)
    where[key] = nudged(where[key], share)
    assert getattr(summed([Part.of(Motions(resealed(wrong)).follow(300, 8, random()))], 8), broken) > 0


def test_motions_that_are_lost_are_followed_no_further(content):
    """From the funnel of a nominal motion that is a thousand times as large: one look at the goal, not a minute."""
    wide = copy.deepcopy(content)
    wide["claim"]["x"] = [[(1000 * float.fromhex(value)).hex() for value in row] for row in wide["claim"]["x"]]
    motions = Motions(resealed(wide))
    steps_taken = []

    def settling(*arguments):
        steps_taken.append(arguments)
        return Motions.advanced(motions, *arguments)

    motions.advanced = settling
    found = motions.follow(64, 4, random())
    longest = 4 * motions.dt / 4
    assert len(steps_taken) <= 4 * len(motions.intervals) * 4 + TOGETHER / longest + 1
    assert not found.arrived.any()


def test_motions_are_those_of_an_outside_integrator(content):
    """One motion from the inlet to t_N, beside scipy's at 1e-12."""
    motions = Motions(content)
    y = np.array([0.6, -0.8])
    x = motions.nominal(0, 0.0) + motions.intervals[0].axes(0.0) @ y
    gains, inputs = floats(content["claim"]["K"]), floats(content["claim"]["u"])
    acting = Acting(draw(motions.claim, 1, 1.0, random()), np.ones(1), None)
    for k, u in enumerate(inputs):

        def slope(t, x, k=k, u=u):
            share = t / swing.DT
            gain = (1 - share) * gains[k] + share * gains[k + 1]
            return swing.rate(x, np.clip(u - gain @ (x - motions.nominal(k, share)), -2.5, 2.5))

        outside = solve_ivp(slope, (0, swing.DT), x, rtol=1e-12, atol=1e-12, max_step=1e-3).y[:, -1]
        ours = x[:, None]
        for i in range(64):
            ours = motions.advanced(motions.tracking(k), i * swing.DT / 64, swing.DT / 64, ours, 1, acting)
        np.testing.assert_allclose(ours[:, 0], outside, rtol=0, atol=1e-7)
        x = outside


def test_halved_steps_measure_the_error(content):
    """At the input's limit the order is two: the error falls to about a quarter, not by accident to nothing."""
    motions = Motions(content)
    errors = [motions.follow(300, steps, random()).error for steps in (2, 8, 32)]
    assert errors[0] > 4 * errors[1] > 16 * errors[2] > 0


@pytest.mark.thorough
def test_the_command_line(run, tmp_path, capsys):
    command = ["falsify", str(run), "--rollouts", "200"]
    assert cli.main(command) == 0
    first = capsys.readouterr().out
    assert "200 simulated motions of the pendulum from instants all over [0 s, 0.2 s]" in first
    assert "0 left the funnel" in first
    assert cli.main(["falsify", str(run / "certificates" / "000.json"), "--rollouts", "200", "--workers", "1"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == first.splitlines()[-1]
    wrong = json.loads((run / "certificates" / "000.json").read_text())
    wrong["claim"]["u"][1] = nudged(wrong["claim"]["u"][1], 0.3)
    file = tmp_path / "wrong.json"
    file.write_text(json.dumps(wrong))
    assert cli.main(["falsify", str(file), "--rollouts", "200"]) == 2
    assert "was changed: its digest is another" in capsys.readouterr().err


@pytest.mark.thorough
def test_a_killed_falsification_goes_on(run, tmp_path, monkeypatch):
    monkeypatch.setattr(falsify, "CHUNK", 64)
    file = tmp_path / "000.json"
    file.write_bytes((run / "certificates" / "000.json").read_bytes())
    whole, killed, resumed = Screen(), Screen(stop="128/200 motions"), Screen()
    assert falsify_file(file, 200, 0, 1, whole.console)
    with pytest.raises(Stopped):
        falsify_file(file, 200, 0, 1, killed.console)
    assert falsify_file(file, 200, 0, 1, resumed.console)
    done = [
        [text for text in ("64/200", "128/200", "192/200", "200/200") if text in screen.text]
        for screen in (whole, resumed)
    ]
    assert done == [["64/200", "128/200", "192/200", "200/200"], ["192/200", "200/200"]]
    told = [[line for line in screen.text.splitlines() if "left the funnel" in line] for screen in (whole, resumed)]
    assert told[0] == told[1] != []
    assert [path.name for path in tmp_path.iterdir()] == ["000.json"]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["none.json"], "none.json: No such file or directory"),
        (["."], ".: is no run folder: it has no format.json"),
        (["none.json", "--rollouts", "0"], "--rollouts = 0: must be >= 1"),
        (["none.json", "--seed", "-1"], "--seed = -1: must be >= 0"),
    ],
)
def test_wrong_input_is_refused(arguments, reason, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["falsify", *arguments]) == 2
    assert reason in capsys.readouterr().err
