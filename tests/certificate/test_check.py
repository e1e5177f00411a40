"""The checker: what it accepts is true of the simulated loop; what was changed it refuses, with place and reason."""

import copy
import json
import math
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Refused
from tests.certificate import swing
from tests.certificate.loops import Simulated, ball, floats

ROUNDING = 1e-9
"""Of twenty Runge-Kutta steps in 0.05 s, and of double precision in |y|."""


def resealed(content):
    """The same with digests that fit: now the proof alone stands between a lie and its acceptance."""
    for record in _records(content):
        record["sha256"] = {key: check.digest(value) for key, value in record.items() if key != "sha256"}
    return content


def _records(content):
    """Everything that holds digests, the innermost first; mutations may have left no such thing."""
    goal, claim = content.get("goal"), content.get("claim")
    shells = goal.get("shells") if isinstance(goal, dict) else None
    lists = [each for each in (content.get("funnel"), shells) if isinstance(each, list)]
    robot = claim.get("robot") if isinstance(claim, dict) else None
    parts = claim.get("shifts") if isinstance(claim, dict) else None
    lists.append(parts if isinstance(parts, list) else [])
    catch = claim.get("catch") if isinstance(claim, dict) else None
    reset = catch.get("reset") if isinstance(catch, dict) else None
    of_claim = (robot, *lists.pop(), reset, catch, claim)
    for record in (*of_claim, *(record for each in lists for record in each), goal, content.get("catch"), content):
        if isinstance(record, dict):
            yield record


def refusal(content):
    with pytest.raises(Refused) as refused:
        check.check(content)
    return str(refused.value)


def nudged(text, share=1e-3):
    """A number, or every number of a list."""
    if isinstance(text, list):
        return [nudged(each, share) for each in text]
    return (float.fromhex(text) * (1 + share)).hex()


def test_it_accepts_and_says_what_is_proved(content):
    report = check.check(content)
    words = check.sentence(report)
    for part in (
        "m = 0.6, l = 0.4", "never exceeds 2.5 N m", "[0 s, 0.2 s]", "|theta_dot| <= 7 rad/s", "smallest margin",
        "not about hardware", "converges to within", "applied without sampling",
    ):  # fmt: skip
        assert part in words
    assert report.margin > 0
    assert max(report.rest) < 1e-10


def test_volumes_are_the_ellipsoids(content):
    volumes = check.check(content).volumes
    firsts = [floats(piece["first"]) for piece in content["funnel"] if float.fromhex(piece["start"]) == 0]
    areas = [math.pi * np.linalg.det(axes) for axes in [*firsts, floats(content["funnel"][-1]["last"])]]
    assert volumes["sum"] == pytest.approx(sum(areas))
    assert volumes["inlet"] == pytest.approx(areas[0])
    assert volumes["goal"] == pytest.approx(math.pi * np.linalg.det(floats(content["goal"]["axes"])))
    assert volumes["integral"] == pytest.approx(np.trapezoid(areas, dx=swing.DT), rel=1e-2)


@pytest.mark.parametrize("first", [0, -1])
def test_no_motion_leaves_what_is_proved(content, first):
    loop = Simulated(content)
    levels, at_goal = loop.largest_levels(range(len(loop.funnel))[first], ball(500))
    assert levels[0] > 0.99
    assert max(levels) <= 1 + ROUNDING
    assert at_goal.max() <= 1 + ROUNDING
    fast = at_goal[:-1] > 1e-6
    assert np.all(np.diff(at_goal, axis=0)[fast] < 0)
    assert at_goal[-1].max() < 1e-3


def test_the_goal_region_lies_in_the_simulated_one(content):
    """From all over it, far out too; 10 % more in every direction would leave the limit on the speed."""
    loop = Simulated(content)
    start = loop.goal[:, None] + loop.goal_axes @ ball(2000)
    levels = loop.goal_levels(start)
    assert levels.max() <= 1 + ROUNDING
    assert levels[-1].max() < 1e-3
    assert 1.1 * np.linalg.norm(loop.goal_axes[1]) > 7


