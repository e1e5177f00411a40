"""A run for several tasks: the folder of each reads as a run of its own, and the verbs go through them."""

import json
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
import yaml

from rtcd_jax.analysis.overview import list_runs, show_run
from rtcd_jax.cli import main as cli
from rtcd_jax.cli import run_verbs
from rtcd_jax.cli.exits import Exit
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import (
    mark_of,
    read_config,
    read_elite,
    read_generations,
    require_format,
    task_folders,
    task_of,
    write_elite,
)
from rtcd_jax.run.folder import RunFolder
from rtcd_jax.run.refine import refine_run
from rtcd_jax.run.tasks import store_task
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import replace_json
from tests.analysis.report.runs import candidate, experiment, generation, run_folder
from tests.consoles import Output
from tests.run.small import GENERATIONS, SMALL

TASKS = {"right": {}, "heavy": {"goal": ["-pi", 0], "plant": {"mass": "mass + 0.1", "damping": 0.15}}}


def line(index):
    """The second candidate is the best over the tasks, and the best in none; the last one fails in one."""
    each = {
        "right": {"statuses": [0, 0, 0, 0], "volumes": {"sum": [80.0 + index, 50.0, 7.0, 9.0]}},
        "heavy": {"statuses": [0, 0, 0, 3], "volumes": {"sum": [1.0, 40.0, 70.0, None]}},
    }
    over = [np.sqrt(80.0 + index), np.sqrt(2000.0), np.sqrt(490.0), None]
    return generation(index, volumes={"sum": over}, best=over[1], best_so_far=over[1]) | {"tasks": each}


@pytest.fixture
def run(tmp_path):
    """A finished one without a search, its funnels random."""
    config = experiment(tasks=TASKS)
    common = [({"genome": np.zeros(5)}, candidate(config, scale=scale)[1]) for scale in (1.0, 3.0)]
    folder = run_folder(tmp_path / "run", config, *common, generations=[line(k) for k in range(2)])
    replace_json(folder / "format.json", mark_of(config))
    for name, alone in config.each.items():
        stored = [candidate(alone, 1, 3.0), candidate(alone)]
        for arrays, _ in stored:
            arrays["K_goal"] = np.array([[30.0, 10.0]])
        store_task(folder, name, alone, np.asarray, stored[:1], stored[1])
    return folder


def test_the_folder_of_a_task_reads_as_a_run_of_its_own(run):
    assert task_folders(run) == [run / "tasks" / name for name in TASKS]
    config = read_config(run)
    for name, folder in zip(TASKS, task_folders(run), strict=True):
        assert task_folders(folder) == [folder]
        assert (task_of(run), task_of(folder)) == ("", name)
        assert read_config(folder) == config.each[name]
        np.testing.assert_array_equal(Elite.read(folder, 0).x_goal, config.each[name].task.goal)


def test_a_run_with_one_task_is_of_the_version_that_it_was():
    one = experiment(tasks={"right": {}})
    assert mark_of(one) == mark_of(experiment()) == {"format": "rtcd_jax run", "version": 1}
    assert mark_of(experiment(tasks=TASKS))["version"] == 2


def test_a_later_version_is_refused(run):
    replace_json(run / "format.json", {"format": "rtcd_jax run", "version": 3})
    with pytest.raises(UserError, match="version 3, but this rtcd_jax reads 'rtcd_jax run', version 1 or 2"):
        require_format(run)


def test_a_task_s_generations_are_its_own_with_the_best_of_all_tasks(run):
    heavy = read_generations(run / "tasks" / "heavy")
    assert [g["index"] for g in heavy] == [0, 1]
    assert {g["best"] for g in heavy} == {g["best_so_far"] for g in heavy} == {40.0}
    assert heavy[0]["volumes"] == {"sum": [1.0, 40.0, 70.0, None]}
    assert heavy[0]["counts"] == {"OK": 3, "FUNNEL_EMPTY": 1}
    assert (heavy[0]["median"], heavy[0]["feasible"]) == (40.0, 0.75)
    assert "tasks" not in heavy[0]
    assert read_generations(run / "tasks" / "right")[1]["volumes"]["sum"][0] == 81.0


