"""Motions that end in a catch set, resets that lead from one motion into the next, and cycles of them."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Function, Q, Refused, Reset, Term
from rtcd_jax.certificate.check_cpp import command
from rtcd_jax.certificate.falsify.falsify import Part, summed
from rtcd_jax.certificate.falsify.simulation import Motions
from rtcd_jax.certificate.prove import cycle
from rtcd_jax.certificate.prove.certify import certify_elite
from rtcd_jax.certificate.prove.closed_loop import Loop, catch_record, with_digests
from rtcd_jax.certificate.prove.levels import last_level, unit_directions
from rtcd_jax.certificate.prove.reset import momentum, positions, reset_record, turns
from rtcd_jax.certificate.prove.robot import Polynomial
from rtcd_jax.certificate.standing import open_cycle, standing
from rtcd_jax.elite.elite import Elite
from rtcd_jax.export.proof import ProvedFunnel
from rtcd_jax.plants import brachiation
from rtcd_jax.system.console import silent
from rtcd_jax.system.errors import UserError
from tests.certificate import flight
from tests.certificate.claims import claimed
from tests.certificate.folder import folder_with
from tests.certificate.second import first_verdict, program, second_verdict
from tests.certificate.test_check import resealed
from tests.consoles import Output

HELD = Reset(
    [[1]], [0], {name: name for name in ("m", "l", "b", "g")}, (((Term((0,), (("l", 2), ("m", 1)), Q(1), Q(0)),),),)
)
"""Nothing happens to the pendulum: its momentum is that of its own mass matrix."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = folder_with(tmp_path_factory.mktemp("flight"), *flight.elite())
    certify_elite(folder, "000", "proved", lambda step: None)
    return folder


@pytest.fixture
def content(run):
    return json.loads((run / "certificates" / "000.json").read_text())


def verdicts(path, content):
    return first_verdict(content), second_verdict(program(), path, content)


# A catch set ----------------------------------------------------------------------------------------------------------


def test_a_motion_that_ends_in_flight_is_proved(run, content, tmp_path):
    one, other = verdicts(tmp_path / "x.json", content)
    assert one == other
    assert one.code == 0
    assert "stays in it until 0.2 s, where it is in the catch set; |theta| <= 6.28319 rad" in one.words
    assert "goal" not in content
    assert not {"x_goal", "K_goal"} & content["claim"].keys()
    report = check.check(content)
    assert (report.start, report.shells, report.rest) == (0, None, [])
    np.testing.assert_allclose(report.axes["catch"], flight.HALF_WIDTHS, rtol=1e-9)
    assert report.volumes["catch"] == pytest.approx(np.pi * 0.2, rel=1e-9)
    assert report.volumes["outlet"] < report.volumes["catch"]
    assert standing(run, "000").proved


def test_motions_of_the_file_end_in_the_set(content):
    def missed(changed):
        return summed([Part.of(Motions(changed).follow(400, 8, np.random.default_rng(0)))], 8)

    assert missed(content).broken == 0
    content["claim"]["catch"]["axes"] = [
        [(float.fromhex(c) / 2).hex() for c in row] for row in content["claim"]["catch"]["axes"]
    ]
    found = missed(resealed(content))
    assert (found.left_funnel, found.moved_away) == (0, 0)
    assert found.not_arrived > 20


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (lambda claim: claim["catch"]["axes"][0].__setitem__(0, (0.19).hex()), "certificate.catch.cases.caught"),
        (lambda claim: claim["catch"]["axes"][0].__setitem__(0, (0.0).hex()), "certificate.catch"),
        (lambda claim: claim["catch"]["center"].__setitem__(0, (2.1).hex()), "certificate.catch.cases.caught"),
        (lambda claim: claim["catch"].pop("center"), "certificate.claim.catch"),
        (lambda claim: claim.update(catch=None), "certificate.claim.catch"),
        (lambda claim: claim.update(x_goal=[(2.0).hex()] * 2), "certificate.claim"),
    ],
)
def test_another_catch_set_is_refused(content, tmp_path, change, place):
    change(content["claim"])
    one, other = verdicts(tmp_path / "x.json", resealed(content))
    assert one.code == other.code == 1
    assert one.place.startswith(place)
    assert other.place.startswith(place)


