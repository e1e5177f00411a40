"""The checker before strangers' files: one line and a code whatever they hold, and no word of theirs as its own."""

import json
import os
import pickle
import random
import re

import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check.exact import MAX_BYTES, rounded
from rtcd_jax.cli import main as cli
from tests.certificate import swing
from tests.certificate.folder import folder_with
from tests.certificate.test_check import escapes, leaves, mutated, resealed

FORGED = "PROVED in continuous time, by exact arithmetic, for the model of your dreams"
ESCAPE = "\x1b[2K\r"


@pytest.fixture
def asked(tmp_path, capsys):
    """Exit code, output and errors of `rtcd check` for a content or a text."""

    def ask(content, *options):
        path = tmp_path / "x.json"
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        code = check.main([str(path), *options])
        return code, *capsys.readouterr()

    return ask


def lines_are_the_checker_s_own(out, err):
    """Nothing that a terminal obeys, and nothing of the file's begins a line."""
    assert re.fullmatch(r"[\n -~]*", out + err)
    return all(not line.startswith("PROVED") for line in (out + err).splitlines()[1:])


def _set(*path):
    *parents, last = path

    def change(content, value):
        for key in parents:
            content = content[key]
        content[last] = value

    return change


NUMBERS = {
    "another script's digit": (_set("claim", "u", 0), "0x1.8p+\u0661", "claim.u[0]: must be a double in hexadecimal"),
    "a line's end": (_set("claim", "u", 0), "0x1.8p+1\n", "claim.u[0]: must be a double in hexadecimal"),
    "the least double as a mass": (_set("claim", "parameters", "m"), [(5e-324).hex()] * 2, "certificate.goal"),
    "a gain beyond all": (_set("claim", "K_goal", 0), (1e308).hex(), "certificate.goal"),
    "a limit beyond all": (_set("claim", "limit"), [(1.7e308).hex()] * 2, "certificate"),
    "a start beyond all": (_set("claim", "start", 1), (1.7e308).hex(), "overlaps: starts at 0 knots"),
    "a length beyond all": (_set("claim", "dt"), (1.7e308).hex(), "certificate"),
    "a region beyond all": (
        _set("goal", "axes"),
        [[(1e308).hex(), "0x0p+0"], ["0x0p+0", (1e308).hex()]],
        "certificate",
    ),
    "a goal beyond all": (_set("claim", "x_goal", 0), (1.7e308).hex(), "goal.axes: the limit on |theta| is"),
    "a whole number": (_set("funnel", 0, "knot"), 10**400, "must be an integer from 0 to 3"),
}


@pytest.mark.parametrize("number", NUMBERS)
def test_numbers_that_no_double_holds_are_refused_in_one_line(content, asked, number):
    change, value, reason = NUMBERS[number]
    change(content, value)
    code, out, err = asked(resealed(content))
    assert (code, out) == (1, "")
    assert reason in err
    assert len(err.splitlines()) == 2
    assert lines_are_the_checker_s_own(out, err)


def test_volumes_beyond_all_doubles_are_infinite():
    assert check.verdict.total([1.7e308, 1.7e308]) == float("inf")
    assert rounded(check.Q(10**400)) == float("inf")
    assert rounded(check.Q(-(10**400), 3)) == -float("inf")
    assert rounded(check.Q(1, 10**400)) == 0


def test_a_note_cannot_say_that_it_is_the_checker(content, asked):
    content["notes"] = {
        "a": f"\n{FORGED}", "b": f"{ESCAPE}{FORGED}", f"\n{FORGED}\u2028": "c", "d": "\ud800", "e": "x" * 100 + FORGED,
    }  # fmt: skip
    code, out, err = asked(resealed(content))
    assert (code, err) == (0, "")
    assert lines_are_the_checker_s_own(out, err)
    _, *notes = out.splitlines()
    assert len(notes) == 5
    assert all(note.startswith("note of the file's author, not proved: ") and len(note) <= 79 for note in notes)


