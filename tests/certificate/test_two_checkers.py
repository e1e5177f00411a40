"""The checker in C++ beside the one in Python: one verdict on every file, whatever was changed in it."""

import gzip
import json
import random
import re
import subprocess
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check.exact import MAX_BYTES
from rtcd_jax.certificate.check_cpp import command
from rtcd_jax.certificate.falsify.falsify import Part, summed
from rtcd_jax.certificate.falsify.simulation import Motions
from rtcd_jax.cli import main as cli
from tests.certificate.second import first_verdict, program, second_verdict
from tests.certificate.test_check import halve, leaves, resealed
from tests.certificate.test_hostile import hostile_files, lines_are_the_checker_s_own

FILES = Path(__file__).parent / "files"
KINDS = ("version1", "version2_age", "box", "age", "cartpole", "two_joints", "two_joints_box", "box_and_age",
         "further", "own_motions", "halves", "catch", "reset")  # fmt: skip
"""Certificates of every kind of claim; all but the first two end with the last intervals of a test's elite."""


@pytest.fixture(scope="module")
def second():
    return program()


def stored(kind):
    return gzip.decompress((FILES / f"{kind}.json.gz").read_bytes()).decode()


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_both_prove_the_same(second, tmp_path, kind):
    """Word for word, with the smallest margin and the claim's digest."""
    content = json.loads(stored(kind))
    verdict = second_verdict(second, tmp_path / "x.json", content)
    assert verdict.code == 0
    assert verdict == first_verdict(content)


@pytest.mark.thorough
def test_what_was_just_proved_is_proved_by_both(second, tmp_path, content):
    assert second_verdict(second, tmp_path / "x.json", content) == first_verdict(content)


# Mutations of every kind of claim -------------------------------------------------------------------------------------

ULP = 2.0**-52
FACTORS = (1 + ULP, 1 - ULP, 1 + 2.0**-30, 1 - 2.0**-30, 1.0001, 0.9999, 1.01, 0.99, 1.3, 0.7, 4.0, -1.0, 0.0)
STATEMENT = {
    "parameters", "limit", "disturbance", "noise", "age", "speed", "jerk", "reaction", "jumps", "push", "robot",
    "state_limits", "K_goal", "x_goal", "start", "shifts", "catch",
}  # fmt: skip


def at(content, path):
    for key in path:
        content = content[key]
    return content


def is_number(value):
    return isinstance(value, str) and bool(re.match(r"-?0x", value))


def groups_of(content):
    """Paths to the file's numbers by what they are: each is as likely to be hit, however many numbers it has."""
    groups = {}
    for path in leaves(content):
        if "sha256" in path or not is_number(at(content, path)):
            continue
        part = path[:2] if path[0] in ("claim", "goal") else (path[0], path[2])
        if path[0] == "claim" and path[1] == "robot":
            part = (*part, path[2])
        groups.setdefault(part, []).append(path)
    return groups


def number_changed(content, dice, groups):
    """One number, by a factor or by its neighbour."""
    statement = [part for part in groups if part[0] == "claim" and part[1] in STATEMENT]
    part = dice.choice(statement if dice.random() < 0.6 else list(groups))
    path = dice.choice(groups[part])
    old = float.fromhex(at(content, path))
    new = dice.choice([*(old * factor for factor in FACTORS), old + 1e-3, old - 1e-3])
    at(content, path[:-1])[path[-1]] = new.hex()
    return part


def box_widened(content, dice):
    """Of one number of the robot, or of the motor's limit, to one side."""
    claim = content["claim"]
    boxes = [ends for ends in (*claim["parameters"].values(), claim.get("limit")) if isinstance(ends, list)]
    if not boxes:
        return ("claim", "box of version 1")
    ends = dice.choice(boxes)
    low, high = map(float.fromhex, ends)
    share = dice.choice([ULP, 2.0**-30, 1e-4, 1e-2, 0.3])
    if dice.random() < 0.5:
        ends[0] = (low - share * abs(low)).hex()
    else:
        ends[1] = (high + share * abs(high)).hex()
    return ("claim", "box")


