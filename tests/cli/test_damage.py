"""Run folders with any of their files damaged in any way: what reads them ends with 0, or with 2 and one line."""

import io
import json
import random
import shutil
from pathlib import Path

import numpy as np
import pytest

from rtcd_jax.cli import main as cli
from rtcd_jax.run.folder import RunFolder
from rtcd_jax.system.cluster import Cluster
from rtcd_jax.system.errors import UserError
from tests.analysis.replay.test_measured import ONE_JOINT, mutated
from tests.analysis.report.runs import verify_and_disturb
from tests.search.search_driver import begin, drive, experiment, plan_of

VERBS = {
    "report": ["report", "run"],
    "replay": ["replay", "run", "measured.csv"],
    "verify": ["verify", "run", "--states", "5", "--workers", "1"],
}
FOREIGN = (None, "text", [], {}, [[0.5]], -1, 1e308, True)
"""Values of other kinds than a file has at some place."""


def emptied(path, _):
    path.write_bytes(b"")


def cut(path, random):
    content = path.read_bytes()
    path.write_bytes(content[: random.integers(len(content) + 1)])


def garbage(path, random):
    path.write_bytes(random.bytes(300))


def flipped(path, random):
    """A byte that is another one."""
    content = bytearray(path.read_bytes())
    if content:
        content[random.integers(len(content))] ^= int(random.integers(1, 256))
    path.write_bytes(content)


def nested(path, random):
    path.write_text('{"a": ' * 100_000 if random.integers(2) else "[" * 100_000)


def foreign(path, random):
    """One value of another kind: in JSON, in a line of it, or an array; of others, zeros."""
    if path.suffix == ".npz":
        with np.load(path) as stored:
            arrays = dict(stored)
        name = random.choice(sorted(arrays))
        arrays[name] = (arrays[name] * np.nan, arrays[name][..., :0], np.array("text"), -arrays[name])[
            random.integers(4) if arrays[name].ndim else 2
        ]
        file = io.BytesIO()
        np.savez(file, **arrays)
        path.write_bytes(file.getvalue())
        return
    lines = path.read_bytes().splitlines() if path.suffix == ".jsonl" else [path.read_bytes()]
    try:
        number = random.integers(len(lines))
        record = json.loads(lines[number])
        place, key = record, random.choice(sorted(record))
        while isinstance(place[key], dict) and place[key] and random.integers(3):
            place = place[key]
            key = random.choice(sorted(place))
        place[key] = FOREIGN[random.integers(len(FOREIGN))]
        lines[number] = json.dumps(record).encode()
        path.write_bytes(b"\n".join(lines) + b"\n")
    except (ValueError, TypeError):
        path.write_bytes(bytes(path.stat().st_size))


def removed(path, _):
    path.unlink()


def a_folder(path, _):
    path.unlink()
    path.mkdir()


DAMAGES = (emptied, cut, garbage, flipped, nested, foreign, removed, a_folder)


def damage(folder, random):
    """Damages one file of the folder; which, and how."""
    file = random.choice(sorted(file for file in folder.rglob("*") if file.is_file()))
    how = DAMAGES[random.integers(len(DAMAGES))]
    how(file, random)
    return f"{file.relative_to(folder)} {how.__name__}"


def read_damaged(whole, verb, seed, capsys):
    """The exit code of a verb on a copy of the run with one damaged file."""
    shutil.rmtree("run", ignore_errors=True)
    shutil.copytree(whole, "run")
    which = damage(Path("run"), np.random.default_rng(seed))
    code = cli.main(VERBS[verb])
    out, err = capsys.readouterr()
    case = f"{verb}, seed {seed}: {which}: {code} {err}"
    assert code in (0, 1, 2), case
    assert "Traceback" not in out + err, case
    if code == 2:
        assert len(err.splitlines()) == 1, case
        assert err.startswith("rtcd: "), case
    else:
        assert not err, case
    return code


@pytest.fixture
def whole(finished, as_in_a_process, tmp_path, monkeypatch):
    """A finished, verified, disturbed run; the working folder is empty but for a measured motion."""
    monkeypatch.chdir(tmp_path)
    Path("measured.csv").write_text("time,pos,vel\n0,3,0\n0.1,3.1,0\n")
    return verify_and_disturb(Path(shutil.copytree(finished, "whole")))


@pytest.mark.thorough
@pytest.mark.parametrize("verb", VERBS)
def test_a_damaged_run_is_read_or_refused(verb, whole, capsys):
    codes = [read_damaged(whole, verb, seed, capsys) for seed in range(20)]
    assert 2 in codes


@pytest.mark.slow
@pytest.mark.parametrize("verb", VERBS)
def test_many_damaged_runs_are_read_or_refused(verb, whole, capsys):
    codes = [read_damaged(whole, verb, 1000 + seed, capsys) for seed in range(250)]
    with capsys.disabled():
        print(verb, {code: codes.count(code) for code in sorted(set(codes))})
    assert {0, 2} <= set(codes)


@pytest.mark.slow
def test_a_thousand_mutated_measurements_are_replayed_or_refused(whole, capsys):
    """The whole verb, on files of every layout that labs measure."""
    rng, codes = random.Random(3), []
    shapes = [text.split("\n") for text in ONE_JOINT.values() if text.count("\n") == 1]
    for number in range(1000):
        head, row = shapes[number % len(shapes)]
        rows = [row.format(t=k / 10, c=0.1 * k, p=0.3 * k, w=0, v=k) for k in range(6)]
        Path("lab.csv").write_bytes(mutated("\n".join([head, *rows]).encode(), rng))
        codes.append(cli.main(["replay", str(whole), "lab.csv"]))
        out, err = capsys.readouterr()
        case = f"file {number}: {codes[-1]} {err}"
        assert codes[-1] in (0, 1, 2), case
        assert "Traceback" not in out + err, case
        assert len(err.splitlines()) == (1 if codes[-1] == 2 else 0), case
        assert all(line.isprintable() for line in (out + err).splitlines()), case
    with capsys.disabled():
        print("replay", {code: codes.count(code) for code in sorted(set(codes))})
    assert {1, 2} <= set(codes)


def resume_damaged(whole, config, seed):
    """The generation from which a damaged search goes on, None where it is refused in words that name its folder."""
    folder = Path("resumed")
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(whole, folder)
    which = damage(folder, np.random.default_rng(seed))
    try:
        with RunFolder.open(folder, config, Cluster.of(1)) as run:
            return int(run.restore(begin(plan_of(config))).generation)
    except UserError as error:
        told = str(error)
    except Exception as error:
        raise AssertionError((seed, which)) from error
    assert str(folder) in told, (seed, which, told)
    return None


@pytest.fixture
def searched(tmp_path, monkeypatch):
    """A search of three generations, its last two states saved; its configuration."""
    monkeypatch.chdir(tmp_path)
    config = experiment(generations=3).model_copy(update={"checkpoint": experiment().checkpoint.model_copy(
        update={"seconds": 0.0})})  # fmt: skip
    drive(Path("whole"), config)
    return Path("whole"), config


@pytest.mark.thorough
def test_a_damaged_search_goes_on_or_is_refused(searched):
    begun = [resume_damaged(*searched, seed) for seed in range(15)]
    assert {3, 2} <= set(begun)


@pytest.mark.slow
def test_many_damaged_searches_go_on_or_are_refused(searched, capsys):
    begun = [resume_damaged(*searched, 1000 + seed) for seed in range(250)]
    with capsys.disabled():
        print("resume", {str(generation): begun.count(generation) for generation in dict.fromkeys(begun)})
    assert {None, 3, 2} <= set(begun)
