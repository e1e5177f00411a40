"""The paper's table from stored runs: their numbers, seeds together, the same cells in all three forms."""

import csv
import io

import numpy as np
import pytest

from rtcd_jax.analysis.report.publication import table_of
from rtcd_jax.analysis.report.reading import read_run
from rtcd_jax.cli import main as cli
from rtcd_jax.system.errors import UserError
from tests.analysis.report.runs import finished

SUM = "sum [rad²/s]"


def cells(runs):
    return list(csv.DictReader(io.StringIO(table_of(runs, "csv"))))


def test_every_run_has_a_row_and_equal_initial_candidates_have_one(tmp_path):
    runs = [read_run(finished(tmp_path / name, scale=scale)) for name, scale in (("a", 2.0), ("b", 4.0))]
    pinned = {"mass": {"initial": 0.7, "min": 0.7, "max": 0.7}, "length": {"initial": 0.4, "min": 0.4, "max": 0.4}}
    runs[1] = read_run(finished(tmp_path / "c", scale=4.0, design=pinned))
    initial, first, second = cells(runs)
    assert [row["candidate"] for row in (initial, first, second)] == ["initial", "a", "c"]
    assert initial["design and weights"] == "mass = 0.7 kg, length = 0.4 m, q = (10, 1), r = 0.1"
    assert [row[SUM] for row in (initial, first, second)] == ["111", "222", "444"]
    assert [row["sum × initial"] for row in (initial, first, second)] == ["-", "2", "4"]
    assert [row["the paper's"] for row in (initial, first, second)] == ["-", "3.90", "3.18"]
    assert first["guarantee"] == "sampled"


def test_runs_that_differ_in_their_seed_alone_are_mean_and_spread(tmp_path):
    scales = (2.0, 3.0, 7.0)
    runs = [read_run(finished(tmp_path / f"s{k}", scale=s, search={"seed": k})) for k, s in enumerate(scales)]
    _, row = cells(runs)
    assert row["candidate"] == "s0 (3 seeds)"
    assert row[SUM] == f"{111 * np.mean(scales):.4g} ± {111 * np.std(scales, ddof=1):.2g}"
    assert row["sum × initial"] == f"{np.mean(scales):.4g} ± {np.std(scales, ddof=1):.2g}"


def test_the_forms_hold_the_same_cells(tmp_path):
    runs = [read_run(finished(tmp_path / "a_b&c"))]
    expected = list(csv.reader(io.StringIO(table_of(runs, "csv"))))
    head, rule, *rows = table_of(runs, "md").splitlines()
    assert [[cell.strip() for cell in line.strip("|").split("|")] for line in (head, *rows)] == expected
    assert set(rule) <= set("|- ")
    lines = [line for line in table_of(runs, "latex").splitlines() if line.endswith(r"\\")]
    assert len(lines) == len(expected)
    assert all(len(line.replace(r"\&", "").split("&")) == len(expected[0]) for line in lines)
    assert r"a\_b\&c" in lines[-1]


def test_runs_of_different_robots_have_no_common_table(tmp_path):
    with pytest.raises(UserError, match="runs of one robot can be compared"):
        table_of([read_run(finished(tmp_path / name, name)) for name in ("pendulum", "cartpole")], "md")


def test_the_verb_prints_it_and_writes_nothing(tmp_path, capsys):
    run = finished(tmp_path / "run")
    before = sorted(tmp_path.rglob("*"))
    assert cli.main(["report", str(run), "--table", "md"]) == 0
    assert capsys.readouterr().out.startswith("| candidate | design and weights | sum [rad²/s] |")
    assert sorted(tmp_path.rglob("*")) == before