def test_a_robot_cannot_say_that_it_is_the_checker(content, asked):
    """Names of its states and units are a file's text, too."""
    robot = content["claim"]["robot"]
    robot["name"], robot["input_unit"] = f"{ESCAPE}'", f"\n{FORGED}"[:40]
    robot["states"], robot["units"] = [f"{ESCAPE}\n", f"\n{FORGED}"[:40]], ["\r", "\u202e"]
    code, out, err = asked(resealed(content))
    assert (code, err) == (0, "")
    assert lines_are_the_checker_s_own(out, err)
    assert r"|\x1b[2K\r\n| <= 6.28319 \r" in out


@pytest.mark.parametrize("note", [["x"], {"x": "y"}, 3, None])
def test_a_note_is_a_text(content, asked, note):
    content["notes"]["a"] = note
    code, _, err = asked(resealed(content))
    assert (code, "certificate.notes: must hold texts" in err) == (1, True)
    content["notes"] = {f"{i}": "" for i in range(1000)}
    assert "certificate.notes: has 1000 entries, must have at most 20" in asked(resealed(content))[2]


def test_unknown_keys_are_printed_as_text(content, asked):
    content[f"{ESCAPE}\n{FORGED}"] = 1
    code, out, err = asked(content)
    assert (code, out) == (1, "")
    assert r"has unknown keys or lacks some: \x1b[2K\r\nPROVED" in err
    assert lines_are_the_checker_s_own(out, err)


@pytest.mark.parametrize("depth", [200, 900, 5000, 100_000])
@pytest.mark.parametrize("pair", ["[]", ('{"a":', "}")])
@pytest.mark.parametrize("place", ["notes", "claim", "funnel"])
def test_deep_nesting_is_refused(content, asked, depth, pair, place):
    content[place] = "here"
    text = json.dumps(content).replace('"here"', pair[0] * depth + "1" + pair[1] * depth)
    code, out, err = asked(text)
    assert (code, out, len(err.splitlines())) == (1, "", 2)


def test_too_large_a_file_is_undecided(asked, tmp_path, capsys):
    path = tmp_path / "large.json"
    with path.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    assert check.main([str(path)]) == 2
    assert "large.json: has more than 268435456 bytes: undecided" in capsys.readouterr().err


def test_polynomials_too_large_to_multiply_are_refused(content, asked):
    node = check.Node("funnel[0].orders", [15, 15])
    with pytest.raises(check.Refused, match="asks for polynomials of 62016 terms, must be at most 10000"):
        check.file.require_few_terms(node, 4, 15, 15)
    check.file.require_few_terms(node, 4, 7, 8)  # the cart-pole's intervals


def test_it_gives_up_in_time(content, asked):
    code, out, err = asked(content, "--seconds", "0.0001")
    assert (code, out) == (2, "")
    assert err.endswith("x.json: gave up after 0.0001 s: undecided; --seconds gives it more\n")
    assert asked(content)[0] == 0


def test_a_pipe_without_a_writer_ends_too(tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe")
    assert check.main([str(tmp_path / "pipe"), "--seconds=0.1"]) == 2
    assert "gave up after 0.1 s" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["a.json", "--seconds", "0"], "--seconds 0: must be a number > 0 and <= 1e6"),
        (["a.json", "--seconds", "nan"], "--seconds nan: must be"),
        (["a.json", "--seconds=x\x1b"], r"--seconds x\x1b: must be"),
        (["a.json", "--seconds"], "--seconds: must be followed by its value"),
        (["a.json", "--second", "3"], "unknown option --second; valid: --seconds, --controller"),
        (["a.json", "b.json"], "2 files: must be one"),
        (["\x1b.json"], r"\x1b.json: No such file or directory"),
    ],
)
def test_wrong_options_are_told(arguments, reason, capsys):
    assert check.main(arguments) == 2
    assert reason in capsys.readouterr().err


# An exported controller -----------------------------------------------------------------------------------------------


@pytest.fixture
def lab(content, tmp_path):
    """An export of this claim, as far as the checker looks at it."""
    folder = tmp_path / "lab"
    folder.mkdir()
    (folder / "controller.c").write_text("int x;")
    digest = check.command.hashlib.sha256(b"int x;").hexdigest()
    claim = content["sha256"]["claim"]
    mark = {"format": "rtcd_jax export", "complete": True, "claim": claim, "files": {"controller.c": digest}}
    (folder / "export.json").write_text(json.dumps(mark))
    return folder, mark


