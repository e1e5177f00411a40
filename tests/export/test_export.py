"""An export is whole, says what it is, replaces nothing but a former one, and refuses with one clear line."""

import csv
import hashlib
import json
import shutil

import numpy as np
import pytest
import yaml

from rtcd_jax.certificate import check
from rtcd_jax.elite.records import read_elite
from rtcd_jax.export import export_run
from rtcd_jax.system.errors import UserError
from tests.certificate.test_check import resealed
from tests.consoles import Output
from tests.export.conftest import module
from tests.export.folders import run_folder


@pytest.fixture
def run(tmp_path):
    """A pendulum's run folder."""
    return run_folder(tmp_path / "run", "pendulum")


def table(path):
    """The header and the numbers of a CSV file."""
    with path.open() as file:
        header, *rows = csv.reader(file)
    return header, np.array(rows, float)


@pytest.mark.thorough
def test_the_trajectory_has_the_columns_of_the_toolkits(export):
    arrays, _ = read_elite(export.run / "elites", "000")
    header, rows = table(export.folder / "trajectory.csv")
    u = np.append(arrays["u"][:, 0], 0)
    if export.bundle.elite.plant == "pendulum":
        assert header == ["time", "pos", "vel", "torque"]
        np.testing.assert_array_equal(rows, np.column_stack([arrays["time"], arrays["x"], u]))
        return
    assert header[:7] == ["time", "pos1", "pos2", "vel1", "vel2", "tau1", "tau2"]
    assert header[7:] == ["K11", "K12", "K13", "K14", "K21", "K22", "K23", "K24"]
    np.testing.assert_array_equal(rows[:, :7], np.column_stack([arrays["time"], arrays["x"], u, 0 * u]))
    np.testing.assert_array_equal(rows[:, 7:11], arrays["K"][:, 0])
    np.testing.assert_array_equal(rows[:, 11:], 0)


@pytest.mark.thorough
def test_the_tables_read_back_to_the_elites_own_numbers(export):
    arrays, _ = read_elite(export.run / "elites", "000")
    header, rows = table(export.folder / "gains.csv")
    assert header[:2] == ["time", "K11"]
    np.testing.assert_array_equal(rows[:, 1:], arrays["K"].reshape(len(rows), -1))
    header, rows = table(export.folder / "funnel.csv")
    assert header[:4] == ["time", "rho", "volume_sampled", "S11"]
    np.testing.assert_array_equal(rows[:, 1:3], np.column_stack([arrays["rho"], arrays["volumes_per_knot"]]))
    n = arrays["S"].shape[1]
    for name, column in zip(header[3:], rows[:, 3:].T, strict=True):
        i, j = int(name[1]) - 1, int(name[2]) - 1
        assert i <= j < n
        np.testing.assert_array_equal(column, arrays["S"][:, i, j])


def test_the_bundle_says_what_its_numbers_mean(export):
    told = json.loads((export.folder / f"{export.bundle.label}_controller.json").read_text())
    elite = export.bundle.elite
    assert [state["name"] for state in told["states"]] == list(export.bundle.plant.state_names)
    limits = [None if state["limit"] is None else state["limit"] for state in told["states"]]
    assert limits == [limit if np.isfinite(limit) else None for limit in elite.state_limits.tolist()]
    assert told["inputs"][0]["limit"] == elite.u_max[0]
    assert "upright" in told["convention"]
    assert told["funnel"]["rung"] == "sampled"
    assert (told["funnel"]["epsilon"], told["funnel"]["confidence"]) == (0.01, 0.99)
    assert told["config_hash"] == "0123456789ab"
    assert told["certificate"] is None
    parameters = yaml.safe_load((export.folder / "parameters.yaml").read_text())["parameters"]
    assert {name: entry["value"] for name, entry in parameters.items()} == dict(elite.parameters)
    assert all(entry["unit"] for entry in parameters.values())


def test_the_mark_has_the_digest_of_every_file(export):
    mark = json.loads((export.folder / "export.json").read_text())
    assert mark["complete"] is True
    there = {path.name for path in export.folder.iterdir() if path.is_file()} - {"export.json"}
    assert there == mark["files"].keys()
    for name, digest in mark["files"].items():
        assert hashlib.sha256((export.folder / name).read_bytes()).hexdigest() == digest


