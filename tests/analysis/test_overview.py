"""`rtcd list`, `show` and `diff` say of run folders what these hold, finished or not, whole or damaged."""

import pytest

from rtcd_jax.analysis.overview import diff_runs, list_runs, runs_below, show_run
from rtcd_jax.cli import main as cli
from rtcd_jax.system.errors import UserError
from tests.analysis.report.runs import experiment, finished, run_folder, verify_and_disturb
from tests.consoles import Output


def console():
    return Output().console


def lines_of(text):
    """Rows of a table by their first word, as lists of their other words."""
    return {line.split()[0]: line.split()[1:] for line in text.splitlines() if line.strip()}


def test_runs_are_found_below_a_folder_and_stand_with_what_they_reached(tmp_path):
    verify_and_disturb(finished(tmp_path / "done"))
    box = {"input": 0.05, "age": 0.005}
    finished(tmp_path / "sweep" / "000", uncertainty=box)
    run_folder(tmp_path / "begun", experiment(search={"generations": 9, "objective": "inlet"}))
    assert runs_below(tmp_path) == [tmp_path / name for name in ("begun", "done", "sweep/000")]
    rows = lines_of(list_runs(tmp_path, console()))
    assert rows["done"] == ["pendulum", "sum", "3/60", "333", "3", "sampled", "not", "refuted", "one", "exact", "model"]
    assert rows["begun"] == ["pendulum", "initial", "ellipsoid", "3/9", "not", "finished", "one", "exact", "model"]
    assert "|w(t)| <= 0.05 N m" in " ".join(rows["sweep/000"])
    assert runs_below(tmp_path / "done") == [tmp_path / "done"]


def test_a_damaged_run_is_told_and_ends_nothing(tmp_path):
    finished(tmp_path / "whole")
    (finished(tmp_path / "torn") / "elites" / "000.json").write_text("{")
    text = list_runs(tmp_path, console())
    assert "333" in lines_of(text)["whole"]
    assert f"torn cannot be read: cannot read {tmp_path / 'torn' / 'elites' / '000.json'}" in text


def test_where_no_run_is_it_is_said(tmp_path):
    with pytest.raises(UserError, match=f"^{tmp_path} has no run folder in it"):
        list_runs(tmp_path, console())


def test_a_run_is_shown_with_its_guarantee_and_what_is_missing(tmp_path):
    run = finished(tmp_path / "run")
    text = "\n".join(show_run(run, console()))
    assert "best: mass = 0.7 kg, length = 0.4 m, q = (10, 1), r = 0.1" in text
    assert "guarantee: sampled: failure probability at each knot ≤ 0.0023 with confidence 0.99" in text
    assert "bears: one exact model" in text
    for verb, what in (("certify", "proof"), ("verify", "verification"), ("disturb", "disturbance")):
        assert f"{what}: none yet; rtcd {verb} {run}" in text
    verify_and_disturb(run)
    text = "\n".join(show_run(run, console()))
    assert "verification: not refuted" in text
    assert "disturbance: off nominal" in text


def test_a_run_that_is_not_finished_is_shown_as_far_as_it_is(tmp_path):
    *_, last = show_run(run_folder(tmp_path / "run", experiment()), console())
    assert last == "not finished: the command that began it goes on"


def test_two_runs_differ_in_their_keys_and_candidates(tmp_path):
    first, second = finished(tmp_path / "a"), finished(tmp_path / "b", scale=4.0, search={"seed": 7})
    configurations, candidates = diff_runs(first, second, console())
    assert lines_of(configurations)["search.seed"] == ["0", "7"]
    assert [line.split()[0] for line in configurations.splitlines()[3:]] == ["search.seed"]
    rows = lines_of(candidates)
    assert rows["sum"] in (["[rad²/s]", "333", "444"], ["x", "initial", "3", "4"])
    assert rows["guarantee"] == ["sampled", "sampled"]
    assert next(diff_runs(first, first, console())) == "equal configurations"


@pytest.mark.parametrize(("verb", "given"), [("list", [""]), ("show", [""]), ("diff", ["", ""])])
def test_the_verbs_end_with_zero_or_with_a_line_for_each_wrong_folder(verb, given, tmp_path, capsys):
    run = str(finished(tmp_path / "run"))
    assert cli.main([verb, *[run for _ in given]]) == 0
    assert "333" in capsys.readouterr().out
    assert cli.main([verb, *[str(tmp_path / "none") for _ in given]]) == 2
    err = capsys.readouterr().err
    assert len([line for line in err.splitlines() if "no" in line]) == len(given)
    assert "Traceback" not in err