def test_a_goal_in_the_place_of_a_catch_is_refused(content, tmp_path):
    content["goal"] = content.pop("catch")
    for verdict in verdicts(tmp_path / "x.json", resealed(content)):
        assert (verdict.code, verdict.words) == (1, "certificate: must have a catch, as its claim has")


def test_it_is_of_another_elite_if_its_set_is_larger(run, tmp_path):
    arrays, record = flight.elite(level=0.9)
    other = folder_with(tmp_path, arrays, record)
    (other / "certificates" / "000.json").write_bytes((run / "certificates" / "000.json").read_bytes())
    found = standing(other, "000")
    assert (found.verdict, "its catch set is not in the elite's" in found.reason) == ("of another elite", True)


def test_the_exported_funnel_ends_with_the_last_ellipsoid(run, content):
    proved = ProvedFunnel.read(run / "certificates" / "000.json")
    last = [[float.fromhex(c) for c in row] for row in content["funnel"][-1]["last"]]
    at_the_end, before = proved.at(4.0), proved.at(3.9999)
    assert at_the_end is not None
    assert before is not None
    np.testing.assert_allclose(at_the_end, last)
    np.testing.assert_allclose(before, last, atol=1e-3)


def test_the_shape_on_the_last_interval_is_carried_by_the_linear_loop():
    """V along motions near x* stays the same there, and the last level is the largest within the set."""
    elite = Elite.of(*flight.elite())
    loop = Loop(claimed(elite), elite)
    error, steps = np.array([1e-6, -2e-6]), 4000
    start = error @ loop.value(3, 0.0)[0] @ error
    np.testing.assert_allclose(loop.value(3, 0.0)[0], elite.S[3], rtol=1e-12)
    for i in range(steps):

        def slope(fraction, e):
            rates = loop.error_rate(3, fraction)(np.stack([e, 0 * e], 1))
            return rates[:, 0] - rates[:, 1]  # x* is a cubic, and no motion

        middle = error + loop.dt / steps / 2 * slope(i / steps, error)
        error = error + loop.dt / steps * slope((i + 0.5) / steps, middle)
    assert error @ loop.value(3, 1.0)[0] @ error == pytest.approx(start, rel=1e-4)
    axes = loop.axes(3, 1.0, last_level(loop, unit_directions(2)), 0.0)[0]
    assert np.linalg.norm(axes / np.array(flight.HALF_WIDTHS)[:, None], 2) == pytest.approx(1, rel=1e-6)


def test_what_no_proof_of_a_catch_bears_is_said(tmp_path):
    folder = folder_with(tmp_path, *flight.elite())
    (tmp_path / "lab.yaml").write_text("age: 0.005\n")
    with pytest.raises(UserError, match=r"ends in a catch set \(task\.catch\): no proof of it bears old measurements"):
        certify_elite(folder, "000", "proved", lambda step: None, uncertainty=tmp_path / "lab.yaml")
    with pytest.raises(UserError, match=r"--optimize_value: .* whose shape is given"):
        certify_elite(folder, "000", "proved", lambda step: None, optimize_value=True)


@pytest.mark.thorough
@pytest.mark.parametrize("center", ["common", "moving"])
def test_it_bears_a_box_of_robots(tmp_path, center):
    """About own motions the set holds what is left around the end of each."""
    folder = folder_with(tmp_path, *flight.elite())
    (tmp_path / "lab.yaml").write_text(f"design: {{mass: 0.01}}\ninput: 0.01\ncenter: {center}\n")
    certify_elite(folder, "000", "proved", lambda step: None, uncertainty=tmp_path / "lab.yaml")
    content = json.loads((folder / "certificates" / "000.json").read_text())
    one, other = verdicts(tmp_path / "x.json", content)
    assert (one.code, one) == (0, other)
    assert (len(content["catch"]["cases"]) > 1) == (center == "moving"), "control points of the robots"
    assert summed([Part.of(Motions(content).follow(400, 8, np.random.default_rng(0)))], 8).broken == 0