@pytest.mark.thorough
def test_exports_of_the_same_elite_are_equal_bit_by_bit(export, tmp_path):
    output = Output()
    export_run(export.run, 0, tmp_path / "again", output.console)
    for path in export.folder.iterdir():
        if path.is_file():
            assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes()
    assert any("elite 000, is in" in line for line in output.lines)


def listing(target, **files):
    """The mark of the export in `target`, with further files in it, by name and content."""
    mark = json.loads((target / "export.json").read_text())
    mark["files"] |= {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    (target / "export.json").write_text(json.dumps(mark))


@pytest.mark.thorough
def test_a_former_export_is_replaced_and_its_stale_files_go(run, tmp_path):
    target = tmp_path / "lab"
    export_run(run, 0, target, Output().console)
    (target / "certificate.json").write_text("old")
    (target / "notes.txt").write_text("mine")
    (target / "gains.csv").write_text("old")
    listing(target, **{"certificate.json": b"old"})
    output = Output()
    export_run(run, "initial", target, output.console)
    assert any("elite initial, replaces the former export" in line for line in output.lines)
    assert not (target / "certificate.json").exists()
    assert not (target / "pendulum_000_controller.py").exists()
    assert (target / "pendulum_initial_controller.py").is_file()
    assert (target / "notes.txt").read_text() == "mine"
    assert (target / "gains.csv").read_text() != "old"


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["../precious.txt", "{absolute}", "sub/../../precious.txt", "..\\precious.txt"])
def test_what_a_former_exports_mark_names_elsewhere_is_not_touched(run, tmp_path, name):
    target, precious = tmp_path / "lab", tmp_path / "precious.txt"
    precious.write_text("mine")
    export_run(run, 0, target, Output().console)
    (target / "sub").mkdir()
    listing(target, **{name.format(absolute=precious): b"mine"})
    export_run(run, 0, target, Output().console)
    assert precious.read_text() == "mine"


@pytest.mark.thorough
def test_no_link_is_followed_or_deleted(run, tmp_path):
    target, precious = tmp_path / "lab", tmp_path / "precious.txt"
    precious.write_text("mine")
    export_run(run, 0, target, Output().console)
    for name in ("stale.txt", "gains.csv", ".funnel.csv.tmp"):
        (target / name).unlink(missing_ok=True)
        (target / name).symlink_to(precious)
    listing(target, **{"stale.txt": b"mine"})
    output = Output()
    export_run(run, 0, target, output.console)
    assert precious.read_text() == "mine"
    assert (target / "stale.txt").is_symlink()
    assert not (target / "gains.csv").is_symlink()
    assert any("left where they are" in line and "stale.txt" in line for line in output.lines)


@pytest.mark.thorough
def test_a_file_that_was_changed_since_is_not_deleted(run, tmp_path):
    target = tmp_path / "lab"
    export_run(run, 0, target, Output().console)
    edited = target / "pendulum_000_controller.py"
    edited.write_text("# mine")
    output = Output()
    export_run(run, "initial", target, output.console)
    assert edited.read_text() == "# mine"
    assert any("pendulum_000_controller.py" in line for line in output.lines)
    assert not (target / "pendulum_000_controller.c").exists()


@pytest.mark.thorough
def test_a_file_that_no_export_has_written_is_not_replaced(run, tmp_path):
    target = tmp_path / "lab"
    export_run(run, 0, target, Output().console)
    mark = json.loads((target / "export.json").read_text())
    del mark["files"]["README.md"]
    (target / "export.json").write_text(json.dumps(mark))
    (target / "README.md").write_text("mine")
    with pytest.raises(UserError, match=r"lab has README.md, which the former export has not written: move it away"):
        export_run(run, 0, target, Output().console)
    assert (target / "README.md").read_text() == "mine"


@pytest.mark.parametrize("mark", ["[]", '{"format": "rtcd_jax export", "files": ["thesis.tex"]}', "[" * 100_000])
def test_a_mark_that_no_export_has_written_is_none(run, tmp_path, mark):
    target = tmp_path / "lab"
    target.mkdir()
    (target / "export.json").write_text(mark)
    (target / "thesis.tex").write_text("all")
    with pytest.raises(UserError, match="is not empty and not an export"):
        export_run(run, 0, target, Output().console)


@pytest.mark.thorough
def test_an_export_that_a_kill_has_left_half_done_says_so_and_is_taken_up(run, tmp_path, monkeypatch):
    target = tmp_path / "lab"

    def killed(path, content):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("rtcd_jax.export.replace", killed)
        with pytest.raises(KeyboardInterrupt):
            export_run(run, 0, target, Output().console)
    assert json.loads((target / "export.json").read_text())["complete"] is False
    export_run(run, 0, target, Output().console)
    assert json.loads((target / "export.json").read_text())["complete"] is True


