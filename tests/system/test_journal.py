"""A journal gives back every whole line of its own task, wherever it was cut off."""

import pytest

from rtcd_jax.system.errors import UserError
from rtcd_jax.system.journal import Journal

HEAD = {"task": "a", "size": 3}
STEPS = [{"step": 0, "value": 0.1}, {"step": 1, "value": 1e-300}, {"step": 2, "value": 1 / 3}]


def written(path, head=None):
    journal = Journal(path, head)
    for step in STEPS:
        journal.append(step)
    return path.read_bytes()


@pytest.mark.parametrize("head", [HEAD, None])
def test_cut_anywhere_it_goes_on_after_its_last_whole_line(tmp_path, head):
    path = tmp_path / "journal.jsonl"
    content = written(path, head)
    for length in range(len(content) + 1):
        path.write_bytes(content[:length])
        journal = Journal(path, head)
        whole = content[:length].count(b"\n") - (head is not None)
        assert journal.lines == STEPS[: max(whole, 0)]
        for step in STEPS[len(journal.lines) :]:
            journal.append(step)
        assert journal.lines == STEPS
        assert path.read_bytes() == content


def test_lines_of_another_task_are_dropped(tmp_path):
    path = tmp_path / "journal.jsonl"
    written(path, HEAD)
    assert Journal(path, HEAD | {"size": 4}).lines == []
    assert Journal(path, HEAD).lines == []


def test_steps_behind_a_damaged_one_are_done_again_but_lines_of_many_tasks_stand_alone(tmp_path):
    path = tmp_path / "journal.jsonl"
    for head, left in ((HEAD, STEPS[:1]), (None, [STEPS[0], STEPS[2]])):
        path.unlink(missing_ok=True)
        lines = written(path, head).splitlines(keepends=True)
        for damage in (b"{\n", b"\xff\xfe\n", b"7\n", b"null\n", b"[" * 100_000 + b"\n"):
            path.write_bytes(b"".join([*lines[:-2], damage, lines[-1]]))
            assert Journal(path, head).lines == left


def test_a_finished_task_leaves_no_file(tmp_path):
    journal = Journal(tmp_path / "journal.jsonl", HEAD)
    journal.append(STEPS[0])
    journal.close()
    assert list(tmp_path.iterdir()) == []


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(UserError, match=r"cannot write .*missing"):
        Journal(tmp_path / "missing" / "journal.jsonl", HEAD)