def test_a_controller_of_this_claim(content, asked, lab):
    code, out, err = asked(content, "--controller", str(lab[0]))
    assert (code, err) == (0, "")
    assert out.splitlines()[-1].endswith("was exported from this claim, and its files are as exported.")


WRONG_LABS = {
    "another claim": ({"claim": "0" * 64}, f"it was exported from another claim: sha256 {'0' * 64} there, "),
    "no claim": ({"claim": None}, "it was exported from another claim: sha256 none there"),
    "a claim that is none": ({"claim": [f"\n{FORGED}"]}, "it was exported from another claim: sha256 none there"),
    "a forged claim": ({"claim": f"{ESCAPE}\n"}, r"sha256 \x1b[2K\r\n there"),
    "half an export": ({"complete": False}, "its export was not finished"),
    "a changed file": ({"files": {"controller.c": "0"}}, "controller.c is not as it was exported"),
    "a lost file": ({"files": {"controller.h": "0"}}, "controller.h is missing"),
    "a file outside": ({"files": {"../x.json": "0"}}, "names ../x.json, which is no file in the folder"),
    "no files": ({"files": None}, "export.json is none of `rtcd export`"),
}


@pytest.mark.parametrize("wrong", WRONG_LABS)
def test_a_controller_of_another_claim(content, asked, lab, wrong):
    folder, mark = lab
    changed, reason = WRONG_LABS[wrong]
    (folder / "export.json").write_text(json.dumps(mark | changed))
    code, out, err = asked(content, "--controller", str(folder))
    assert code == 1
    assert out.startswith("PROVED")
    assert err.startswith("NOT THE CONTROLLER OF THIS CERTIFICATE: ")
    assert reason in err
    assert lines_are_the_checker_s_own(out, err)


def test_a_folder_without_an_export(content, asked, tmp_path):
    code, out, err = asked(content, "--controller", str(tmp_path))
    assert (code, out) == (2, "")
    assert "export.json: No such file or directory" in err


# Run folders and certificates before certify and falsify --------------------------------------------------------------

ELITES = {
    "a gain that is none": (lambda a, r: a["K"].__setitem__((1, 0, 0), np.nan), "numbers in K that are not finite"),
    "no mass": (lambda a, r: r["parameters"].pop("m"), "the elite's parameters lack 'm'"),
    "a mass of nothing": (
        lambda a, r: r["parameters"].update(m=0.0),
        "claim.robot.mass: its determinant is not shown",
    ),
    "the least mass": (lambda a, r: r["parameters"].update(m=5e-324), "claim.rates[0][0][0]: must be a double"),
    "a mass in words": (lambda a, r: r["parameters"].update(m="one"), "the elite's parameters.m cannot be read"),
    "a list of parameters": (lambda a, r: r.update(parameters=[1]), "the elite's parameters cannot be read"),
    "a list of robots": (lambda a, r: r.update(plant=["pendulum"]), "the elite's plant cannot be read"),
    "limits in words": (lambda a, r: r.update(state_limits=["a", "b"]), "the elite's state_limits cannot be read"),
    "a policy in words": (
        lambda a, r: r.update(policy={"discount": "x"}),
        "the elite's policy.discount cannot be read",
    ),
    "no weight on the input": (lambda a, r: a.update(R=0 * a["R"]), "the elite's R is not positive definite"),
    "no time": (lambda a, r: a.update(time=0 * a["time"]), "dt: must be > 0"),
    "uneven knots": (lambda a, r: a.update(time=a["time"] ** 2), "knots that are not evenly spaced"),
}


