"""From a run folder to certificates: stored step by step, resumed after a kill, told in a table."""

import json

import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.prove import backward
from rtcd_jax.certificate.prove import certify as elite
from rtcd_jax.certificate.prove.closed_loop import Loop, claim_of
from rtcd_jax.certificate.prove.levels import followed, unit_directions
from rtcd_jax.certificate.prove.run import Pace, certify_run, rank_correlation
from rtcd_jax.cli import main as cli
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import write_elite
from rtcd_jax.system.errors import UserError
from tests.certificate import swing
from tests.certificate.claims import claimed
from tests.certificate.folder import folder_with
from tests.certificate.test_check import resealed
from tests.consoles import Screen


def folder_of(path, **changed):
    arrays, record = swing.elite()
    return folder_with(path, {**arrays, **changed}, record)


def test_the_claim_is_the_elite_bit_by_bit(content):
    arrays, record = swing.elite()
    claim = check.read_claim(check.Node("claim", content["claim"]))
    for name, value in (("x", claim.x), ("u", claim.u), ("K", claim.K), ("x_goal", claim.x_goal)):
        stored = arrays[name].reshape(np.shape(value))
        assert [float(c) for c in np.ravel(value)] == stored.ravel().tolist()
    assert float(claim.dt) == swing.DT
    limit = {"torque_limit": float(claim.limits[0])}
    assert {key: float(low) for key, (low, _) in claim.parameters.items()} | limit == swing.PARAMETERS
    assert all(low == high for low, high in (*claim.parameters.values(), claim.limits))
    assert (claim.disturbance, claim.age, *claim.noise) == (0, 0, 0, 0)
    assert [float(b) for b in claim.bounds] == record["state_limits"]
    rates = np.array([[[float(c) for c in end] for end in pair] for pair in claim.rates])
    for k, u in enumerate(arrays["u"][:, 0]):
        np.testing.assert_allclose(rates[k], [swing.rate(arrays["x"][k + end], u) for end in (0, 1)], rtol=1e-13)


def test_its_shape_is_the_riccati_equation_s():
    """Between knots S follows the equation that the elite's S solves, and L its rate."""
    elite = Elite.of(*swing.elite())
    loop = Loop(claimed(elite), elite)
    finer, _ = swing.elite(tuple(np.repeat([1.2, 1.0, 0.7, 0.4], 1)))
    np.testing.assert_allclose(loop.value(1, 0.0)[0], finer["S"][1])
    step = 1e-5
    for share in (0.2, 0.7):
        slope = (loop.value(2, share + step)[0] - loop.value(2, share - step)[0]) / (2 * step * swing.DT)
        np.testing.assert_allclose(loop.value(2, share)[1], slope, rtol=1e-5, atol=1e-5)
        axes, rates = loop.axes(2, share, 3.0, 0.7)
        np.testing.assert_allclose(axes @ axes.T, 3 * np.linalg.inv(loop.value(2, share)[0]), rtol=1e-12)
        ahead = loop.axes(2, share + step, 3.0 * np.exp(0.7 * step * swing.DT), 0.7)[0]
        np.testing.assert_allclose(rates, (ahead - axes) / (step * swing.DT), rtol=1e-2, atol=1e-2)
        assert axes[0, 1] == 0


def test_levels_are_as_large_as_the_loop_allows(content):
    """The proved funnel gives away little: its outlet touches the limit on the speed, or V would rise on it."""
    axes = np.array([[float.fromhex(c) for c in row] for row in content["goal"]["axes"]])
    assert 6.9 < np.linalg.norm(axes[1]) <= 7
    decay_margins = [each.decay_margin for each in steps_of(swing.elite())]
    assert max(decay_margins) <= 0.04


