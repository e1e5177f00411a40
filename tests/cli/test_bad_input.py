"""Every command in every bad situation: exit code 2, one line that names the thing, no traceback, nothing lost."""

import contextlib
import resource
import shutil
from pathlib import Path

import pytest

from rtcd_jax.cli import main as cli
from tests.certificate.test_audit import ARGUMENTS, table
from tests.paths import ROOT

RTCD = str(ROOT / "configs" / "pendulum_rtcd.yaml")
SWEEP = str(ROOT / "configs" / "sweep.yaml")


@pytest.fixture
def run(finished, as_in_a_process, tmp_path, monkeypatch):
    """A copy of a finished run as `run` in the working folder, with a measured motion and a box of uncertainty."""
    monkeypatch.chdir(tmp_path)
    Path("measured.csv").write_text("time,pos,vel\n0,3,0\n0.1,3.1,0\n")
    Path("box.yaml").write_text("uncertainty: {input: 0.01}")
    return Path(shutil.copytree(finished, "run"))


def command(verb, run="run"):
    """The arguments that would do `verb` on a run in as little time as it can."""
    more = {
        "verify": ["--states", "5", "--workers", "1"],
        "replay": ["measured.csv"],
        "disturb": ["--states", "1"],
        "tolerance": ["--uncertainty", "box.yaml"],
        "export": ["--to", "lab"],
    }
    return [verb, run, *more.get(verb, [])]


def refused(arguments, capsys):
    """The one line of an error whose exit code is 2."""
    assert cli.main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


READERS = ("verify", "report", "animate", "replay", "certify", "disturb", "tolerance", "export")


