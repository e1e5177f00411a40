"""Figures of disturbances from records made by hand: what they show, for one controller and for two, and refusals."""

import json

import numpy as np
import pytest

from rtcd_jax.analysis.disturb.figures import draw_disturbance
from rtcd_jax.system.errors import UserError

LEVELS = [-0.25, 0.0, 0.25]


def records(names):
    """All experiments of the named controllers."""
    shares = {key: 0.5 for name in names for key in (name, f"{name} lower", f"{name} upper")}
    return {
        "off_nominal": {
            "states": 10, "confidence": 0.95, "factors": [1, 4],
            "summary": {f"{name} ellipsoid x {factor}": shares for name in names for factor in (1, 4)},
        },
        "impulse": {
            "impulse_unit": "N m s", "impulses": [-1.0, 0.0, 1.0],
            "times": {name: [0.1, 0.2] for name in names},
            "recovered": {name: [[True, True, False], [False, True, True]] for name in names},
            "summary": {name: {"recovered": 2 / 3, "largest_at_all_times": 0.0} for name in names},
        },
        "push_margin": {
            "impulse_unit": "N m s",
            "times": {name: [0.1, 0.2] for name in names},
            "inside_funnel": {name: [0.2, 0.1] for name in names},
            "tolerated": {name: [0.3, 0.0] for name in names},
            "summary": {name: {"push_margin": 0.1, "tolerated_at_all_times": 0.0} for name in names},
        },
        "robustness": {
            "troubles": [
                {"name": "mass", "unit": "relative", "levels": LEVELS, "success": {name: [0, 1, 1] for name in names}},
                {"name": "delay", "unit": "s", "levels": [0.0, 0.05], "success": {name: [1, 0] for name in names}},
            ],
            "summary": {name: {"score": 0.5} for name in names},
        },
    }  # fmt: skip


def folder_of(path, names):
    """A run folder with the records of the named controllers."""
    (path / "disturbance").mkdir(parents=True)
    for name, record in records(names).items():
        (path / "disturbance" / f"{name}.json").write_text(json.dumps(record))
    return path


@pytest.mark.parametrize("names", [["best"], ["initial", "best"]], ids=len)
def test_every_record_becomes_a_picture_and_a_print(tmp_path, names):
    paths = draw_disturbance(folder_of(tmp_path, names))
    assert [path.name for path in paths] == [
        f"{name}.{suffix}"
        for name in ("off_nominal", "impulse", "push_margin", "robustness")
        for suffix in ("png", "pdf")
    ]
    assert all(path.stat().st_size > 1000 for path in paths)


def test_the_heat_map_has_every_cell_at_its_time_and_impulse(tmp_path, figures):
    draw_disturbance(folder_of(tmp_path, ["initial", "best"]))
    panels = figures[2].axes  # each figure is saved as PNG and as PDF
    assert [axes.get_title() for axes in panels] == ["initial: 67% recovered", "best: 67% recovered"]
    (mesh,) = panels[0].collections
    np.testing.assert_array_equal(np.asarray(mesh.get_array()).reshape(3, 2), [[1, 0], [1, 1], [0, 1]])
    assert panels[0].get_ylabel() == "impulse [N m s]"


def test_strips_say_levels_in_their_unit(tmp_path, figures):
    draw_disturbance(folder_of(tmp_path, ["best"]))
    panels = figures[6].axes
    labels = [[label.get_text() for label in axes.get_xticklabels()] for axes in panels]
    assert labels == [["0", "0.05"], ["-25%", "0%", "+25%"]]
    assert [axes.get_title(loc="left") for axes in panels] == ["delay [s]", "mass [relative]"]


def test_what_fails_first_stands_first(tmp_path, figures):
    folder = folder_of(tmp_path, ["initial", "best"])
    path = folder / "disturbance" / "robustness.json"
    record = json.loads(path.read_text())
    record["troubles"][0]["success"] = {"initial": [1, 1, 1], "best": [0, 0, 1]}
    path.write_text(json.dumps(record))
    draw_disturbance(folder)
    assert [axes.get_title(loc="left") for axes in figures[6].axes] == ["mass [relative]", "delay [s]"]


def test_a_record_that_is_not_there_or_damaged_is_named(tmp_path):
    folder = folder_of(tmp_path, ["best"])
    (folder / "disturbance" / "impulse.json").write_text("{")
    with pytest.raises(UserError, match=r"cannot read .*impulse.json.*make it by `rtcd disturb`"):
        draw_disturbance(folder)
    with pytest.raises(UserError, match=r"cannot read .*off_nominal.json"):
        draw_disturbance(tmp_path / "elsewhere")