@pytest.mark.parametrize("limits", [None, [10.0, 7.0]])
def test_levels_follow_the_growth_of_v_within_an_interval(limits):
    """|y| falls between the instants too, by hardly more than it must, and no limit is exceeded."""
    arrays, record = swing.elite()
    elite = Elite.of(arrays, {**record, **({"state_limits": limits} if limits else {})})
    loop, directions, rho, k = Loop(claimed(elite), elite), unit_directions(2), 15.0, 1
    level, course = followed(loop, k, 0.0, 1.0, rho, 0.04, directions)
    rises = []
    for t in np.linspace(0, 1, 33):
        axes, rate = course.at(t, loop.dt)
        rises.append(loop.rise(k, t, axes, rate, directions))
        assert np.all(np.linalg.norm(axes, axis=1) <= loop.clearance(k, t))
    assert -0.1 < max(rises) < 0
    np.testing.assert_allclose(course.first @ course.first.T, level * np.linalg.inv(loop.value(k, 0.0)[0]), rtol=1e-9)
    np.testing.assert_allclose(course.last @ course.last.T, rho * np.linalg.inv(loop.value(k, 1.0)[0]), rtol=1e-9)


def steps_of(stored):
    elite = Elite.of(*stored)
    claim = claimed(elite)
    proof = backward.BackwardProof(claim, Loop(claim, elite), exact=False)
    return list(proof.intervals_from(proof.outlet(15.0)))


@pytest.mark.thorough
def test_a_share_of_the_sampled_levels_is_proved_at_most(tmp_path):
    arrays, _ = swing.elite()
    share, sampled = 0.01, np.full(len(arrays["rho"]), 20.0)
    run = folder_of(tmp_path, rho=sampled)
    volumes = []
    for part in (1.0, share):
        outcome = elite.certify_elite(run, "000", "proved", lambda step: None, share=part)
        assert outcome is not None
        assert outcome.whole
        volumes.append(outcome.volumes)
    assert all(volumes[1][name] < volumes[0][name] for name in volumes[0])
    content = json.loads((run / "certificates" / "000.json").read_text())
    stored = Elite.read(run, "000")
    loop = Loop(claimed(stored), stored)
    for each in content["funnel"]:
        interval = check.read_interval(check.Node("funnel", each), loop.claim)
        axes = np.array(interval.first, float)
        s = loop.value(interval.knot, float(interval.start))[0]
        assert np.linalg.eigvalsh(axes.T @ s @ axes).max() <= share * sampled[0] * (1 + 1e-6)


def test_a_gain_of_the_wrong_sign_cannot_be_proved(tmp_path):
    arrays, _ = swing.elite()
    run = folder_of(tmp_path, K_goal=-arrays["K_goal"])
    assert elite.certify_elite(run, "000", "proved", lambda step: None) is None


def test_a_funnel_that_ends_before_the_start_is_told(tmp_path):
    """Pushed away from the nominal in the first interval, as if u* were another: the later part is proved still."""
    arrays, _ = swing.elite()
    u = arrays["u"].copy()
    u[0] -= 40.0
    run = folder_of(tmp_path, u=u)
    screen = Screen()
    assert not certify_run(run, 1, "proved", 1, screen.console)
    report = check.check_file(run / "certificates" / "000.json")
    assert 0 < report.start <= swing.DT
    assert any(line.split()[:2] == ["000", "0.05"] for line in screen.text.splitlines())


@pytest.mark.thorough
@pytest.mark.parametrize("rung", ["certified", "proved"])
def test_a_run_is_certified_in_processes_of_its_own(tmp_path, rung):
    run, screen = folder_of(tmp_path), Screen()
    assert certify_run(run, 1, rung, 2, screen.console)
    summary = json.loads((run / "certificates" / "summary.json").read_text())["000"]
    report = check.check_file(run / "certificates" / "000.json")
    assert summary["rung"] == rung
    assert summary["found"] == report.volumes
    assert f"volumes: sampled / {rung}" in screen.text
    assert "elite 000  interval 1/" in screen.text, "drawn on the terminal"
    assert "back to t = 0.000 s" in screen.text
    assert not list((run / "certificates").glob(".*"))


@pytest.mark.thorough
def test_another_solver_proves_the_funnel_too(tmp_path, content):
    """By the same checker, to nearly the same levels."""
    run, screen = folder_of(tmp_path), Screen()
    assert certify_run(run, 1, "proved", 1, screen.console, solver="scs")
    other = check.check_file(run / "certificates" / "000.json")
    assert other.notes["solver"] == "SCS"
    assert other.volumes["sum"] == pytest.approx(check.check(content).volumes["sum"], rel=0.01)


