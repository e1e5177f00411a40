"""A sweep's cases are those of its section, each in a folder of its own, and its table says what was found."""

import csv
import json

import pytest
import yaml

from rtcd_jax.cli import main as cli
from rtcd_jax.config.load import EXAMPLE, load, parse_yaml
from rtcd_jax.run.sweep import read_cases, show, store
from rtcd_jax.system.errors import ConfigError, UserError
from tests.paths import ROOT


def written(folder, sweep, **sections):
    path = folder / "many.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(EXAMPLE) | sections | {"sweep": sweep}, sort_keys=False))
    return path


def test_every_combination_of_product_with_every_row_of_zip(tmp_path):
    sweep = {
        "product": {"search.seed": [3, 4], "design.mass.max": [0.8, 0.9]},
        "zip": {"funnel.steps": [5, 6, 7], "trajectory.knots": [16, 17, 18]},
    }
    cases = read_cases(written(tmp_path, sweep), tmp_path / "runs")
    found = {
        (c.config.search.seed, c.config.design["mass"].max, c.config.funnel.steps, c.config.trajectory.knots)
        for c in cases
    }
    rows = [(5, 16), (6, 17), (7, 18)]
    assert found == {(seed, mass, *row) for seed in (3, 4) for mass in (0.8, 0.9) for row in rows}
    assert [case.number for case in cases] == list(range(12))
    assert len({case.folder for case in cases}) == 12
    assert cases[0].folder == tmp_path / "runs" / "000_seed=3_max=0.8_steps=5_knots=16"
    base = parse_yaml(EXAMPLE).model_dump()
    only = cases[-1].config.model_dump()
    changed = {section for section in base if base[section] != only[section]}
    assert changed == {"search", "design", "funnel", "trajectory"}


def test_an_entry_of_a_list_can_be_swept(tmp_path):
    cases = read_cases(written(tmp_path, {"product": {"weights.r.0.max": [5, 20]}}), tmp_path)
    assert [case.config.weights.r[0].max for case in cases] == [5, 20]


def test_keys_of_one_last_name_are_told_apart(tmp_path):
    path = written(tmp_path, {"zip": {"elites.directions": [8], "funnel.directions": [9]}})
    assert read_cases(path, tmp_path)[0].folder.name == "000_elites.directions=8_funnel.directions=9"


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        ([], r"sweep = \[\]: must be a mapping with product or zip"),
        ({"produkt": {}}, r"sweep.produkt = \{\}: unknown key; did you mean 'product'"),
        ({"product": {"search.seed": 3}}, r"sweep.product.search.seed = 3: must be a list of values"),
        ({"zip": {"search.seed": [1, 2], "funnel.steps": [3]}}, "all lists must be of one length"),
        ({"product": {"search.seed": [1]}, "zip": {"search.seed": [2]}}, "in product or in zip, not in both"),
        ({"product": {"search.sed": [1]}}, r"case 000_sed=1: search.sed = 1: .*did you mean 'seed'"),
        ({"product": {"search.seed": [1, -1]}}, r"case 001_seed=-1: search.seed = -1: must be >= 0"),
        ({"product": {"search.seed.deep": [1]}}, r"sweep.search.seed.deep: leads to no place in the file"),
        ({"product": {"weights.r.7.max": [1]}}, r"sweep.weights.r.7.max: leads to no place in the file"),
        (
            {"product": {f"{key}.directions": list(range(1, 102)) for key in ("funnel", "elites")}},
            "sweep: makes 10201 runs, must make 10000 at most",
        ),
    ],
)
def test_what_is_wrong_is_named(tmp_path, sweep, message):
    with pytest.raises(ConfigError, match=message):
        read_cases(written(tmp_path, sweep, search={"seed": 0}), tmp_path)


def test_a_file_without_a_section_and_one_with_it_know_their_commands(tmp_path):
    with pytest.raises(UserError, match=r"has no sweep section; `rtcd optimize"):
        read_cases(ROOT / "configs" / "smoke.yaml", tmp_path)
    with pytest.raises(ConfigError, match=r"they are started by `rtcd sweep"):
        load(ROOT / "configs" / "sweep.yaml")
    assert len(read_cases(ROOT / "configs" / "sweep.yaml", tmp_path)) == 6


def test_the_table_has_what_is_known(tmp_path):
    cases = read_cases(written(tmp_path, {"product": {"search.seed": [0, 1]}}), tmp_path / "runs")
    folder = cases[1].folder
    (folder / "elites").mkdir(parents=True)
    volumes = {"sum": 2.0, "integral": 1.0, "inlet": 0.5, "geometric_mean": 0.25}
    (folder / "initial.json").write_text(json.dumps({"volumes": volumes}))
    (folder / "elites" / "000.json").write_text(json.dumps({"volumes": volumes | {"sum": 7.0}}))
    (folder / "generations.jsonl").write_text('{"index": 0}\n{"index": 2}\n{"ind')
    lines = [*show(cases).splitlines(), str(store(cases, tmp_path / "runs"))]
    assert [line.split() for line in lines[-4:-1]][1:] == [["0", "0", "0/60"], ["1", "1", "3/60", "2", "7", "3.5"]]
    with (tmp_path / "runs" / "table.csv").open() as file:
        nothing, something = csv.DictReader(file)
    assert (something["best_sum"], something["initial_inlet"], something["rung"]) == ("7.0", "0.5", "sampled")
    assert (nothing["best_sum"], nothing["rung"], nothing["search.seed"]) == ("", "", "0")


def test_a_case_that_is_not_there_cannot_be_asked_for(tmp_path, capsys):
    path = written(tmp_path, {"product": {"search.seed": [0, 1]}})
    assert cli.main(["sweep", str(path), "--case", "2", "--folder", str(tmp_path)]) == 2
    assert "--case = 2: must be one of 0 … 1" in capsys.readouterr().err
    assert cli.main(["sweep", str(path), "--list", "--folder", str(tmp_path / "runs")]) == 0
    assert "0/60" in capsys.readouterr().out


def test_a_list_of_the_cases_writes_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, {"product": {"search.seed": [0, 1]}})
    before = sorted(tmp_path.rglob("*"))
    for folder in ([], ["--folder", "runs"]):
        assert cli.main(["sweep", str(path), "--list", *folder]) == 0
    assert "0/60" in capsys.readouterr().out
    assert sorted(tmp_path.rglob("*")) == before
