"""The files of a run folder: read back as they were written, damage named."""

import subprocess
import sys
import time

import numpy as np
import pytest

from rtcd_jax.elite import records
from rtcd_jax.system.errors import UserError
from tests.paths import ROOT


def test_an_elite_is_read_back_as_it_was_written_and_equal_contents_give_equal_bytes(tmp_path):
    arrays = {"rho": np.array([0.1, np.inf]), "x": np.arange(6.0).reshape(3, 2), "trials": np.array([3])}
    record = {"rung": "sampled", "volume": 0.1 + 0.2, "bad": float("nan"), "array": np.array([1.5, -np.inf])}
    records.write_elite(tmp_path, "000", arrays, record)
    first = [(tmp_path / name).read_bytes() for name in ("000.npz", "000.json")]
    time.sleep(0.01)
    records.write_elite(tmp_path, "000", arrays, record)
    assert first == [(tmp_path / name).read_bytes() for name in ("000.npz", "000.json")]
    loaded, read = records.read_elite(tmp_path, "000")
    assert loaded.keys() == arrays.keys()
    assert all(np.array_equal(loaded[key], arrays[key]) and loaded[key].dtype == arrays[key].dtype for key in arrays)
    assert read == {"rung": "sampled", "volume": 0.1 + 0.2, "bad": None, "array": [1.5, None]}
    assert "NaN" not in (tmp_path / "000.json").read_text()
    assert len((tmp_path / "000.json").read_text().splitlines()) > len(record)


def test_a_folder_without_the_mark_is_no_run(tmp_path):
    with pytest.raises(UserError, match=r"is no run folder: it has no format\.json"):
        records.read_config(tmp_path)


@pytest.mark.parametrize("value", [[1.0], np.array(["a"]), np.array([None])])
def test_arrays_that_others_cannot_read_are_refused(tmp_path, value):
    with pytest.raises(TypeError, match=r"000\.npz: rho must be a numpy array of numbers"):
        records.write_elite(tmp_path, "000", {"rho": value}, {})


def test_values_that_json_does_not_have_are_refused(tmp_path):
    with pytest.raises(TypeError, match="JSON has no set"):
        records.write_elite(tmp_path, "000", {}, {"a": {1}})


def test_a_missing_elite_is_refused_with_those_that_are_there(tmp_path):
    records.write_elite(tmp_path, "000", {}, {})
    with pytest.raises(UserError, match=r"has no 007\.npz with its 007\.json; there is 000"):
        records.read_elite(tmp_path, "007")


@pytest.mark.parametrize("suffix", ["npz", "json"])
@pytest.mark.parametrize("kept", [0, 40])
def test_a_damaged_elite_is_refused_by_its_file(tmp_path, suffix, kept):
    records.write_elite(tmp_path, "000", {"rho": np.arange(9.0)}, {"text": "a" * 50})
    damaged = tmp_path / f"000.{suffix}"
    damaged.write_bytes(damaged.read_bytes()[:kept])
    with pytest.raises(UserError, match=rf"cannot read .*000\.{suffix}: .*restore it"):
        records.read_elite(tmp_path, "000")


def test_reading_a_run_imports_neither_jax_nor_orbax():
    code = "import sys, rtcd_jax.elite.records; print({'jax', 'orbax'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"


def test_a_damaged_line_is_named_by_its_number_and_a_torn_last_one_left_out(tmp_path):
    lines = tmp_path / "generations.jsonl"
    lines.write_text('{"index": 0}\n{"index": 1}\n{"ind')
    assert records.read_generations(tmp_path) == [{"index": 0}, {"index": 1}]
    lines.write_text('{"index": 0}\n{"ind\n{"index": 2}\n')
    with pytest.raises(UserError, match=r"cannot read .*generations\.jsonl, line 2: .*restore it"):
        records.read_generations(tmp_path)