def cut(name):
    """Half of a file of the run."""
    content = Path(name).read_bytes()
    Path(name).write_bytes(content[: len(content) // 2])


SITUATIONS = {
    "missing": (lambda: shutil.rmtree("run"), "run: no such run folder; `rtcd optimize CONFIG"),
    "a file": (
        lambda: (shutil.rmtree("run"), Path("run").write_text("")),
        "run: is a file; must be a run folder, as `rtcd optimize CONFIG",
    ),
    "empty": (lambda: (shutil.rmtree("run"), Path("run").mkdir()), "run is no run folder: it has no format.json"),
    "unfinished": (lambda: shutil.rmtree("run/elites"), "run has no elites yet: finish the run first"),
    "arrays cut": (lambda: cut("run/elites/000.npz"), "cannot read run/elites/000.npz: File is not a zip file"),
    "no arrays": (lambda: Path("run/elites/000.npz").write_bytes(b""), "cannot read run/elites/000.npz: No data left"),
    "record cut": (lambda: cut("run/elites/000.json"), "cannot read run/elites/000.json: "),
    "record of nothing": (lambda: Path("run/elites/000.json").write_text("{}"), "000.json says nothing of its elite"),
    "arrays gone": (lambda: Path("run/elites/000.npz").unlink(), "run/elites has no 000.npz with its 000.json"),
}


@pytest.mark.parametrize("situation", SITUATIONS)
@pytest.mark.parametrize("verb", READERS)
def test_a_run_that_cannot_be_read(verb, situation, run, capsys):
    spoil, words = SITUATIONS[situation]
    spoil()
    assert words in refused(command(verb), capsys)


DAMAGED = {
    "config.yaml": ("report", "animate", "replay"),
    "format.json": ("report", "animate", "replay"),
    "initial.json": ("verify", "report", "animate", "disturb"),
    "generations.jsonl": ("report",),
    "provenance.json": ("report",),
    "verification/000.json": ("report",),
    "certificates/summary.json": ("report",),
    "certificates/000.json": ("falsify",),
    "disturbance/impulse.json": ("report",),
}


@pytest.mark.parametrize(("name", "verb"), [(name, verb) for name, verbs in DAMAGED.items() for verb in verbs])
def test_a_damaged_file_of_a_run_is_named(name, verb, run, capsys):
    (run / name).parent.mkdir(exist_ok=True)
    (run / name).write_text("{: ]\n")
    assert name in refused(command(verb), capsys)


PLACES = {
    "verify": "verification", "report": "figures", "animate": "animation", "replay": "replay",
    "certify": "certificates", "disturb": "disturbance", "tolerance": "tolerance",
}  # fmt: skip


@pytest.mark.parametrize("verb", PLACES)
def test_a_file_where_the_results_belong(verb, run, capsys):
    """Stands for all places that cannot be made, a read-only file system among them."""
    (run / PLACES[verb]).write_text("mine")
    assert f"cannot write run/{PLACES[verb]}" in refused(command(verb), capsys)
    assert (run / PLACES[verb]).read_text() == "mine"


@pytest.mark.parametrize("verb", PLACES)
def test_a_read_only_folder_is_told_before_the_work(verb, run, capsys, monkeypatch):
    """Asked of the system: nothing is read-only to the root that may run this."""
    (run / PLACES[verb]).mkdir()
    monkeypatch.setattr("rtcd_jax.system.files.os.access", lambda path, mode: False)
    assert f"cannot write run/{PLACES[verb]}" in refused(command(verb), capsys)


@contextlib.contextmanager
def full_disk():
    """The system takes no byte more in any file, as on a disk that is full."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


FULL = {
    "verify": command("verify"),
    "report": command("report"),
    "replay": command("replay"),
    "export": command("export"),
}


@pytest.mark.thorough
@pytest.mark.parametrize("verb", FULL)
def test_a_full_disk(verb, run, capsys):
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    with full_disk():
        line = refused(FULL[verb], capsys)
    assert "cannot write" in line
    assert "File too large" in line
    assert before.items() <= {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}.items()


OTHERS = {
    "a folder for a YAML": (["optimize", "run"], "run: is a folder; valid: run/config.yaml"),
    "no sweep section": (["sweep", RTCD], "has no sweep section"),
    "a damaged case": (["sweep", SWEEP, "--list", "--folder", "swept"], "cannot read swept/000_objective=sum_seed=0"),
    "a file for a study": (["scale", RTCD, "--folder", "measured.csv"], "cannot write measured.csv: File exists"),
    "no number": (["scale", RTCD, "--populations", "many"], "--populations = many: must be whole numbers"),
    "no page": (["report", "run", "--to", "run"], "--to = run: must be a file, and this is a folder"),
    "no place for a page": (
        ["report", "run", "--to", "measured.csv/page.html"],
        "cannot write measured.csv/",
    ),
    "no measured file": (["replay", "run", "no.csv"], "no.csv: no such file; must be a CSV of measured states"),
    "a folder, measured": (["replay", "run", "run"], "run: is a folder; must be a CSV of measured states"),
    "no such elite": (["replay", "run", "measured.csv", "--elite", "7"], "run has no elite 007; there are 000"),
    "no elite to export": (["export", "run", "--to", "lab", "--elite", "7"], "run has no elite 007; there are 000"),
    "a file to export to": (["export", "run", "--to", "measured.csv"], "measured.csv is a file: an export needs a"),
    "a run to export to": (["export", "run", "--to", "run"], "run is not empty and not an export: it has .lock"),
    "no such solver": (["certify", "run", "--solver", "NOSUCH"], "--solver = NOSUCH: must be one of CLARABEL, "),
    "no certificate": (["check", "run/no.json"], "run/no.json: No such file or directory; a certificate is"),
    "a folder to check": (["check", "run"], "run: Is a directory; a certificate is RUN/certificates/NNN.json"),
    "nothing to check": (["check"], "0 files: must be one, as in `rtcd check"),
    "nothing to falsify": (["falsify", "run"], "run/certificates/000.json: No such file"),
    "no certificate to falsify": (["falsify", "measured.csv"], "measured.csv is no certificate"),
    "no table": (["audit", "no.csv", *ARGUMENTS, "--out", "out"], "no.csv: no such file"),
    "a folder for a table": (["audit", "run", *ARGUMENTS, "--out", "out"], "run: is a folder"),
    "too few columns": (["audit", "measured.csv", *ARGUMENTS, "--out", "out"], "measured.csv: must have at least"),
    "too few parameters": (
        ["audit", "measured.csv", *ARGUMENTS, "--parameters", "m=1", "--out", "out"],
        "differ in b, g, l, torque_limit",
    ),
    "not enough states": (["verify", "run", "--states", "4"], "states = 4: must be at least 5, one for each knot's"),
}


@pytest.mark.parametrize("case", OTHERS)
def test_wrong_paths_and_values(case, run, capsys):
    (run / ".lock").touch()
    elite = Path("swept/000_objective=sum_seed=0/elites/000.json")
    elite.parent.mkdir(parents=True)
    elite.write_text('{"volu')
    arguments, words = OTHERS[case]
    assert words in refused(arguments, capsys)


def test_an_audit_does_not_write_over_a_run(run, capsys):
    """Its results are two elites, of the same names."""
    elite = (run / "elites" / "000.npz").read_bytes()
    given = str(table(Path("given.csv")))
    assert "run is not empty and not an audit: it has " in refused(["audit", given, *ARGUMENTS, "--out", "run"], capsys)
    assert (run / "elites" / "000.npz").read_bytes() == elite
    assert cli.main(["audit", given, *ARGUMENTS, "--out", "out", "--states", "9"]) in (0, 1)
    assert cli.main(["audit", given, *ARGUMENTS, "--out", "out", "--states", "9"]) in (0, 1)


def test_what_the_system_refuses_is_one_line(run, capsys, monkeypatch):
    """Whichever verb it comes from, and from however deep."""

    def denied(*_):
        raise PermissionError(13, "Permission denied", "run/elites")

    monkeypatch.setitem(cli.VERBS, "report", denied)
    assert refused(["report", "run"], capsys) == "rtcd: run/elites: Permission denied"
