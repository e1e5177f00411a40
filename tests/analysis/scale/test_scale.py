"""A scaling study measures real generations, keeps what it has, and a point that fails is a row that says why."""

import csv
import json
import subprocess
from types import SimpleNamespace

import pytest

from rtcd_jax.analysis.scale.study import OUT_OF_MEMORY, efficiencies, row_of, study
from rtcd_jax.cli import main as cli
from rtcd_jax.config.load import EXAMPLE, parse_yaml
from tests.consoles import Screen


def point(population, devices, seconds):
    """A point whose generations take as long as it says."""
    times = [seconds, 2 * seconds, seconds]
    return {
        "population": population,
        "devices": devices,
        "kind": "cpu",
        "chunk": 64,
        "compilation": 9.0,
        "generations": times,
        "evaluation": [0.9 * time for time in times],
        "search": [0.1 * seconds] * 3,
        "lines": [0.0] * 3,
        "checkpoint": 0.4,
        "checkpoint_every": 20.0,
        "cpu": times,
        "feasible": 1.0,
        "peak_memory": 2**30,
        "peak_device_memory": None,
    }


def answering(monkeypatch, answer):
    """Stands in for the processes that measure; records what they were asked."""
    asked = []

    def run(command, **_):
        population, devices = map(int, command[-3:-1])
        asked.append((population, devices))
        return SimpleNamespace(**({"returncode": 0, "stdout": "", "stderr": ""} | answer(population, devices)))

    monkeypatch.setattr(subprocess, "run", run)
    return asked


def measured(population, devices):
    return {"stdout": "noise\n" + json.dumps(point(population, devices, population / 100 / devices))}


def test_rates_and_shares_are_those_of_the_median_generation():
    row = row_of(point(64, 2, 0.5))
    assert row["candidates_per_s"] == 128
    assert (row["candidates_per_s_min"], row["candidates_per_s_max"]) == (64, 128)
    assert row["device_ms_per_candidate"] == pytest.approx(1e3 * 0.5 * 2 / 64)
    checkpoint = 0.4 * 0.5 / 20
    assert row["overhead"] == pytest.approx((0.05 + checkpoint) / (0.5 + checkpoint))


def test_efficiency_is_one_where_the_rate_grows_with_the_devices():
    rows = [row_of(point(64, devices, seconds)) for devices, seconds in ((1, 1.0), (2, 0.5), (4, 0.5))]
    assert efficiencies(rows) == {(64, 1): 1.0, (64, 2): 1.0, (64, 4): 0.5}


@pytest.mark.thorough
def test_a_study_leaves_points_table_and_figures_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    config = parse_yaml(EXAMPLE)
    asked = answering(monkeypatch, measured)
    study(tmp_path / "x.yaml", config, (64, 32), (1,), 3, tmp_path / "study", Screen().console)
    assert asked == [(32, 1), (64, 1)]
    screen = Screen()
    study(tmp_path / "x.yaml", config, (64, 32), (1, 2), 3, tmp_path / "study", screen.console)
    assert asked[2:] == [(32, 2), (64, 2)]
    assert "point 4/4: population 64, 2 devices: 200 candidates/s" in screen.text
    with (tmp_path / "study" / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["population"], row["devices"]) for row in rows] == [("32", "1"), ("32", "2"), ("64", "1"), ("64", "2")]
    assert [float(row["candidates_per_s"]) for row in rows] == [100, 200, 100, 200]
    for suffix in ("png", "pdf"):
        assert (tmp_path / "study" / f"scaling.{suffix}").stat().st_size > 10_000
    other = config.model_copy(update={"search": config.search.model_copy(update={"sigma": 0.2})})
    study(tmp_path / "x.yaml", other, (32,), (1,), 3, tmp_path / "study", Screen().console)
    assert asked[4:] == [(32, 1)]


@pytest.mark.thorough
def test_a_line_that_a_kill_has_torn_costs_its_point_alone(tmp_path, monkeypatch):
    config = parse_yaml(EXAMPLE)
    asked = answering(monkeypatch, measured)
    study(tmp_path / "x.yaml", config, (32, 64), (1,), 3, tmp_path, Screen().console)
    points = tmp_path / "points.jsonl"
    first, second = points.read_bytes().splitlines(keepends=True)
    points.write_bytes(second[:30] + b"\n" + first + second[:-9])
    for _ in range(2):
        study(tmp_path / "x.yaml", config, (32, 64), (1,), 3, tmp_path, Screen().console)
    assert asked == [(32, 1), (64, 1), (64, 1)]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("failure", "why"),
    [
        ({"returncode": -9}, OUT_OF_MEMORY),
        ({"returncode": 1, "stderr": "jaxlib: RESOURCE_EXHAUSTED: 9 GiB\nat somewhere"}, OUT_OF_MEMORY),
        (
            {"returncode": 2, "stderr": "a\nrtcd: --devices = 2: this process sees 1"},
            "rtcd: --devices = 2: this process",
        ),
    ],
)
def test_a_point_that_fails_says_why_the_others_go_on_and_it_is_tried_again(tmp_path, monkeypatch, failure, why):
    asked = answering(monkeypatch, lambda population, devices: failure if population > 32 else measured(32, devices))
    for _ in range(2):
        screen = Screen()
        study(tmp_path / "x.yaml", parse_yaml(EXAMPLE), (32, 64), (1,), 3, tmp_path, screen.console)
        assert f"population 64, 1 devices: {why}" in screen.text
        assert "population 32, 1 devices: 100 candidates/s" in screen.text
    assert asked == [(32, 1), (64, 1), (64, 1)]
    with (tmp_path / "table.csv").open() as file:
        assert [bool(row["failed"]) for row in csv.DictReader(file)] == [False, True]


def test_nothing_but_failures_is_no_crash(tmp_path, monkeypatch):
    answering(monkeypatch, lambda population, devices: {"returncode": -9})
    study(tmp_path / "x.yaml", parse_yaml(EXAMPLE), (32,), (1,), 3, tmp_path, Screen().console)
    assert (tmp_path / "table.csv").read_text() == "population,devices,failed\n32,1,out of memory\n"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--populations", "64,x"], "--populations = 64,x: must be whole numbers, split by commas"),
        (["--populations", "3"], "--populations = 3: all must be >= 4"),
        (["--devices", "0,1"], "--devices = 0,1: all must be >= 1"),
        (["--repeats", "0"], "--repeats = 0: must be >= 1"),
    ],
)
def test_wrong_numbers_are_named(options, message, capsys):
    assert cli.main(["scale", "configs/smoke.yaml", *options]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_real_point(tmp_path):
    assert cli.main(["scale", "configs/smoke.yaml", "--populations", "8", "--devices", "1", "--repeats", "2",
                     "--folder", str(tmp_path)]) == 0  # fmt: skip
    (line,) = (tmp_path / "points.jsonl").read_text().splitlines()
    found = json.loads(line)
    assert len(found["generations"]) == 2
    assert 0 < min(found["evaluation"]) < min(found["generations"])
    assert found["compilation"] > max(found["generations"])