# Resets ---------------------------------------------------------------------------------------------------------------


def value(function: Function, q, numbers):
    """In floats, of a function in the checker's words."""
    return sum(
        np.prod([numbers[name] ** e for name, e in term.powers])
        * (float(term.cosine) * np.cos(np.dot(term.joints, q)) + float(term.sine) * np.sin(np.dot(term.joints, q)))
        for term in function
    )


@pytest.mark.parametrize("joints", [2, 3])
def test_a_brachiator_s_reset_is_the_plant_s(joints):
    """In the joints, with the mass matrix of the robot that hangs from its other hook, found from its energy."""
    random = np.random.default_rng(joints)
    names = brachiation.FIELDS[joints]
    numbers = dict(zip(names, random.uniform(0.2, 1, len(names)), strict=True))
    functions = momentum(joints, {name: Polynomial.number(name) for name in names})
    arm = numbers["arm_length"]

    def places(q, of):
        """Centers of mass [joints 2] by the joints, and the links' angles, of the robot with these numbers."""
        angles = np.cumsum(q)
        chain = ["support", *["body"] * (joints - 2), "swing"]
        hung = np.array([0, 0]), arm * np.array([np.sin(angles[0]), -np.cos(angles[0])])
        return [
            hung[i > 0] + of[f"{link}_center"] * np.array([np.sin(a), -np.cos(a)])
            for i, (link, a) in enumerate(zip(chain, angles, strict=True))
        ], chain

    def mass(q, of):
        step, total = 1e-6, np.zeros((joints, joints))
        moved = [
            (np.array(places(q + step * e, of)[0]) - np.array(places(q - step * e, of)[0])) / (2 * step)
            for e in np.eye(joints)
        ]
        for i, link in enumerate(places(q, of)[1]):
            jacobian = np.array([each[i] for each in moved])
            turned = np.tril(np.ones((joints, joints)))[i]
            total += of[f"{link}_mass"] * jacobian @ jacobian.T + of[f"{link}_inertia"] * np.outer(turned, turned)
        return total

    for _ in range(5):
        x = random.normal(size=2 * joints)
        q, v = x[:joints], x[joints:]
        after = np.array(positions(joints)) @ q + np.pi * np.array(turns(joints))
        x_matrix = np.array([[value(entry, q, numbers) for entry in row] for row in functions])
        rates = np.linalg.solve(mass(after, brachiation.exchanged(numbers)), x_matrix @ v)
        with jax.enable_x64(True):
            expected = brachiation.catch(numbers, jnp.asarray(x))
        np.testing.assert_allclose([*after, *rates], expected, rtol=1e-6, atol=1e-6)


def led(content, center, axes, reset):
    """The content with a reset into a set, and the prover's squares."""
    claim = {key: value for key, value in content["claim"].items() if key != "sha256"}
    claim["catch"] = catch_record(center, axes, reset=reset_record(reset))
    content["claim"] = with_digests(claim)
    read = check.read_claim(check.Node("claim", content["claim"]))
    last = check.read_interval(check.Node("last", content["funnel"][-1]), read).last
    found = cycle.catch_proof(read, last, exact=True)
    assert found is not None
    content["catch"] = cycle.catch_end_record(*found)
    return resealed(content)


@pytest.mark.parametrize("turned", [0, 2, -2])
def test_a_reset_that_does_nothing_but_turn(content, tmp_path, turned):
    """The set then lies whole turns away, up to the rounding of pi."""
    catch = content["claim"]["catch"]
    center = [(float.fromhex(catch["center"][0]) + turned * np.pi).hex(), catch["center"][1]]
    changed = led(content, center, catch["axes"], HELD._replace(turns=[turned]))
    one, other = verdicts(tmp_path / "x.json", changed)
    assert (one.code, one) == (0, other)
    assert "until 0.2 s, where the claimed reset leads it into the catch set" in one.words
    assert summed([Part.of(Motions(changed).follow(400, 8, np.random.default_rng(0)))], 8).broken == 0


