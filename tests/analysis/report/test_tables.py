"""The tables' numbers are the run's, each beside its guarantee."""

import json
import math
from dataclasses import replace

import pytest

from rtcd_jax.analysis.report import tables
from rtcd_jax.analysis.report.page import render
from rtcd_jax.analysis.report.reading import Experiment, compared, read_run
from tests.analysis.report.runs import (
    PROVED,
    SEARCHED_POLICY,
    candidate,
    experiment,
    finished,
    proved,
    run_folder,
    verify_and_disturb,
)


def rows(table):
    """As mappings from heading to cell."""
    return [dict(zip(table.heads, row, strict=True)) for row in table.rows]


def test_table_one_has_initial_optimal_ratio_and_time_with_every_number_s_guarantee(tmp_path):
    folder = finished(tmp_path / "run")
    (folder / "provenance.json").write_text(json.dumps({"starts": [{"seconds": 133.0}]}))
    first, *others = rows(tables.gains([proved(folder)]))
    assert first == {
        "volume": "sum (searched)", "unit": "rad²/s", "initial": 111.0, "optimal": 333.0, "ratio": 3.0,
        "time": "2 min 13 s", "guarantee": "sampled",
    }  # fmt: skip
    assert [row["volume"] for row in others] == [
        "integral", "initial ellipsoid", "geometric mean", "sum", "integral", "initial ellipsoid",
    ]  # fmt: skip
    shown = others[3]
    assert (shown["optimal"], shown["guarantee"], shown["time"]) == (330.0, "proved", "7.25 s")
    assert shown["initial"] is shown["ratio"] is None


def test_without_an_initial_funnel_there_is_no_ratio(tmp_path):
    config = experiment()
    run = read_run(run_folder(tmp_path / "run", config, best=candidate(config)))
    assert {(row["initial"], row["ratio"]) for row in rows(tables.gains([run]))} == {(None, None)}
    assert rows(tables.elites(run))[0]["sum × initial"] is None


def test_elites_are_told_with_designs_weights_volumes_and_guarantee(tmp_path):
    config = experiment()
    folder = run_folder(
        tmp_path / "run", config, candidate(config), [candidate(config, 1, 3.0), candidate(config, 2, 2.0)]
    )
    first, second = rows(tables.elites(read_run(folder)))
    assert (first["elite"], second["elite"]) == ("000", "001")
    assert (first["mass [kg]"], first["q1"], first["q2"], first["r1"]) == (0.7, 10, 1, 0.1)
    assert (first["sum [rad²/s]"], second["sum [rad²/s]"]) == (333, 222)
    assert (first["sum × initial"], second["sum × initial"]) == (3, 2)
    assert {row["guarantee"] for row in (first, second)} == {"sampled"}
    assert "sum shown" not in first
    first, second = rows(tables.elites(proved(folder)))
    assert (first["sum shown"], first["guarantee shown"], second["sum shown"]) == (330.0, "proved", None)


def test_elites_tell_their_spread_and_what_mjx_saw(tmp_path):
    config = experiment()
    folder = run_folder(tmp_path / "run", config, candidate(config), [candidate(config), candidate(config, 1)])
    assert not {"spread of sum [%]", "MJX − closed form"} & rows(tables.elites(read_run(folder)))[0].keys()
    best = folder / "elites" / "000.json"
    found = {"spread": {"keys": 5, "volumes": {"sum": 0.004}}, "mjx": {"difference": 2e-12}}
    best.write_text(json.dumps(json.loads(best.read_text()) | found))
    first, second = rows(tables.elites(read_run(folder)))
    assert (first["spread of sum [%]"], first["MJX − closed form"]) == (0.4, 2e-12)
    assert (second["spread of sum [%]"], second["MJX − closed form"]) == (None, None)


