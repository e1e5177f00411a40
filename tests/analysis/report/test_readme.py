"""launch/bench/readme.py, by which the documents' tables are printed from stored runs and compared with them."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest

from tests.analysis.report.runs import finished, verify_and_disturb
from tests.paths import ROOT


def rows_of(text, name):
    """Of the table of candidates."""
    return [line for line in text.splitlines() if line.startswith(f"| `{name}`") and line.count("|") == 11]


def printed(*arguments):
    command = [sys.executable, ROOT / "launch/bench/readme.py", *map(str, arguments)]
    return subprocess.run(command, text=True, capture_output=True)


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Two runs, and what is printed of them."""
    folder = tmp_path_factory.mktemp("runs")
    runs = finished(folder / "pendulum"), verify_and_disturb(finished(folder / "cartpole", "cartpole"))
    ended = printed(*runs)
    assert ended.returncode == 0, ended.stderr
    return runs, ended.stdout


@pytest.mark.thorough
def test_the_numbers_are_the_stored_ones(tables):
    runs, text = tables
    for run in runs:
        stored = json.loads((run / "elites" / "000.json").read_text())["volumes"]["sum"]
        (row,) = rows_of(text, run.name)
        assert float(re.findall(r"[\d.]+(?:e[+-]\d+)?", row.split("|")[4])[0]) == pytest.approx(stored, rel=5e-3)


@pytest.mark.thorough
def test_a_document_with_all_rows_passes_and_one_with_another_digit_does_not(tables, tmp_path):
    runs, text = tables
    document = tmp_path / "page.md"
    document.write_text(f"# Results\n\n{text}")
    assert printed(*runs, "--check", document).returncode == 0
    (row,) = rows_of(text, "pendulum")
    place = np.random.default_rng(0).choice([k for k, mark in enumerate(row) if mark.isdigit()])
    wrong = f"{row[:place]}{(int(row[place]) + 1) % 10}{row[place + 1 :]}"
    document.write_text(text.replace(row, wrong))
    ended = printed(*runs, "--check", document)
    assert ended.returncode == 1
    assert ended.stdout.splitlines() == [wrong]