def term_changed(content, dice):
    """A wave, a power, or a term of M, U, a damper or the motor."""
    robot = content["claim"].get("robot")
    if robot is None:
        return ("claim", "robot of version 1")
    reset = content["claim"].get("catch", {}).get("reset", {"momentum": []})
    functions = [
        *(entry for row in (*robot["mass"], *reset["momentum"]) for entry in row),
        robot["potential"],
        *robot["damping"],
        *robot["motor"],
    ]
    terms = dice.choice([function for function in functions if function])
    term, kind = dice.choice(terms), dice.randrange(6)
    if kind < 2:
        joint = dice.randrange(len(term["joints"]))
        term["joints"][joint] += dice.choice([-1, 1])
    elif kind == 2 and term["powers"]:
        name = dice.choice(list(term["powers"]))
        term["powers"][name] += dice.choice([-1, 1])
    elif kind == 3:
        terms.remove(term)
    elif kind == 4:
        terms.append(json.loads(json.dumps(term)))
    else:
        term["cos"], term["sin"] = term["sin"], term["cos"]
    return ("claim", "terms")


def reset_changed(content, dice):
    """An integer of a reset, or whose value a number takes."""
    reset = content["claim"].get("catch", {}).get("reset")
    if reset is None:
        return term_changed(content, dice)
    kind = dice.randrange(3)
    if kind == 2:
        name = dice.choice(list(reset["numbers"]))
        reset["numbers"][name] = dice.choice([*reset["numbers"], (0.5).hex()])
    else:
        row = dice.choice([reset["turns"], *reset["positions"]])
        row[dice.randrange(len(row))] += dice.choice([-1, 1])
    return ("claim", "reset")


def case_changed(content, dice):
    """A case left out, under another name, in halves, or with another's proof; another degree, other monomials, other
    orders.
    """
    piece = dice.choice(
        [*content["funnel"], *([content["catch"]] if "catch" in content else content["goal"]["shells"])]
    )
    cases, kind = piece["cases"], dice.randrange(8)
    name, other = dice.choice(list(cases)), dice.choice(list(cases))
    squares = cases[name]
    if kind == 0:
        del cases[name]
    elif kind == 1:
        cases[
            dice.choice(
                ["free", "high", "low-", "free+late", "free/0", "low/1,1", "late", "caught", "caught/1", "caught-"]
            )
        ] = cases.pop(name)
    elif kind == 2:
        cases[name], cases[other] = cases[other], cases[name]
    elif kind == 3:
        cases[name] = [squares, cases[other]]
    elif kind == 4 and isinstance(squares, list):
        squares.pop() if dice.random() < 0.3 else squares.reverse()
    else:
        while isinstance(squares, list):
            squares = dice.choice(squares)
        if kind == 5:
            squares["degree"] += dice.choice([-1, 1])
        elif kind == 6 and "further" in squares:
            dice.choice(squares["further"])[dice.randrange(2)] += dice.choice([-1, 1])
        elif kind == 6 and "orders" in piece:
            piece["orders"][dice.randrange(len(piece["orders"]))] += dice.choice([-1, 1])
        elif matrices := squares[dice.choice(["gram", "multipliers"])]:
            matrices.pop() if dice.random() < 0.5 else matrices.reverse()
    return ("proof", "cases")


def mutated(text, dice, groups):
    """A content with one change, and what kind of number it was."""
    content, kind = json.loads(text), dice.random()
    if kind < 0.6:
        part = number_changed(content, dice, groups)
    elif kind < 0.75:
        part = box_widened(content, dice)
    elif kind < 0.83:
        part = term_changed(content, dice)
    elif kind < 0.9:
        part = reset_changed(content, dice)
    else:
        part = case_changed(content, dice)
    return content, part


def falsified(content):
    """Whether simulated motions of the claim's box leave what the file says is proved."""
    found = summed([Part.of(Motions(content).follow(50, 8, np.random.default_rng(0)))], 8)
    return found.left_funnel or found.left_limits or found.not_arrived


def judged(kind, rounds, seed, second, path):
    """Counts of mutations of a kind of claim by what became of them.

    Fails unless both checkers refuse the unsealed file at the same place, by its digest, and come to the same verdict
    about the resealed one, refusals at the same place; or if motions leave what both accept.
    """
    text, counts = stored(kind), Counter()
    original, dice = json.loads(text), random.Random(f"{kind} {seed}")
    groups = groups_of(original)
    while counts.total() < rounds:
        content, part = mutated(text, dice, groups)
        if content == original:
            continue
        if counts.total() % 10 == 0:
            unsealed = second_verdict(second, path, content)
            assert unsealed.code == 1
            assert unsealed.place == first_verdict(json.loads(json.dumps(content))).place
        resealed(content)
        one, other = first_verdict(content), second_verdict(second, path, content)
        assert one.code == other.code, (part, one, other)
        assert one.code == 0 or one.place == other.place, (part, one, other)
        if one.code == 0:
            assert one == other, (part, one, other)
            assert not falsified(content), (part, one)
            counts["accepted", *part] += 1
        else:
            counts["refused" if one.code == 1 else "undecided"] += 1
    return counts


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_both_judge_mutations_alike(second, tmp_path, kind):
    counts = judged(kind, 3, 1, second, tmp_path / "x.json")
    assert counts["refused"]


