"""What TensorBoard shows of a search is what its generations say, each once, before and after a stop."""

import json

import pytest

from rtcd_jax.cli.main import main
from rtcd_jax.run import live
from rtcd_jax.system.files import plain
from tests.analysis.report.runs import generation


def folder_with(path, count):
    path.mkdir(exist_ok=True)
    lines = [json.dumps(plain(generation(k))) for k in range(count)]
    (path / "generations.jsonl").write_text("".join(f"{line}\n" for line in lines))
    return path


def test_the_numbers_of_a_generation_have_names_and_what_is_missing_is_left_out():
    record = generation(2, median=None) | {"best": float("nan")}
    assert live.numbers(record) == {
        "sum/best_so_far": 102.0, "candidates_percent/OK": 75.0, "candidates_percent/FUNNEL_EMPTY": 25.0,
        "search/sigma": 0.3, "search/evaluations": 12.0, "search/restarts": 0.0,
    }  # fmt: skip


def test_without_a_kind_nothing_is_written(tmp_path):
    with live.log(None, folder_with(tmp_path, 1)) as show:
        show(generation(1))
    assert [path.name for path in tmp_path.iterdir()] == ["generations.jsonl"]


def test_tensorboard_has_every_generation_once_also_after_a_stop(tmp_path):
    """A run of four generations is killed, cut back to two, and goes on."""
    pytest.importorskip("tensorboardX", reason="pip install -e '.[tensorboard]'")
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    folder = folder_with(tmp_path / "run", 0)
    with live.log("tensorboard", folder) as show:
        for k in range(4):
            show(generation(k))
    with live.log("tensorboard", folder_with(folder, 2)) as show:
        show(generation(2))
    (events,) = (folder / "tensorboard").iterdir()
    read = accumulator.EventAccumulator(str(events)).Reload()
    assert [(each.step, each.value) for each in read.Scalars("sum/best")] == [(0, 100.0), (1, 101.0), (2, 102.0)]
    assert {"candidates_percent/OK", "search/sigma"} <= set(read.Tags()["scalars"])


def test_weights_and_biases_is_written_offline(tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="pip install -e '.[wandb]'")
    with live.log("wandb", folder_with(tmp_path, 1)) as show:
        show(generation(1))
    (run,) = (tmp_path / "wandb").glob("offline-run-*")
    assert list(run.glob("*.wandb"))


def test_a_package_that_is_not_there_is_named_before_anything_begins(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("rtcd_jax.cli.search_verbs.find_spec", lambda package: None)
    assert main(["optimize", "smoke", "--run", str(tmp_path / "run"), "--log", "tensorboard"]) == 2
    told = capsys.readouterr().err
    assert told == ("rtcd: --log = tensorboard: needs the package tensorboardX: pip install 'rtcd-jax[tensorboard]'\n")
    assert not (tmp_path / "run").exists()