def test_a_reset_that_speeds_up_is_proved_where_the_set_is_wide_enough(content, tmp_path):
    """Half the mass takes the momentum: twice the velocity, 1.2 times the angle is out of reach, and said so."""
    numbers = {**HELD.numbers, "m": Q(3, 10)}
    catch = content["claim"]["catch"]
    center, wide = [catch["center"][0], (4.0).hex()], [[catch["axes"][0][0], (0.0).hex()], [(0.0).hex(), (2.0).hex()]]
    changed = led(content, center, wide, HELD._replace(numbers=numbers))
    one, other = verdicts(tmp_path / "x.json", changed)
    assert (one.code, one) == (0, other)
    assert summed([Part.of(Motions(changed).follow(400, 8, np.random.default_rng(0)))], 8).broken == 0
    for name, new in (("m", (0.29).hex()), ("m", "m"), ("l", (0.35).hex())):
        other = json.loads(json.dumps(changed))
        other["claim"]["catch"]["reset"]["numbers"][name] = new
        for verdict in verdicts(tmp_path / "x.json", resealed(other)):
            assert (verdict.code, verdict.place) == (1, "certificate.catch.cases.caught.gram[0]"), (name, verdict)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda reset: reset["numbers"].pop("m"), "reset.numbers: must be the robot's"),
        (lambda reset: reset["numbers"].update(m="mass"), "must be a double in hexadecimal"),
        (lambda reset: reset["positions"][0].append(1), "has 2 entries, must have 1"),
        (lambda reset: reset["turns"].__setitem__(0, 9), "must be an integer from -8 to 8"),
        (lambda reset: reset["momentum"][0][0][0]["powers"].update(mass=1), "must be of the robot's numbers"),
        (lambda reset: reset.pop("momentum"), "has unknown keys or lacks some: momentum"),
        (lambda reset: reset["momentum"][0][0].clear(), "caught"),
    ],
)
def test_a_damaged_reset_is_refused_by_both(content, tmp_path, change, reason):
    catch = content["claim"]["catch"]
    changed = led(content, catch["center"], catch["axes"], HELD)
    change(changed["claim"]["catch"]["reset"])
    for verdict in verdicts(tmp_path / "x.json", resealed(changed)):
        assert verdict.code == 1
        assert reason in verdict.words


# Cycles ---------------------------------------------------------------------------------------------------------------


@pytest.fixture
def tasks(tmp_path, monkeypatch):
    """A run for two tasks, both of which stand at the upright, and whose reset does nothing."""
    folders = [folder_with(tmp_path / "tasks" / name, *flight.standing()) for name in ("first", "second")]
    for module in ("prove.cycle", "standing"):
        monkeypatch.setattr(f"rtcd_jax.certificate.{module}.task_folders", lambda run: folders)
    monkeypatch.setattr(cycle, "reset_of", lambda elite, ahead: HELD)
    monkeypatch.setattr("rtcd_jax.certificate.prove.reset.reset_of", lambda elite: HELD)
    return folders


def test_a_cycle_is_closed_and_checked(tasks, tmp_path, capsys):
    for folder in tasks:
        certify_elite(folder, "000", "proved", lambda step: None)
    assert open_cycle(tmp_path, "000") == "certificate 1: does not end in a reset"
    output = Output()
    assert cycle.close_cycle(tmp_path, ["000"], "proved", "CLARABEL", output.console)
    assert open_cycle(tmp_path, "000") == ""
    files = [folder / "certificates" / "000.json" for folder in tasks]
    written = [file.stat().st_mtime_ns for file in files]
    assert (
        f"elite 000: the cycle is closed (proved); `rtcd check --cycle {files[0]} {files[1]}` checks it"
        in output.getvalue()
    )
    again = certify_elite(tasks[0], "000", "proved", lambda step: None)
    assert again is not None
    assert np.isnan(again.seconds), "it was there"
    assert cycle.close_cycle(tmp_path, ["000"], "proved", "CLARABEL", silent())
    assert [file.stat().st_mtime_ns for file in files] == written, "nothing is done again"
    assert command.main(["--cycle", *map(str, files), "--second"]) == 0
    out = capsys.readouterr().out
    assert out.count("PROVED in continuous time") == 2
    assert "PROVED that these 2 motions are a cycle: what the reset" in out
    assert "in C++, proves the same" in out


