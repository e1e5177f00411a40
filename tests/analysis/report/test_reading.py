"""A run folder is read whole, or refused by one line that names what is wrong."""

import json
from dataclasses import replace

import pytest

from rtcd_jax.analysis.report.reading import compared, funnel_views, read_run
from rtcd_jax.system.errors import UserError
from tests.analysis.report.runs import (
    VERIFICATION,
    candidate,
    experiment,
    finished,
    run_folder,
    verify_and_disturb,
)


def test_everything_in_the_folder_is_read(tmp_path):
    run = read_run(verify_and_disturb(finished(tmp_path / "mine")))
    assert run.name == "mine"
    assert run.certificates == {}
    assert run.verification == {"000": VERIFICATION}
    assert [found.name for found in run.experiments] == ["off_nominal"]
    assert [funnel.label for funnel in run.funnels] == ["initial", "best"]
    assert run.best.volumes["sum"] == 333
    assert len(run.generations) == 3


@pytest.mark.parametrize(("spent", "seconds"), [([], None), ([60.0, 6.0], 66.0), ([60.0, None], None)])
def test_the_time_is_that_of_all_starts_or_unknown(tmp_path, spent, seconds):
    folder = finished(tmp_path / "run")
    starts = [{} if value is None else {"seconds": value} for value in spent]
    (folder / "provenance.json").write_text(json.dumps({"starts": starts}))
    assert read_run(folder).seconds == seconds


def test_a_funnel_that_runs_share_is_shown_once(tmp_path):
    """Its levels differ a little from run to run, since every run samples them with its own seed."""
    first, second = (read_run(finished(tmp_path / name)) for name in ("rtc", "rtcd"))
    second = replace(second, initial=replace(second.initial, rho=1.01 * second.initial.rho))
    assert [funnel.label for funnel in funnel_views(compared([first, second]))] == ["initial", "rtc", "rtcd"]
    config = experiment()
    other = run_folder(tmp_path / "other", config, candidate(config, 5), candidate(config, 1))
    runs = compared([first, read_run(other)])
    assert [funnel.label for funnel in funnel_views(runs)] == ["rtc, initial", "other, initial", "rtc", "other"]
    assert len({funnel.color for funnel in funnel_views(runs)}) == 4


def test_runs_of_one_name_are_told_by_their_paths(tmp_path):
    folders = [finished(tmp_path / place / "run") for place in ("a", "b")]
    assert [run.name for run in compared([read_run(folder) for folder in folders])] == [str(path) for path in folders]


def test_runs_of_different_robots_are_not_compared(tmp_path):
    runs = [read_run(finished(tmp_path / plant, plant)) for plant in ("pendulum", "cartpole")]
    with pytest.raises(UserError, match=r"pendulum of the pendulum and .*cartpole of the cartpole"):
        compared(runs)


def test_what_is_no_finished_run_is_refused(tmp_path):
    config = experiment()
    with pytest.raises(UserError, match="is no run folder: it has no format"):
        read_run(tmp_path)
    with pytest.raises(UserError, match="has no elites yet: finish the run first"):
        read_run(run_folder(tmp_path / "empty", config))
    failed = run_folder(tmp_path / "failed", config, best=candidate(config, status="FUNNEL_EMPTY"))
    with pytest.raises(UserError, match=r"000 has no funnel \(FUNNEL_EMPTY\)"):
        read_run(failed)
    arrays, record = candidate(config)
    del arrays["volumes_inlet"], record["design"]
    with pytest.raises(UserError, match="the best candidate lacks volumes_inlet, design"):
        read_run(run_folder(tmp_path / "poor", config, best=(arrays, record)))
    damaged = verify_and_disturb(finished(tmp_path / "damaged"))
    (damaged / "certificates").mkdir()
    (damaged / "certificates" / "summary.json").write_text("{")
    with pytest.raises(UserError, match=r"cannot read .*summary.json: .*; remove it, or make it again"):
        read_run(damaged)
