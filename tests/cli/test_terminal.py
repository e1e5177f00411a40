"""Every verb once in a real terminal, on real and tiny work: exit code, what is drawn, what is stored."""

import json
import re
import shutil

import pytest
import yaml

from rtcd_jax.cli import main as cli
from rtcd_jax.cli.exits import Exit
from rtcd_jax.config.plants import PLANTS
from rtcd_jax.elite.records import read_elite
from tests.certificate.test_audit import ARGUMENTS, table
from tests.cli.terminal import BAR, in_terminal
from tests.run.small import GENERATIONS, SMALL

READERS = {
    "verify": (["--states", "20", "--seed", "3", "--workers", "1"], True),
    "report": ([], False),
    "list": ([], False),
    "show": ([], False),
    "diff": (["run"], False),
    "replay": (["inside.csv"], False),
    "certify": (["--workers", "1"], True),
    "disturb": (["--states", "2", "--seed", "3"], None),
    "tolerance": (["--uncertainty", "box.yaml", "--elite", "initial"], None),
    "export": (["--to", "lab", "--elite", "initial"], None),
}
"""Verbs on a finished run: the rest of the command line, and whether it draws a live line (None: if it takes long)."""


def ends_well(code, screen, draws, expected=Exit.OK):
    assert code == expected, screen
    assert "Traceback" not in screen
    assert draws is None or (BAR in screen) == draws
    assert screen.count(BAR) == screen.count("\x1b[?25h"), "the cursor is not shown again"


@pytest.fixture(scope="module")
def folder(finished, tmp_path_factory):
    """A working folder with a finished run, motions inside and outside of its funnel, and a lab's table."""
    folder = tmp_path_factory.mktemp("terminal")
    shutil.copytree(finished, folder / "run")
    arrays, _ = read_elite(finished / "elites", "000")
    for name, off in (("inside", 0.0), ("outside", 3.0)):
        rows = [(t, x + off, v) for t, (x, v) in zip(arrays["time"], arrays["x"], strict=True)]
        lines = (",".join(map(str, row)) for row in [("time", "pos", "vel"), *rows])
        (folder / f"{name}.csv").write_text("\n".join(lines))
    table(folder / "given.csv")
    (folder / "box.yaml").write_text("uncertainty: {input: 0.01}")
    return folder


@pytest.fixture(scope="module")
def sent(folder):
    """What each verb that reads a run sends to its terminal; all work on one run, one after another."""
    ended = {}
    for verb, (arguments, _) in READERS.items():
        ended[verb] = in_terminal(verb, "run", *arguments, folder=folder)
    return ended


@pytest.mark.thorough
@pytest.mark.parametrize("verb", READERS)
def test_a_verb_that_reads_a_run(verb, sent):
    ends_well(*sent[verb], draws=READERS[verb][1])


@pytest.mark.thorough
def test_what_the_options_say_reaches_the_work(sent, folder):
    verified = json.loads((folder / "run" / "verification" / "000.json").read_text())
    assert (verified["states"], verified["seed"]) == (20, 3)
    disturbed = json.loads((folder / "run" / "disturbance" / "off_nominal.json").read_text())
    assert disturbed["seed"] == 3
    tolerated = json.loads((folder / "run" / "tolerance" / "initial.json").read_text())
    assert [row["name"] for row in tolerated["rows"]] == ["disturbance", "whole box"]
    assert tolerated["rows"][0]["borne"] == pytest.approx(0.01 * tolerated["rows"][1]["factor"])
    assert tolerated["rows"][1]["factor"] > 0
    (exported,) = (folder / "lab").glob("export.json")
    assert json.loads(exported.read_text())["elite"] == "initial"


@pytest.mark.thorough
def test_results_reach_the_page_that_is_there(sent):
    """`report` comes before `disturb` and `certify`, and after `verify`."""
    assert "report.html shows this, too" in sent["disturb"][1]
    assert "report.html shows this, too" in sent["certify"][1]
    assert "report.html shows this, too" in sent["tolerance"][1]
    assert "report.html" not in sent["verify"][1]


def test_the_packaged_configurations(folder):
    code, screen = in_terminal("configs", folder=folder)
    ends_well(code, screen, draws=False)
    assert "pendulum_rtcd" in screen


def test_a_draft_for_a_robot(folder):
    (folder / "acrobot.xml").write_text(PLANTS["acrobot"].xml)
    ends_well(*in_terminal("new", "acrobot.xml", folder=folder), draws=False)
    assert (folder / "acrobot.yaml").is_file()


@pytest.mark.slow
def test_a_refinement(folder):
    shutil.copytree(folder / "run", folder / "refined")
    code, screen = in_terminal("refine", "refined", "--steps", "2", folder=folder)
    ends_well(code, screen, draws=True)