@pytest.mark.parametrize(("times", "place"), [(4, "free[0][0][0][0].gram[4]"), (5, "free[0][0][0][0]")])
def test_both_read_halves_of_halves_up_to_a_depth(second, tmp_path, content, times, place):
    """Proofs of the whole, on its sixteenths."""
    halve(content, times)
    one, other = first_verdict(resealed(content)), second_verdict(second, tmp_path / "x.json", content)
    assert (one.code, one.place) == (other.code, other.place)
    assert one.place.endswith(place)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_both_judge_hundreds_of_mutations_alike(second, tmp_path, kind):
    counts = judged(kind, 300, 2, second, tmp_path / "x.json")
    print(kind, dict(counts))
    assert counts["refused"] > 150
    assert counts["undecided"] == 0


# Strangers' files -----------------------------------------------------------------------------------------------------


def asked(second, path, *options):
    done = subprocess.run([second, path, *options], capture_output=True)
    return done.returncode, done.stdout.decode("ascii"), done.stderr.decode("ascii")


def hostile(text, rounds, seed, second, path):
    """Exit codes of the second checker on disfigured files; the first one's are the same."""
    codes = Counter()
    for mutant, _ in hostile_files(text, rounds, seed):
        path.write_text(mutant, encoding="utf-8", errors="surrogatepass")
        code, out, err = asked(second, path)
        assert lines_are_the_checker_s_own(out, err)
        assert len(err.splitlines()) == (2 if code else 0), err
        assert code == check.main([str(path)]), mutant[:2000]
        codes[code] += 1
    return codes


@pytest.mark.thorough
def test_hostile_files_get_the_same_exit_code(second, tmp_path, text, capsys):
    assert hostile(text, 60, 4, second, tmp_path / "x.json")[1] > 30


@pytest.mark.slow
def test_a_thousand_hostile_files_get_the_same_exit_code(second, tmp_path, text, capsys):
    codes = hostile(text, 1000, 5, second, tmp_path / "x.json")
    assert codes[0] > 10
    assert codes[2] == 0


@pytest.mark.thorough
def test_texts_of_all_alphabets_have_the_same_digest(second, tmp_path, content):
    """Canonical JSON: escapes, pairs of surrogates and halves of them, keys in the order of their code points."""
    content["notes"] = {"é": '\x7f\t\\"/\b\f', "\U0001f600": "\ud800", "\uff41": "\udc00x", "": "\x00" * 3}
    path = tmp_path / "x.json"
    path.write_text(json.dumps(resealed(content)))
    code, out, err = asked(second, path)
    assert (code, err) == (0, "")
    assert r"proved: \xe9: \x7f\t\\" in out
    for length in range(50, 70):
        content["notes"] = {"x": "y" * length}
        path.write_text(json.dumps(resealed(content)))
        assert asked(second, path, "--seconds", "60")[0] == 0


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is no JSON"),
        ("{", "is no JSON"),
        ('{"a": NaN}', "holds NaN"),
        ('{"a": 1, "a": 2}', "has the same key twice"),
        ('{"a": 01}', "is no JSON"),
        ('{"a": "\t"}', "is no JSON"),
        ('{"a": 1}}', "is no JSON"),
        ("[" * 100_000, "is nested too deeply"),
        ("[]", "certificate: must be an object"),
        ("{}", "is no 'rtcd certificate'"),
        ("\xff", "is no ASCII text"),
    ],
)
def test_what_is_no_certificate_is_refused_by_the_second(second, tmp_path, text, reason):
    path = tmp_path / "x.json"
    path.write_text(text, encoding="utf-8")
    code, out, err = asked(second, path)
    assert (code, out) == (1, "")
    assert reason in err


def test_too_large_a_file_is_undecided(second, tmp_path):
    path = tmp_path / "x.json"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    assert asked(second, path) == (2, "", f"{path}: has more than 268435456 bytes: undecided\n")