def refuse_to_prove(*_):
    raise AssertionError("a finished proof is made again")


@pytest.mark.thorough
def test_a_finished_proof_is_not_made_again(tmp_path, monkeypatch):
    """The same file, and the table of it; another way, another claim or another file is proved."""
    run, first, second = folder_of(tmp_path), Screen(), Screen()
    assert certify_run(run, 1, "proved", 1, first.console)
    file, summary = run / "certificates" / "000.json", run / "certificates" / "summary.json"
    before = file.read_bytes(), summary.read_text()
    with monkeypatch.context() as patch:
        patch.setattr(elite, "goal_region", refuse_to_prove)
        assert elite.certify_elite(run, "000", "proved", lambda step: None) is not None
        for change in (
            {"solver": "SCS"},
            {"optimize_value": True},
            {"guarantee": "certified"},
            {"uncertainty": _file(tmp_path / "w.yaml", "input: 0.01")},
        ):
            how = {"guarantee": "proved", **change}
            with pytest.raises(AssertionError, match="made again"):
                elite.certify_elite(run, "000", on_step=lambda step: None, **how)
    assert certify_run(run, 1, "proved", 1, second.console)
    assert (file.read_bytes(), summary.read_text()) == before
    assert "before" in second.text
    assert "interval 1/4  back to" not in second.text
    for damaged in (
        before[0][:-100],
        before[0].replace(b'"goal":{"axes"', b'"goal":{ "axes"', 1)[:-9],
        _forged(before[0]),
    ):
        file.write_bytes(damaged)
        monkeypatch.setattr(elite, "goal_region", refuse_to_prove)
        with pytest.raises(AssertionError, match="made again"):
            elite.certify_elite(run, "000", "proved", lambda step: None)


def _file(path, text):
    path.write_text(text)
    return path


def _forged(file):
    """With another funnel, whole and under the same task: it proves nothing."""
    content = json.loads(file)
    content["funnel"][1]["cases"]["free"]["gram"][0][0] = (-1.0).hex()
    return json.dumps(resealed(content)).encode()


@pytest.mark.thorough
def test_an_elite_is_proved_by_one_process_at_a_time(tmp_path):
    run = folder_of(tmp_path)
    seen = []

    def meanwhile(step):
        if not seen:
            seen.append(step)
            with pytest.raises(UserError, match=r"elite 000 of .* is in use by process \d+ on .*: it is being proved"):
                elite.certify_elite(run, "000", "proved", meanwhile)

    assert elite.certify_elite(run, "000", "proved", meanwhile) is not None
    assert seen
    assert not list((run / "certificates").glob(".*"))


@pytest.mark.thorough
def test_summaries_of_several_processes_keep_each_other_s_elites(tmp_path):
    run = folder_of(tmp_path)
    arrays, record = swing.elite()
    write_elite(run / "elites", "001", arrays, {"status": "OK", **record})
    for name in ("001", "000"):
        assert certify_run(run, 8, "certified", 1, Screen().console, only=name)
    assert json.loads((run / "certificates" / "summary.json").read_text()).keys() == {"000", "001"}
    with pytest.raises(UserError, match="has no elite 007; there are 000, 001"):
        certify_run(run, 8, "certified", 1, Screen().console, only="007")


def test_the_time_left_is_that_of_the_intervals_that_are_left():
    """Whatever the goal's region took, and whatever was there from a former call."""
    pace = Pace(["000"], 1)
    assert np.isnan(pace.left)
    pace.step("000", 0.1, 220.0)  # the region of the goal, and the first interval
    assert np.isnan(pace.left)
    pace.step("000", 0.2, 230.0)
    assert pace.left == pytest.approx(80.0)
    resumed = Pace(["000"], 1)
    resumed.step("000", 0.9, 20.0)
    resumed.step("000", 0.95, 25.0)
    assert resumed.left == pytest.approx(5.0)
    two = Pace(["000", "001", "002"], 2)
    for share, now in ((0.1, 10.0), (0.6, 60.0)):
        two.step("000", share, now)
    two.step("001", 0.5, 60.0)
    assert two.left == pytest.approx(100.0), "40, 50 and 100 s for two workers, but the last one has one"
    assert two.done == pytest.approx(1.1)
    two.finish("000")
    two.finish("001")
    assert two.left == pytest.approx(100.0)