CHANGES = {
    "gram": (lambda c: c["funnel"][1]["cases"]["free"]["gram"][0], 0, r"funnel\[1\]\.cases"),
    "level": (lambda c: c["funnel"][1]["first"][0], 0, r"funnel\[1\]\.first"),
    "bend": (lambda c: c["funnel"][2]["bend"][0][0], 0, r"funnel\[2\]\.bend"),
    "time": (lambda c: c["funnel"][1], "end", r"funnel\[1\]\.end"),
    "gain": (lambda c: c["claim"]["K"][2], 1, r"claim\.K"),
    "goal gain": (lambda c: c["claim"]["K_goal"], 0, r"claim\.K_goal"),
    "nominal": (lambda c: c["claim"]["x"][1], 1, r"claim\.x"),
    "rate": (lambda c: c["claim"]["rates"][1][0], 1, r"claim\.rates"),
    "input": (lambda c: c["claim"]["u"], 0, r"claim\.u"),
    "mass": (lambda c: c["claim"]["parameters"], "m", r"claim\.parameters"),
    "step": (lambda c: c["claim"], "dt", r"claim\.dt"),
    "goal region": (lambda c: c["goal"]["axes"][0], 0, r"goal\.axes"),
    "goal gram": (lambda c: c["goal"]["shells"][0]["cases"]["free"]["gram"][0], 2, r"goal\.shells\[0\]\.cases"),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("share", [2.0**-52, 0.1])
def test_a_changed_number_is_refused_by_its_digest(content, change, share):
    container, key, place = CHANGES[change]
    where = container(content)
    where[key] = nudged(where[key], share)
    with pytest.raises(Refused, match=rf"^certificate\.{place}: was changed"):
        check.check(content)


MATTERS = {
    "gram": (-2.0, r"gram\[0\]: is not positive definite"),
    "level": (0.1, r"funnel\[1\]\.first: is not where the interval before it ends"),
    "bend": (500.0, "funnel"),
    "time": (0.0, ""),
    "gain": (-3.0, r"funnel\[[12]\]"),
    "goal gain": (-2.0, r"goal"),
    "nominal": (0.2, "funnel"),
    "rate": (0.5, "funnel"),
    "input": (0.5, r"funnel\[0\]"),
    "mass": (0.5, "goal"),
    "step": (-0.5, "funnel"),
    "goal region": (-0.2, "the funnel's outlet is not shown to lie in the goal region"),
    "goal gram": (0.5, r"goal\.shells\[0\]"),
}


@pytest.mark.parametrize("change", [name for name, (share, _) in MATTERS.items() if share])
def test_a_number_that_matters_is_refused_by_the_proof(content, change):
    container, key, _ = CHANGES[change]
    share, reason = MATTERS[change]
    where = container(content)
    where[key] = nudged(where[key], share)
    with pytest.raises(Refused, match=reason):
        check.check(resealed(content))


def test_gaps_overlaps_and_ends_are_refused(content):
    gap = copy.deepcopy(content)
    del gap["funnel"][1]
    assert "funnel[1]: leaves a gap: starts at 2 knots, must start at 1" in refusal(resealed(gap))
    twice = copy.deepcopy(content)
    twice["funnel"].insert(1, twice["funnel"][0])
    assert "funnel[1]: overlaps: starts at 0 knots, must start at 1" in refusal(resealed(twice))
    beheaded = copy.deepcopy(content)
    del beheaded["funnel"][0]
    assert "funnel[0]: leaves a gap" in refusal(resealed(beheaded))
    short = copy.deepcopy(content)
    del short["funnel"][-1]
    assert "funnel: does not reach the last knot" in refusal(resealed(short))
    halved = copy.deepcopy(content)
    halved["goal"]["shells"][0]["end"] = (0.5).hex()
    assert "shells: ends at 0.5, must end at 1" in refusal(resealed(halved))
    later = copy.deepcopy(content)
    later["goal"]["shells"][0]["start"] = (0.25).hex()
    assert "starts at 0.25, must start at 0" in refusal(resealed(later))


def test_cases_that_can_occur_must_be_there(content):
    del content["funnel"][-1]["cases"]["high"]
    assert "must have the cases free, high, low, has free, low" in refusal(resealed(content))


def test_limits_on_states_must_be_kept(content):
    content["claim"]["state_limits"][1] = (3.0).hex()
    assert "is not kept" in refusal(resealed(content))


def test_a_goal_that_is_none_is_refused(content):
    content["claim"]["x_goal"][0] = (3.0).hex()
    assert "the goal's angle is no multiple of pi" in refusal(resealed(content))


def halve(content, times):
    """A case in halves of halves; the outermost pair."""
    cases = content["funnel"][0]["cases"]
    for _ in range(times):
        cases["free"] = [cases["free"], cases["free"]]
    return cases["free"]


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        (lambda c: c.update(format="x"), "is no 'rtcd certificate'"),
        (lambda c: c.update(version=3), "must be of version 1 or 2"),
        (lambda c: c.update(version=True), "must be of version 1 or 2"),
        (lambda c: c.update(version=1), "has the claim of another version than 1"),
        (lambda c: c.update(more=1), "has unknown keys or lacks some: more"),
        (lambda c: c["claim"].pop("K"), "claim: has unknown keys or lacks some: K"),
        (lambda c: c["claim"].update(plant="acrobot"), "claim: has unknown keys or lacks some: "),
        (lambda c: c["claim"]["robot"]["joints"].append("ball"), "claim.robot.joints: must be hinge or slide"),
        (lambda c: c["claim"]["parameters"].update(M=["0x1p+0"] * 2), "claim.parameters: must be the robot's, b, g, l"),
        (
            lambda c: c["claim"]["parameters"]["m"].reverse() or c["claim"]["parameters"]["m"].__setitem__(0, "0x1p+9"),
            "claim.parameters.m: must rise",
        ),
        (lambda c: c["claim"].update(disturbance="-0x1p-9"), "claim.disturbance: must be >= 0"),
        (lambda c: c["claim"].update(noise=[]), "claim.noise: has 0 entries, must have 2"),
        (lambda c: c["claim"]["K"].pop(), "claim.K: has 4 entries, must have 5"),
        (lambda c: c["claim"]["x"][0].append("0x0.0p+0"), "claim.x[0]: has 3 entries, must have 2"),
        (lambda c: c["claim"]["u"].__setitem__(0, "nan"), "claim.u[0]: must be a double in hexadecimal"),
        (lambda c: c["claim"]["u"].__setitem__(0, 1.5), "claim.u[0]: must be a double in hexadecimal"),
        (lambda c: c["claim"]["u"].__setitem__(0, "0x1.0p+5000"), "claim.u[0]: is too large for a double"),
        (lambda c: c["claim"]["parameters"].update(m=["-0x1.0p+0"] * 2), "robot.mass: its determinant is not shown"),
        (lambda c: c["claim"].update(dt="0x0.0p+0"), "claim.dt: must be > 0"),
        (lambda c: c["funnel"].clear(), "funnel: has 0 entries, must have at least 1"),
        (lambda c: c["funnel"][0].update(knot=-1), "funnel[0].knot: must be an integer from 0 to 3"),
        (lambda c: c["funnel"][0].update(orders=[99, 5]), "funnel[0].orders[0]: must be an integer from 1 to 15"),
        (lambda c: c["funnel"][0]["cases"]["free"]["gram"][0].pop(), "gram[0]: has 14 entries, must have 15"),
        (lambda c: halve(c, 1).pop(), "cases.free: has 1 entries, must have 2"),
        (lambda c: halve(c, 5), "cases.free[0][0][0][0]: halves the interval more than 4 times"),
        (lambda c: c["goal"].update(axes=[]), "goal.axes: has 0 entries, must have 2"),
    ],
)
def test_wrong_files_are_refused(content, changed, reason):
    changed(content)
    assert reason in refusal(resealed(content))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is no JSON"),
        ('{"a": NaN}', "holds NaN"),
        ('{"a": 1, "a": 2}', "has the same key twice"),
        ("[" * 100000, "is nested too deeply"),
        ("[]", "certificate: must be an object"),
        ("{}", "is no 'rtcd certificate'"),
    ],
)
def test_what_is_no_certificate_is_refused(tmp_path, text, reason, capsys):
    path = tmp_path / "x.json"
    path.write_text(text)
    assert check.main([str(path)]) == 1
    assert reason in capsys.readouterr().err