def test_the_second_gives_up_in_time_and_tells_wrong_options(second, tmp_path):
    path = tmp_path / "x.json"
    path.write_text(stored("cartpole"))
    code, out, err = asked(second, path, "--seconds", "0.001")
    assert (code, out) == (2, "")
    assert err == f"{path}: gave up after 0.001 s: undecided; --seconds gives it more\n"
    for wrong in (["--seconds", "0"], ["--seconds=nan"], ["--other"], [path]):
        assert asked(second, path, *wrong)[0] == 2
    assert asked(second, tmp_path / "none.json") == (
        2, "", f"{tmp_path}/none.json: No such file or directory; a certificate is RUN/certificates/NNN.json\n",
    )  # fmt: skip
    assert asked(second, "--help")[1].startswith("usage: check FILE")


def test_a_slide_has_no_negative_powers(second, tmp_path):
    """A potential of c (cos(theta) - 1) / cart has no value at the goal; it was read as one of c (cos(theta) - 1)."""
    content, small = json.loads(stored("cartpole")), 2.0**-30
    for wave, value in ((1, small), (0, -small)):
        term = {"joints": [-1, wave], "powers": {}, "cos": value.hex(), "sin": "0x0.0p+0"}
        content["claim"]["robot"]["potential"].append(term)
    verdict = first_verdict(resealed(content))
    assert re.search(r"robot\.potential\[\d\]\.joints\[0\]: must be an integer from 0 to 8", verdict.words)
    assert second_verdict(second, tmp_path / "x.json", content) == verdict


# rtcd check --second --------------------------------------------------------------------------------------------------


def test_rtcd_check_with_the_second_checker(second, run, tmp_path, content, capsys):
    assert cli.main(["check", str(run / "certificates" / "000.json"), "--second"]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("PROVED")
    assert out.endswith("\nThe second checker, in C++, proves the same.\n")
    assert err == ""
    path = tmp_path / "x.json"
    path.write_text(json.dumps(resealed(content | {"goal": {**content["goal"], "order": 2}})))
    assert cli.main(["check", str(path), "--second"]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert re.fullmatch(r"REFUSED .*\n(certificate\..*)\nThe second checker, in C\+\+, refuses it, too: .*\n", err)
    assert cli.main(["check", str(tmp_path / "none.json"), "--second"]) == 2
    assert cli.main(["check", "--second"]) == 2
    assert cli.main(["check", "--help"]) == 0
    assert "--second" in capsys.readouterr().out


def test_checkers_that_differ_are_an_error(run, tmp_path, capsys, monkeypatch):
    """The program of another source, which refuses everything."""
    program()
    source = tmp_path / "check.cpp"
    source.write_text('#include <cstdio>\nint main() { std::fprintf(stderr, "REFUSED\\nall: no\\n"); return 1; }')
    monkeypatch.setattr(command, "SOURCE", source)
    file = str(run / "certificates" / "000.json")
    assert cli.main(["check", file, "--second"]) == 1
    assert capsys.readouterr().err.endswith("THE TWO CHECKERS DIFFER. The second one, in C++: all: no\n")
    source.write_text("int main() { return 5; }")
    assert cli.main(["check", file, "--second"]) == 2
    assert "the second checker does not decide: ended with 5" in capsys.readouterr().err


def test_what_is_missing_to_build_it_is_told_in_a_line(run, capsys, monkeypatch, tmp_path):
    file = str(run / "certificates" / "000.json")
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert cli.main(["check", file, "--second"]) == 2
    out, err = capsys.readouterr()
    assert out.startswith("PROVED"), "the first checker's verdict stands"
    assert err.startswith("rtcd: cannot build the second checker: there is no g++; it needs g++ and GMP")


def test_a_library_that_is_missing_is_told_in_a_line(run, capsys, monkeypatch, tmp_path):
    program()
    source = tmp_path / "check.cpp"
    source.write_text("int main() { return 0; }")
    monkeypatch.setattr(command, "SOURCE", source)
    monkeypatch.setattr(command, "LIBRARIES", ("-lno_such_library",))
    assert cli.main(["check", str(run / "certificates" / "000.json"), "--second"]) == 2
    err = capsys.readouterr().err
    assert re.search(r"cannot build the second checker: .*no_such_library.*; it needs g\+\+ and GMP", err)