def changed_in(file, change):
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(resealed(content)))


def test_files_that_are_no_cycle_are_refused_with_the_reason(tasks, tmp_path, capsys):
    for folder in tasks:
        certify_elite(folder, "000", "proved", lambda step: None)
    files = [folder / "certificates" / "000.json" for folder in tasks]
    assert command.main(["--cycle", *map(str, files), "--second"]) == 1
    err = capsys.readouterr().err
    assert f"REFUSED {files[0]} {files[1]}\ncertificate 1: does not end in a reset" in err
    assert "The second checker, in C++, refuses it, too: certificate 1: does not end in a reset" in err
    assert cycle.close_cycle(tmp_path, ["000"], "proved", "CLARABEL", silent())
    capsys.readouterr()
    before = files[1].read_text()
    for change, reason in (
        (lambda c: c["claim"]["robot"].update(name="other"), "is followed by one about another robot"),
        (lambda c: c["claim"].update(limit=[(2.4).hex()] * 2), "another limit of the motor"),
        (lambda c: c["claim"]["parameters"].update(g=[(9.8).hex()] * 2), "numbers after its reset are not those"),
        (lambda c: c["claim"]["x"][0].__setitem__(1, (1e-9).hex()), "is not the first ellipsoid of the one"),
    ):
        changed_in(files[1], change)
        claims = [check.read_claim(check.Node("claim", json.loads(file.read_text())["claim"])) for file in files]
        firsts = [check.read_interval(check.Node("x", json.loads(file.read_text())["funnel"][0]), claim).first
                  for file, claim in zip(files, claims, strict=True)]  # fmt: skip
        with pytest.raises(Refused, match=reason):
            check.require_cycle(list(zip(claims, firsts, strict=True)))
        files[1].write_text(before)


def test_what_keeps_a_cycle_open_is_said(tasks, tmp_path, monkeypatch):
    output = Output()
    certify_elite(tasks[0], "000", "proved", lambda step: None)
    assert not cycle.close_cycle(tmp_path, ["000"], "proved", "CLARABEL", output.console)
    assert "elite 000: no cycle, since the funnel of second is not shown from t = 0 on" in output.getvalue()
    certify_elite(tasks[1], "000", "proved", lambda step: None)
    doubled = HELD._replace(momentum=(((Term((0,), (("l", 2), ("m", 1)), Q(3), Q(0)),),),))
    monkeypatch.setattr(cycle, "reset_of", lambda elite, ahead: doubled)
    assert not cycle.close_cycle(tmp_path, ["000"], "proved", "CLARABEL", output.console)
    assert "the reset after first is not shown to lead into the next funnel: V is up to" in output.getvalue()


def test_a_cycle_that_will_hardly_close_is_told_before_its_proofs(tasks, tmp_path, monkeypatch):
    """Velocities that a reset makes five times as large need ellipsoids that no share makes wide enough."""
    output = Output()
    cycle.foresee(tmp_path, ["000"], 1.0, None, output.console)
    assert output.getvalue() == "", "these will"
    faster = HELD._replace(momentum=(((Term((0,), (("l", 2), ("m", 1)), Q(5), Q(0)),),),))
    monkeypatch.setattr(cycle, "reset_of", lambda elite, ahead: faster)
    cycle.foresee(tmp_path, ["000"], 1.0, None, output.console)
    assert "elite 000: the cycle will hardly close: after a reset V may be" in output.getvalue()
    assert "no smaller --share seems to close it" in output.getvalue()


def test_a_cycle_needs_its_files(capsys):
    assert check.main(["--cycle"]) == 2
    assert "--cycle: must be followed by the certificates of all its motions" in capsys.readouterr().err
    assert check.main(["--cycle", "a", "b", "--controller", "lab"]) == 2
    assert check.main(["a", "b"]) == 2