def test_truncated_and_binary_files_are_refused(tmp_path, text, capsys):
    path = tmp_path / "x.json"
    path.write_text(text[: len(text) // 2])
    assert check.main([str(path)]) == 1
    path.write_bytes(b"\xff\x00")
    assert check.main([str(path)]) == 1
    errors = capsys.readouterr().err
    assert "is no JSON" in errors
    assert "is no ASCII text" in errors


def test_exit_codes(run, tmp_path, capsys):
    assert check.main([str(run / "certificates" / "000.json")]) == 0
    assert capsys.readouterr().out.startswith("PROVED in continuous time")
    assert check.main([str(tmp_path / "none.json")]) == 2
    assert check.main([]) == 2
    assert check.main(["--help"]) == 0


def test_as_a_folder_of_its_own_without_flint(run, tmp_path):
    """The folder alone, the standard library, and the same verdict: fractions in the place of flint."""
    package = tmp_path / "rtcd_jax" / "certificate"
    shutil.copytree(Path(check.__file__).parent, package / "check")
    for folder in (package, package.parent):
        (folder / "__init__.py").touch()
    file = run / "certificates" / "000.json"
    program = (
        "import runpy, sys; sys.modules['flint'] = None\n"
        "runpy.run_module('rtcd_jax.certificate.check', run_name='__main__')"
    )
    command = [sys.executable, "-c", program, str(file)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": ""})
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(check.sentence(check.check_file(file)))


def leaves(node, path=()):
    """Paths to everything in a file: containers too."""
    if path:
        yield path
    entries = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in entries:
        yield from leaves(value, (*path, key))


def mutated(content, dice, paths):
    """One random change of a file; what it was. Every part of the file is as likely to be hit, however long it is."""
    part = dice.choice(["claim", "funnel", "goal", "any"])
    path = dice.choice([p for p in paths if part in (p[0], "any")])
    parent = content
    for key in path[:-1]:
        parent = parent[key]
    old, kind = parent[path[-1]], dice.randrange(6)
    if isinstance(old, str) and old[:2] in ("0x", "-0"):
        number = float.fromhex(old)
        changes = [
            number * (1 + 2.0**-52),
            -number,
            number * 1.3,
            number + 1e-3,
            number * 2.0 ** dice.randrange(-900, 900),
            0.0,
        ]
        new = changes[kind].hex() if math.isfinite(changes[kind]) else "inf"
    elif isinstance(old, list) and old:
        new = [old[:-1], old + old[-1:], old[::-1], [], old[1:], None][kind]
    elif isinstance(old, dict):
        new = [{}, None, [], dict(list(old.items())[1:]), {**old, "more": 1}, "x"][kind]
    elif isinstance(old, int):
        new = [old + 1, old - 1, -old, 10**30, str(old), float(old)][kind]
    else:
        new = [None, "nan", 7, [], "0x1.0p+0", "x"][kind]
    parent[path[-1]] = new
    return path, old, new


def escapes(content):
    """Whether simulated motions leave what the file says is proved."""
    loop = Simulated(content)
    for first in range(len(loop.funnel)):
        levels, at_goal = loop.largest_levels(first, ball(60, seed=first))
        if max(levels) > 1 + ROUNDING or at_goal.max() > 1 + ROUNDING or at_goal[-1].max() > 0.01:
            return True
    return False


def fuzz(text, rounds, seed):
    dice = random.Random(seed)
    original = json.loads(text)
    paths = [path for path in leaves(original) if "sha256" not in path]
    accepted = 0
    for _ in range(rounds):
        content = json.loads(text)
        what = mutated(content, dice, paths)
        if content == original:
            continue
        with pytest.raises(Refused):
            check.check(copy.deepcopy(content))
        try:
            check.check(resealed(content))
        except Refused:
            continue
        accepted += 1
        assert not escapes(content), what
    return accepted


@pytest.mark.thorough
def test_random_mutations_never_prove_what_is_wrong(text):
    assert fuzz(text, 25, seed=1) > 0


@pytest.mark.slow
def test_a_thousand_random_mutations_never_prove_what_is_wrong(text):
    assert fuzz(text, 1000, seed=2) > 10