@pytest.mark.parametrize("elite", ELITES)
def test_an_elite_that_cannot_be_claimed_is_told_in_a_line(elite, tmp_path, capsys):
    arrays, record = swing.elite()
    arrays = {key: np.array(value) for key, value in arrays.items()}
    record = json.loads(json.dumps(record))
    changed, reason = ELITES[elite]
    changed(arrays, record)
    run = folder_with(tmp_path / "run", arrays, record)
    assert cli.main(["certify", str(run)]) == 2
    err = capsys.readouterr().err
    assert reason in err
    assert len(err.splitlines()) == 1


@pytest.mark.parametrize("file", ["elites/000.json", "certificates/summary.json"])
def test_deep_files_of_a_run_are_told_in_a_line(file, tmp_path, capsys):
    run = folder_with(tmp_path / "run", *swing.elite())
    (run / file).write_text("[" * 100_000)
    assert cli.main(["certify", str(run)]) == 2
    err = capsys.readouterr().err
    assert f"cannot read {run / file}" in err
    assert len(err.splitlines()) == 1


CERTIFICATES = {
    "flat": (lambda c: c["goal"].update(axes=[["0x0p+0"] * 2] * 2), "Singular matrix"),
    "no intervals": (lambda c: c.update(funnel=[]), "funnel: has no intervals"),
    "a moment": (lambda c: c["claim"].update(dt=(1e-300).hex()), "claim.dt: cannot be simulated"),
    "an eternity": (lambda c: c["claim"].update(dt=(1e300).hex()), "claim.dt: cannot be simulated"),
    "a funnel in words": (lambda c: c.update(funnel="ab"), "is no certificate"),
    "a number": (lambda c: c.update(goal=3), "is no certificate"),
    "a forged key": (lambda c: c["claim"].update({f"{ESCAPE}\n": 1}), r"lacks some: \x1b[2K\r\n"),
}


@pytest.mark.parametrize("certificate", CERTIFICATES)
def test_what_cannot_be_simulated_is_told_in_a_line(certificate, content, tmp_path, capsys):
    changed, reason = CERTIFICATES[certificate]
    changed(content)
    path = tmp_path / "x.json"
    path.write_text(json.dumps(resealed(content)))
    assert cli.main(["falsify", str(path), "--rollouts", "50", "--workers", "1"]) == 2
    err = capsys.readouterr().err
    assert reason in err
    assert len(err.splitlines()) == 1


def scale(numbers, factor):
    """Every number of nested lists, times a factor."""
    if isinstance(numbers, list):
        return [scale(each, factor) for each in numbers]
    return (float.fromhex(numbers) * factor).hex()


ABSURD = {
    "gains": lambda claim: claim.update(K=scale(claim["K"], 1e300)),
    "all of them": lambda claim: claim.update({key: scale(claim[key], 1e307) for key in ("x", "rates", "K", "u")}),
    "limits": lambda claim: claim.update(bounds=["0x1p-1000"] * 2),
    "a microsecond": lambda claim: claim.update(dt=(1e-6).hex()),
    "a long interval": lambda claim: claim.update(dt=(999.0).hex()),
    "the heaviest": lambda claim: claim["parameters"].update(m=[(1e300).hex()] * 2),
    "the lightest": lambda claim: claim["parameters"].update(m=[(1e-300).hex()] * 2),
}


@pytest.mark.thorough
@pytest.mark.parametrize("change", ABSURD)
def test_what_is_readable_and_absurd_is_falsified_or_told_in_a_line(change, content, tmp_path, capfd):
    """In a bounded time, without a warning of numpy's on the workers' stderr. Large gains may be right."""
    ABSURD[change](content["claim"])
    path = tmp_path / "x.json"
    path.write_text(json.dumps(resealed(content)))
    code = cli.main(["falsify", str(path), "--rollouts", "50", "--workers", "1"])
    err = capfd.readouterr().err
    assert code in ((0, 1) if change == "gains" else (1, 2))
    assert len(err.splitlines()) == (1 if code == 2 else 0), err


def test_a_refusal_goes_from_process_to_process():
    refused = pickle.loads(pickle.dumps(check.Refused("goal", "no\n")))
    assert str(refused) == r"goal: no\n"


# A thousand files -----------------------------------------------------------------------------------------------------

