"""The page says "proved" by the checker alone: not where the certificate is gone, changed or another elite's."""

import json
import shutil

import numpy as np
import pytest

from rtcd_jax.analysis.report import tables
from rtcd_jax.analysis.report.page import render
from rtcd_jax.analysis.report.reading import read_run
from rtcd_jax.certificate.prove.run import certify_run
from rtcd_jax.elite.records import read_elite, write_elite
from rtcd_jax.system.console import silent
from rtcd_jax.system.errors import UserError
from tests.analysis.report.runs import candidate, experiment, run_folder
from tests.analysis.report.test_tables import rows
from tests.certificate import swing
from tests.certificate.test_check import nudged, resealed


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """A finished run whose elite 000 is proved."""
    config, (arrays, record) = experiment(), swing.elite()
    filler = candidate(config)
    elite = {**filler[0], **arrays}, {**filler[1], **record}
    folder = run_folder(tmp_path_factory.mktemp("proof") / "run", config, filler, elite)
    assert certify_run(folder, 1, "proved", 1, silent())
    return folder


@pytest.fixture
def run(certified, tmp_path):
    return shutil.copytree(certified, tmp_path / "run")


@pytest.mark.thorough
def test_what_the_checker_accepts_is_proved(run):
    text = render([read_run(run)])
    (row,) = rows(tables.certificates([read_run(run)]))
    assert "<strong>proved</strong><small>of the best&#x27;s funnel</small>" in text
    assert (row["guarantee"], row["from [s]"], row["intervals"]) == ("proved", 0.0, 4)


def test_proved_volumes_are_the_checker_s_not_the_summary_s(run):
    (before,) = rows(tables.certificates([read_run(run)]))
    summary = run / "certificates" / "summary.json"
    told = json.loads(summary.read_text())
    told["000"]["found"]["sum"] = 1e6
    told["000"]["start"] = 0.1
    summary.write_text(json.dumps(told))
    assert rows(tables.certificates([read_run(run)])) == [before]


def _rewrite(run, changed):
    file = run / "certificates" / "000.json"
    content = json.loads(file.read_text())
    changed(content)
    file.write_text(json.dumps(resealed(content)))


def _another_elite(run):
    arrays, record = read_elite(run / "elites", "000")
    arrays["K"] = np.nextafter(arrays["K"], np.inf)
    write_elite(run / "elites", "000", arrays, record)


BREAKS = {
    "missing": lambda run: (run / "certificates" / "000.json").unlink(),
    "damaged": lambda run: (run / "certificates" / "000.json").write_text("{}"),
    "refused": lambda run: _rewrite(run, lambda c: c["goal"]["axes"][0].__setitem__(0, nudged("0x1p+4"))),
    "of another elite": _another_elite,
}


@pytest.mark.thorough
@pytest.mark.parametrize("verdict", BREAKS)
def test_what_the_checker_does_not_accept_for_this_elite_is_not_proved(run, verdict):
    BREAKS[verdict](run)
    found = read_run(run)
    text = render([found])
    (row,) = rows(tables.certificates([found]))
    assert f"<strong>none</strong><small>certificate {verdict}</small>" in text
    assert row["guarantee"].startswith("none: ")
    assert row["sum shown"] is None
    assert ">proved<" not in text
    assert "sum shown" not in tables.elites(found).heads
    assert {row["guarantee"] for row in rows(tables.gains([found]))} == {"sampled"}
    assert "proved" not in rows(tables.comparison([found]))[0].values()


def test_what_floating_point_numbers_show_stays_certified_while_the_file_is_whole(run):
    summary = run / "certificates" / "summary.json"
    told = json.loads(summary.read_text())
    told["000"]["rung"] = "certified"
    summary.write_text(json.dumps(told))
    BREAKS["refused"](run)
    (row,) = rows(tables.certificates([read_run(run)]))
    assert (row["guarantee"], row["sum shown"]) == ("certified", told["000"]["found"]["sum"])
    BREAKS["missing"](run)
    (row,) = rows(tables.certificates([read_run(run)]))
    assert row["guarantee"].startswith("none: ")


@pytest.mark.parametrize("entry", [{}, 3, {"seconds": "x", "sampled": {}}, {"seconds": 1, "sampled": {"sum": []}}])
def test_a_damaged_summary_is_named(run, entry):
    (run / "certificates" / "summary.json").write_text(json.dumps({"000": entry}))
    with pytest.raises(UserError, match=r"cannot read .*summary\.json: .*; remove it, or make it again"):
        read_run(run)