def test_certificates_stand_beside_what_was_sampled(tmp_path):
    folder = finished(tmp_path / "run")
    assert tables.certificates([read_run(folder)]) is None
    (folder / "certificates").mkdir()
    (folder / "certificates" / "summary.json").write_text('{"001": null}')
    first, second = rows(tables.certificates([proved(folder, **read_run(folder).certificates)]))
    assert (first["sum sampled"], first["sum shown"], first["guarantee"]) == (333, 330, "proved")
    assert math.isclose(first["sum shown / sampled"], 330 / 333)
    assert second["guarantee"] == "none: no goal region could be shown"


@pytest.mark.parametrize(
    ("sampled", "shown", "ranks"),
    [((1, 2), (1, 2), None), ((1, 2, 3), (10, 20, 30), (1.0, 3)), ((1, 2, 3), (3, 2, 1), (-1.0, 3))],
)
def test_ranks_agree_from_three_elites_on(tmp_path, sampled, shown, ranks):
    told = {
        f"{i:03d}": replace(PROVED, sampled={"sum": a}, shown={"sum": b})
        for i, (a, b) in enumerate(zip(sampled, shown, strict=True))
    }
    found = tables.ranks(proved(finished(tmp_path / "run"), **told))
    assert found is ranks or found == pytest.approx(ranks)


def test_verification_tells_what_each_simulator_saw(tmp_path):
    folder = finished(tmp_path / "run")
    assert tables.verification([read_run(folder)]) is None
    (row,) = rows(tables.verification([read_run(verify_and_disturb(folder))]))
    assert (row["funnel"], row["simulator"], row["states"], row["promise"]) == ("000", "C MuJoCo", 1020, "not refuted")
    assert (row["at most"], row["promised"], row["confidence"]) == (0.0045, 0.0043, 0.99)


@pytest.mark.parametrize(
    ("summary", "heads", "told"),
    [
        ({"initial": {"success": 0.2}, "best": {"success": 0.9, "lost": 3}}, ("", "success [%]", "lost"),
         (("initial", 20.0, None), ("best", 90.0, 3))),
        ({"starts": 1000, "held": True, "sizes": [1, 2]}, ("", ""),
         (("starts", 1000), ("held", "yes"), ("sizes", "[1, 2]"))),
        ({}, ("", ""), ()),
    ],
)  # fmt: skip
def test_an_experiment_is_told_as_it_is(summary, heads, told):
    table = tables.experiment(Experiment("any", summary, ()))
    assert (table.heads, table.rows) == (heads, told)


def test_runs_are_compared_row_by_row(tmp_path):
    folders = [verify_and_disturb(finished(tmp_path / "rtc", scale=2.0)), finished(tmp_path / "rtcd", scale=5.0)]
    first, second = rows(tables.comparison(compared([proved(folders[0]), read_run(folders[1])])))
    assert (first["run"], first["sum"], first["sum × initial"], first["sum shown"]) == ("rtc", 222, 2, 330)
    assert (second["run"], second["sum"], second["sum × initial"], second["sum shown"]) == ("rtcd", 555, 5, None)
    assert (first["promise"], second["promise"]) == ("not refuted", None)


def test_provenance_names_configuration_and_starts(tmp_path):
    told = dict(tables.provenance([read_run(finished(tmp_path / "run"))]).rows)
    assert len(told["configuration"]) == 12
    assert "commit" in told["start 1"]
    assert "numpy" in told["versions 1"]
    assert told["time"] == "not recorded"


def test_searched_options_of_the_policy_stand_beside_the_weights(tmp_path):
    config = experiment(policy=SEARCHED_POLICY)
    found = candidate(config, 1, 3.0, policy={"input_weight": 1.0, "authority": 0.2, "discount": 0.75})
    run = read_run(run_folder(tmp_path / "searched", config, candidate(config), found))
    assert rows(tables.elites(run))[0]["authority [-]"] == 0.2
    assert "authority = 0.2, discount = 0.75" in render([run])
    other = read_run(finished(tmp_path / "fixed"))
    assert [row["discount [1/s]"] for row in rows(tables.comparison(compared([run, other])))] == [0.75, 0.0]
    assert "authority [-]" not in rows(tables.elites(other))[0]