@pytest.mark.thorough
def test_a_certificate_is_checked_and_falsified(sent, folder):
    code, screen = in_terminal("check", "run/certificates/000.json", folder=folder)
    ends_well(code, screen, draws=False)
    assert "PROVED" in screen
    ends_well(*in_terminal("falsify", "run", "--rollouts", "200", "--workers", "1", folder=folder), draws=True)


def test_an_audit(folder):
    arguments = ["given.csv", *ARGUMENTS, "--out", "out", "--states", "9"]
    ends_well(*in_terminal("audit", *arguments, folder=folder), draws=False)


@pytest.mark.thorough
def test_an_animation(folder, backend):
    code, screen = in_terminal("animate", "run", "--to", "videos", folder=folder, MUJOCO_GL=backend)
    ends_well(code, screen, draws=True)
    assert (folder / "videos" / "swingup.gif").is_file()


# ---- verbs that evaluate candidates


@pytest.mark.thorough
def test_a_search(searched):
    folder, *ended = searched
    ends_well(*ended, draws=True)
    assert f"generation {GENERATIONS}/{GENERATIONS}" in ended[1]
    assert (folder / "report.html").is_file()


@pytest.mark.thorough
def test_a_sweep_goes_on_after_a_case_that_fails(searched, small, tmp_path):
    """Its first case finds the run of another configuration in its place; its second one is finished but for its page,
    which cannot be made."""
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(SMALL | {"sweep": {"product": {"search.seed": [1, 0]}}}))
    for case in ("000_seed=1", "001_seed=0"):
        shutil.copytree(searched[0], tmp_path / "swept" / case)
    page = tmp_path / "swept" / case / "report.html"
    page.unlink()
    page.mkdir()
    arguments = ["sweep", "sweep.yaml", "--folder", "swept"]
    code, screen = in_terminal(*arguments, folder=tmp_path, width=300, **small.environment)
    ends_well(code, screen, draws=False, expected=Exit.WRONG_INPUT)
    assert re.search(r"case 0 ended early: .*holds a run with another configuration", screen)
    assert "1 of the cases ended early, see above: 000_seed=1" in screen
    assert "the run is finished, but its report failed: " in screen
    assert f"`rtcd report swept/{case}` makes it" in screen
    assert screen.count(f"{GENERATIONS}/{GENERATIONS}") == 2


@pytest.mark.thorough
def test_a_study_of_the_scaling(small, tmp_path):
    arguments = ["--populations", "6", "--devices", "2", "--repeats", "1", "--folder", "scaled"]
    ends_well(*in_terminal("scale", small.config, *arguments, folder=tmp_path, **small.environment), draws=True)
    assert (tmp_path / "scaled" / "table.csv").is_file()


# ---- promises that are refuted


@pytest.fixture(scope="module")
def refuted(folder):
    """The run, whose best elite claims a funnel that is a hundred times too large."""
    import numpy as np

    run = shutil.copytree(folder / "run", folder / "refuted")
    with np.load(run / "elites" / "000.npz") as file:
        arrays = dict(file)
    np.savez(run / "elites" / "000.npz", **arrays | {"rho": 100 * arrays["rho"]})
    shutil.rmtree(run / "certificates", ignore_errors=True)
    return run


def test_a_promise_that_does_not_hold_is_refuted(refuted, capsys, monkeypatch, as_in_a_process):
    assert cli.main(["verify", str(refuted), "--states", "100", "--workers", "1"]) == Exit.REFUTED
    assert "refuted" in capsys.readouterr().out


def test_a_motion_that_leaves_the_funnel_is_refuted(folder, capsys, monkeypatch):
    monkeypatch.chdir(folder)
    assert cli.main(["replay", "run", "outside.csv", "--elite", "initial"]) == Exit.REFUTED
    assert "the funnel of initial" in capsys.readouterr().out


def test_a_page_that_cannot_be_brought_up_to_date_ends_nothing(finished, tmp_path, capsys, as_in_a_process):
    run = shutil.copytree(finished, tmp_path / "run")
    (run / "report.html").touch()
    (run / "generations.jsonl").write_text("{: ]\n")
    assert cli.main(["verify", str(run), "--states", "5", "--workers", "1"]) == Exit.OK
    assert re.search(r"report.html does not show this yet: .*generations.jsonl", capsys.readouterr().out)
    assert (run / "verification" / "000.json").is_file()


# ---- what others have written


@pytest.mark.parametrize("arguments", [["--\x1b[31mred"], ["--states", "\x1b]0;title\x07"], ["--guarantee", "\x9b2J"]])
def test_a_terminal_shows_words_that_are_refused_and_does_not_obey_them(arguments, folder):
    verb = "certify" if "--guarantee" in arguments else "verify"
    code, screen = in_terminal(verb, "run", *arguments, folder=folder)
    assert code == Exit.WRONG_INPUT
    assert re.search(r"\\x1b\[31mred|\\x1b\]0;title\\+x07|\\x9b2J", screen)
    assert not re.search("\x1b\\[31mred|\x1b\\]0|\x9b", screen)