DOUBLES = [
    "0x1.8p+\u0661", "0x0.0000000000001p-1022", "0x1.fffffffffffffp+1023", "-0x0.0p+0", "0x1p+9999", "0x1.0p-9999",
    "0x1.8p+1\n", " 0x1p+0", "inf", "nan", "", 1e308, 10**400, -1, True, None, [], {}, "\ud800", ESCAPE,
]  # fmt: skip
DEEP = "here it goes deep"


def _at(content, path):
    for key in path:
        content = content[key]
    return content


def disfigured(content, dice, paths):
    """One hostile change of a file's numbers, structure, keys, digests or notes."""
    kind = dice.choice(["number", "number", "deep", "key", "lost", "digest", "note", "swap"])
    path = dice.choice(paths)
    parent, last = _at(content, path[:-1]), path[-1]
    if kind == "number":
        parent[last] = dice.choice(DOUBLES)
    elif kind == "deep":
        parent[last] = DEEP
    elif kind == "key" and isinstance(parent, dict):
        parent[f"{last}{ESCAPE}\n{FORGED}"] = parent.pop(last) if dice.random() < 0.5 else parent[last]
    elif kind == "lost":
        parent.pop(last)
    elif kind == "digest":
        record = dice.choice([content, content["claim"], content["goal"], *content["funnel"]])
        record["sha256"] = dice.choice([{}, None, [], {**record["sha256"], "claim": 1}, {"x": ESCAPE}])
    elif kind == "note":
        content["notes"] = dice.choice([FORGED, {"x": f"\n{FORGED}"}, {ESCAPE: ESCAPE}, {"x": [1]}, [], {"\ud800": ""}])
    else:
        other = dice.choice(paths)
        parent[last] = json.loads(json.dumps(_at(json.loads(json.dumps(content)), other)))


def garbled(text, dice):
    """A change of the file's bytes."""
    at = dice.randrange(len(text))
    changes = [text[:at], text[:at] + dice.choice('"{}[],:\x00\x1b\u0661') + text[at + 1 :], text[at:], text * 2]
    return dice.choice([*changes, text[:at] + text[at + dice.randrange(2000) :]])


def statement(content):
    """All that a file says is proved: its claim and its ellipsoids."""
    pieces = [{key: value for key, value in piece.items() if key not in ("cases", "orders", "sha256")}
              for piece in content["funnel"]]  # fmt: skip
    return content["claim"], pieces, content["goal"]["axes"]


def hostile_files(text, rounds, seed):
    """Texts of disfigured certificates, and whether their digests were made anew."""
    dice = random.Random(seed)
    paths = [path for path in leaves(json.loads(text)) if "sha256" not in path]
    for _ in range(rounds):
        content, whole = json.loads(text), dice.random()
        if whole < 0.15:
            yield garbled(text, dice), False
            continue
        (mutated if whole < 0.5 else disfigured)(content, dice, paths)
        if anew := dice.random() < 0.6:
            resealed(content)
        depth = dice.choice([50, 990, 200_000])
        yield json.dumps(content).replace(f'"{DEEP}"', "[" * depth + "]" * depth), anew


def judged(text, rounds, seed, asked):
    """Counts of the exit codes; fails at a traceback, a forged line, or a false statement that is accepted."""
    codes = {0: 0, 1: 0, 2: 0}
    said = statement(json.loads(text))
    for mutant, anew in hostile_files(text, rounds, seed):
        code, out, err = asked(mutant)
        codes[code] += 1
        assert lines_are_the_checker_s_own(out, err)
        assert code or out.startswith("PROVED")
        if code == 0:
            now = json.loads(mutant)
            changed = statement(now) != said
            assert anew or not changed, mutant
            assert not (changed and escapes(now)), mutant
    return codes


@pytest.mark.thorough
def test_hostile_files_are_refused_in_a_line_or_prove_what_is_true(text, asked):
    codes = judged(text, 60, 1, asked)
    assert codes[1] > 30
    assert codes[2] == 0


@pytest.mark.slow
def test_a_thousand_hostile_files(text, asked):
    codes = judged(text, 1000, 2, asked)
    assert codes[0] > 10
    print(codes)