@pytest.mark.parametrize(
    ("verb", "options"),
    [("replay", ["log.csv"]), ("falsify", []), ("diff", ["RUN"]), ("report", ["--table", "md"])],
)
def test_verbs_for_one_task_ask_for_it(verb, options, run, tmp_path, capsys):
    (tmp_path / "log.csv").write_text("time,theta,theta_dot\n0,0,0\n0.1,0,0\n")
    places = {"log.csv": str(tmp_path / "log.csv"), "RUN": str(run)}
    assert cli.main([verb, str(run), *(places.get(option, option) for option in options)]) == 2
    error = capsys.readouterr().err
    assert f"is for several tasks: say which, {run}/tasks/right or {run}/tasks/heavy" in error
    assert len(error.splitlines()) == 1


def test_a_task_s_folder_is_neither_searched_in_nor_refined(run):
    folder = run / "tasks" / "heavy"
    for each in (run, folder):
        with pytest.raises(UserError, match=f"^{each} is for several tasks: an elite is refined for one"):
            refine_run(each, 1, ("gains",), 1, Output().console)
    with pytest.raises(UserError, match=f"^{folder} is a task of the run {run}, whose command goes on with it"):
        RunFolder.open(folder, read_config(folder))


def test_runs_for_several_tasks_are_listed_and_shown_with_each(run):
    table = list_runs(run.parent, Output().console)
    rows = {words[0]: words[1:] for text in table.splitlines() if (words := text.split())}
    assert rows["run"][:7] == ["pendulum", "sum", "2/60", "333", "3", "sampled", "2"]
    assert rows["run/tasks/heavy"][:6] == ["pendulum", "sum", "2/60", "333", "3", "sampled"]
    text = "\n".join(show_run(run, Output().console))
    assert "sum, geometric mean over 2 tasks: initial 111, best 333 (sampled)" in text
    assert text.index("task right:") < text.index("task heavy:")


@pytest.mark.thorough
def test_a_promise_is_verified_on_every_task(run):
    """These funnels are random: all are refuted. Initial candidates without one save half of the time."""
    for folder in task_folders(run):
        arrays, record = read_elite(folder, "initial")
        write_elite(folder, "initial", arrays, record | {"status": "FUNNEL_EMPTY"})
    options = run_verbs.VerifyOptions(run=run, states=7, workers=1)
    assert run_verbs.verify(options, Output().console) == Exit.REFUTED
    for folder in task_folders(run):
        record = json.loads((folder / "verification" / "000.json").read_text())
        assert (record["states"], record["kept"]) == (7, False)


def _contents(folder: Path) -> dict[str, bytes]:
    """Bytes of all that must not depend on interruptions."""
    patterns = ("generations.jsonl", "config.yaml", "initial.*", "elites/*")
    places = [folder, *(folder / "tasks" / name for name in TASKS)]
    return {str(path.relative_to(folder)): path.read_bytes() for place in places for p in patterns
            for path in sorted(place.glob(p))}  # fmt: skip


@pytest.mark.slow
def test_a_search_for_two_tasks_ends_goes_on_after_a_kill_and_keeps_its_promises(small, tmp_path):
    config = tmp_path / "two.yaml"
    config.write_text(yaml.safe_dump(SMALL | {"tasks": TASKS}, sort_keys=False))
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    code, output, errors = small.call("optimize", config, "--run", whole)
    assert code == 0, output + errors
    process = small.start("optimize", config, "--run", killed)
    for text in process.stdout:
        if text.startswith("generation 2/"):
            process.send_signal(signal.SIGKILL)
            break
    process.communicate(timeout=60)
    code, output, errors = small.call("optimize", config, "--run", killed)
    assert code == 0, output + errors
    assert _contents(killed) == _contents(whole)
    assert len(read_generations(whole)) == GENERATIONS
    code, output, errors = small.call("verify", whole, "--states", "300")
    assert code == 0, output + errors
    for name in TASKS:
        arrays, record = read_elite(whole / "tasks" / name / "elites", "000")
        common = read_elite(whole / "elites", "000")[1]
        assert record["design"] == common["design"]
        assert common["tasks"][name]["volumes"]["sum"] == pytest.approx(float(arrays["volumes_sum"]))
        assert (whole / "tasks" / name / "report.html").is_file()
    heavy = read_elite(whole / "tasks" / "heavy" / "elites", "000")[1]
    assert heavy["parameters"]["m"] == pytest.approx(heavy["design"]["mass"] + 0.1)
    assert (whole / "report.html").is_file()
    shutil.rmtree(whole / "tasks" / "heavy")
    code, _, errors = small.call("verify", whole)
    assert (code, errors.strip()) == (2, f"rtcd: {whole / 'tasks' / 'heavy'} is no run folder: it has no format.json")