class Killed(Exception):
    pass


@pytest.mark.thorough
@pytest.mark.parametrize("optimized", [False, True])
def test_a_killed_search_goes_on_to_the_same_certificate(tmp_path, optimized):
    whole, killed = folder_of(tmp_path / "whole"), folder_of(tmp_path / "killed")
    elite.certify_elite(whole, "000", "proved", lambda step: None, optimized)

    def stop(step):
        if isinstance(step, elite.Step) and step.knot == 2:
            raise Killed

    with pytest.raises(Killed):
        elite.certify_elite(killed, "000", "proved", stop, optimized)
    journal = killed / "certificates" / ".000.partial.jsonl"
    with journal.open("ab") as file:
        file.write(b'{"stretch": {"torn')
    seen = []
    elite.certify_elite(killed, "000", "proved", seen.append, optimized)
    assert [step.knot for step in seen if isinstance(step, elite.Step)] == [1, 0]
    assert (killed / "certificates" / "000.json").read_bytes() == (whole / "certificates" / "000.json").read_bytes()


@pytest.mark.thorough
def test_threads_share_out_the_cases_and_change_nothing(tmp_path):
    one, three = folder_of(tmp_path / "one"), folder_of(tmp_path / "three")
    elite.certify_elite(one, "000", "proved", lambda step: None)
    elite.certify_elite(three, "000", "proved", lambda step: None, threads=3)
    files = [(run / "certificates" / "000.json").read_bytes() for run in (one, three)]
    assert files[0] == files[1]


@pytest.mark.thorough
def test_another_elite_s_journal_is_not_used(tmp_path):
    run = folder_of(tmp_path)
    journal = run / "certificates" / ".000.partial.jsonl"
    journal.write_text('{"claim": "another", "rung": "proved"}\n{"goal": {}, "outlet": 1.0}\n')
    assert elite.certify_elite(run, "000", "proved", lambda step: None) is not None


def test_what_cannot_be_claimed_is_refused():
    arrays, record = swing.elite()
    with pytest.raises(UserError, match="the elite's parameters lack 'upper_mass'"):
        claim_of(Elite.of(arrays, {**record, "plant": "acrobot"}))
    with pytest.raises(UserError, match=r"u_max = 9\.0: must be torque_limit = 2\.5"):
        claim_of(Elite.of({**arrays, "u_max": np.array([9.0])}, record))
    gains = {"K": np.zeros((5, 2, 2)), "K_goal": np.eye(2)}
    two = Elite.of({**arrays, **gains, "u": np.zeros((4, 2)), "u_max": np.ones(2), "R": np.eye(2)}, record)
    with pytest.raises(UserError, match="no certificate for 2 inputs"):
        claim_of(two)


def test_the_command_line(run, tmp_path, capsys):
    assert cli.main(["certify", str(run)]) == 0
    assert cli.main(["check", str(run / "certificates" / "000.json")]) == 0
    assert "PROVED" in capsys.readouterr().out
    assert cli.main(["certify", str(tmp_path)]) == 2
    assert cli.main(["certify", str(run), "--elites", "0"]) == 2
    errors = capsys.readouterr().err
    assert "is no run folder" in errors
    assert "--elites = 0: must be >= 1" in errors


def test_ranks_of_sampled_and_proved_sums():
    def outcome(sampled, found):
        return elite.Outcome("000", "proved", 0.0, 1, 1.0, {"sum": sampled}, {"sum": found})

    alike = [outcome(1.0, 10.0), outcome(2.0, 20.0), outcome(3.0, 25.0)]
    turned = [outcome(1.0, 30.0), outcome(2.0, 20.0), outcome(3.0, 10.0)]
    assert rank_correlation(alike) == pytest.approx(1)
    assert rank_correlation(turned) == pytest.approx(-1)