def test_a_folder_of_something_else_is_left_alone(run, tmp_path):
    target = tmp_path / "mine"
    target.mkdir()
    (target / "thesis.tex").write_text("all")
    with pytest.raises(UserError, match=r"mine is not empty and not an export: it has thesis.tex"):
        export_run(run, 0, target, Output().console)
    (target / "export.json").write_text('{"format": "another"}')
    with pytest.raises(UserError, match=r"not empty and not an export: it has export.json, thesis.tex"):
        export_run(run, 0, target, Output().console)
    with pytest.raises(UserError, match=r"thesis.tex is a file: an export needs a folder"):
        export_run(run, 0, target / "thesis.tex", Output().console)
    assert sorted(path.name for path in target.iterdir()) == ["export.json", "thesis.tex"]


def test_an_elite_that_is_not_there_is_answered_with_those_that_are(run, tmp_path):
    with pytest.raises(UserError, match=r"has no elite 007; there are 000$"):
        export_run(run, 7, tmp_path / "lab", Output().console)
    with pytest.raises(UserError, match=r"no run folder: it has no format"):
        export_run(tmp_path, 0, tmp_path / "lab", Output().console)
    assert not (tmp_path / "lab").exists()


def test_a_candidate_without_a_funnel_is_not_exported(tmp_path):
    run = run_folder(tmp_path / "run", "pendulum", status="FUNNEL_EMPTY")
    with pytest.raises(UserError, match=r"initial has no funnel \(FUNNEL_EMPTY\)"):
        export_run(run, "initial", tmp_path / "lab", Output().console)


@pytest.mark.thorough
def test_a_proved_elites_claim_stands_wherever_its_controller_does(proved):
    content = json.loads((proved.folder / "certificate.json").read_text())
    claim = check.digest(content["claim"])
    assert (proved.folder / "certificate.json").read_bytes() == (proved.run / "certificates" / "000.json").read_bytes()
    told = json.loads((proved.folder / "pendulum_000_controller.json").read_text())
    assert (told["certificate"]["rung"], told["certificate"]["claim"]) == ("proved", claim)
    assert told["certificate"]["volumes"] == check.check(content).volumes
    assert told["monitor"]["guarantee"] == "proved"
    assert told["funnel"]["rung"] == "sampled"
    assert json.loads((proved.folder / "export.json").read_text())["claim"] == claim
    assert claim == proved.module.CLAIM
    assert f'pendulum_000_claim[] = "{claim}"' in (proved.folder / "pendulum_000_controller.c").read_text()
    assert f"`{claim}`" in (proved.folder / "README.md").read_text()


def cheat(content):
    """A matrix of the proof is another: the checker refuses it."""
    piece = content["funnel"][0]
    certificate = next(iter(piece["cases"].values()))
    certificate["gram"][0][0] = "-0x1.0p+3"
    return resealed(content)


def heavier(content):
    content["claim"]["parameters"]["m"] = [(6.0).hex()] * 2
    return resealed(content)


WORTHLESS = {"refused": cheat, "of another elite": heavier, "damaged": lambda content: "{"}


@pytest.mark.thorough
@pytest.mark.parametrize("verdict", WORTHLESS)
def test_a_certificate_that_does_not_prove_this_elite_does_not_go_along(proved, tmp_path, verdict):
    run = shutil.copytree(proved.run, tmp_path / "run")
    certificate = run / "certificates" / "000.json"
    changed = WORTHLESS[verdict](json.loads(certificate.read_text()))
    certificate.write_text(changed if isinstance(changed, str) else json.dumps(changed))
    output, target = Output(), tmp_path / "lab"
    export_run(run, 0, target, output.console)
    assert not (target / "certificate.json").exists()
    told = json.loads((target / "pendulum_000_controller.json").read_text())
    assert (told["certificate"], told["monitor"]["guarantee"]) == (None, "sampled")
    assert json.loads((target / "export.json").read_text())["claim"] is None
    assert f"certificate: {verdict}, so it does not go along: " in output.getvalue()
    assert f"Nothing is proved: the certificate is {verdict}." in (target / "README.md").read_text()
    assert module(target / "pendulum_000_controller.py").CLAIM == ""
