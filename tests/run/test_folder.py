import dataclasses
import errno
import fcntl
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.config import load as configuration
from rtcd_jax.elite import records
from rtcd_jax.run import folder as storage
from rtcd_jax.run.folder import RunFolder
from rtcd_jax.search import search
from rtcd_jax.system import files
from rtcd_jax.system.errors import UserError
from rtcd_jax.types import Volumes
from tests.paths import ROOT
from tests.search.fake_evaluation import bowl
from tests.search.search_driver import begin, drive, experiment, plan_of

RESULTS = ("generations.jsonl", "config.yaml", "format.json", "elites/*")


def results(path):
    """Bytes of all that must not depend on interruptions."""
    found = {str(f.relative_to(path)): f.read_bytes() for pattern in RESULTS for f in sorted(path.glob(pattern))}
    assert {"generations.jsonl", "config.yaml", "format.json", "elites/000.npz", "elites/000.json"} <= found.keys()
    return found


def driver(path, mode, seconds=0.0, devices=1):
    command = [sys.executable, "-m", "tests.run.killable", str(path), mode, str(seconds), str(devices)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def end(process):
    output, _ = process.communicate(timeout=120)
    return output


def kill_at_random_moments(path, mode, seconds, kills, rng):
    """Kills as many searches, or fewer if one ends before; returns the generations from which they had gone on."""
    begun = []
    for _ in range(kills):
        process = driver(path, mode, seconds)
        lines = [process.stdout.readline() for _ in range(2 + rng.randint(0, 6))]
        time.sleep(rng.uniform(0.0, 2 * seconds))
        process.send_signal(signal.SIGKILL)
        output = "".join(lines) + end(process)
        assert output.startswith("opening\nfrom "), output
        if output.endswith("done\n"):
            break
        assert process.returncode == -signal.SIGKILL, output
        begun.append(int(lines[1].split()[1]))
    return begun


def assert_killed_equals_uninterrupted(tmp_path, mode, kills, seconds, seed):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    output = end(driver(whole, mode))
    assert output.splitlines() == ["opening", "from 0", *(f"generation {k}" for k in range(24)), "done"], output
    begun = kill_at_random_moments(killed, mode, seconds, kills, random.Random(seed))
    assert len(begun) >= 3
    output = end(driver(killed, mode))
    assert output.endswith("done\n"), output
    assert results(killed) == results(whole)
    begun.append(int(output.split()[2]))
    assert begun == sorted(begun)
    assert begun[-1] > 0, "no start went on from a saved state"


@pytest.mark.thorough
def test_killed_at_random_moments_a_run_ends_with_the_same_bytes(tmp_path):
    assert_killed_equals_uninterrupted(tmp_path, "nested", kills=3, seconds=0.08, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["joint", "nested"])
def test_killed_often_a_run_ends_with_the_same_bytes(tmp_path, mode):
    assert_killed_equals_uninterrupted(tmp_path, mode, kills=15, seconds=0.03, seed=2)


@pytest.mark.slow
def test_killed_while_it_starts_a_run_ends_with_the_same_bytes(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    end(driver(whole, "joint"))
    rng = random.Random(3)
    for _ in range(15):
        process = driver(killed, "joint", 0.2)
        assert process.stdout.readline() == "opening\n"
        time.sleep(rng.uniform(0, 1.5))
        process.send_signal(signal.SIGKILL)
        end(process)
        assert process.returncode == -signal.SIGKILL
    starts = json.loads((killed / "provenance.json").read_text())["starts"]
    assert len(starts) > 5
    assert end(driver(killed, "joint")).endswith("done\n")
    assert results(killed) == results(whole)


class Killed(BaseException):
    """Nothing between the raising line and the test may run on, but what `with` releases."""


@pytest.mark.thorough
@pytest.mark.parametrize("generations", [0, 1, 7])
def test_lines_after_the_saved_generation_and_a_torn_one_are_cut(tmp_path, generations):
    config = experiment(generations=9)
    drive(tmp_path / "whole", config)
    plan = plan_of(config)
    with RunFolder.open(tmp_path / "torn", config) as folder:
        for state, record in search.run(plan, bowl, folder.restore(begin(plan))):
            folder.append(record.record())
            if record.index + 1 == generations:
                folder.save(state, generations)
    with (tmp_path / "torn" / "generations.jsonl").open("ab") as file:
        file.write(b'{"index": 9, "evalua')
    with RunFolder.open(tmp_path / "torn", config) as folder:
        assert folder.restore(begin(plan)).generation == generations
        assert [line["index"] for line in records.read_generations(folder.path)] == list(range(generations))
    drive(tmp_path / "torn", config)
    assert results(tmp_path / "torn") == results(tmp_path / "whole")


@pytest.mark.thorough
@pytest.mark.parametrize("step", ["format.json", "config.yaml", "provenance.json", "generations.jsonl"])
@pytest.mark.parametrize("after", [False, True])
def test_a_folder_whose_creation_was_killed_at_any_file_is_taken_up(tmp_path, monkeypatch, step, after):
    config = experiment(generations=2)

    def killing(original):
        def write(path, *rest, **kwargs):
            if Path(path).name == step and not after:
                raise Killed
            original(path, *rest, **kwargs)
            if Path(path).name == step:
                raise Killed

        return write

    with monkeypatch.context() as patch:
        patch.setattr(files, "replace", killing(files.replace))
        patch.setattr(storage, "replace", killing(storage.replace))
        patch.setattr(Path, "touch", killing(Path.touch))
        with pytest.raises(Killed):
            RunFolder.open(tmp_path / "run", config)
    (tmp_path / "run" / ".config.yaml.tmp").write_text("half a")
    drive(tmp_path / "run", config)
    assert not list((tmp_path / "run").glob("*.tmp"))
    assert len(results(tmp_path / "run")["generations.jsonl"].splitlines()) == 2


def test_replacing_a_file_leaves_the_old_one_or_the_new_one(tmp_path, monkeypatch):
    path = tmp_path / "file"
    files.replace(path, b"old")

    def die(*_):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", die)
        with pytest.raises(Killed):
            files.replace(path, b"new")
    assert path.read_bytes() == b"old"
    files.replace(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.thorough
def test_a_saved_state_is_restored_bit_by_bit_with_its_types(tmp_path):
    config = experiment("nested")
    plan = plan_of(config)
    (state, _), *_ = search.run(plan, bowl, begin(plan))
    with RunFolder.open(tmp_path / "run", config) as folder:
        folder.append({"index": 0})
        folder.save(state, 1)
    with RunFolder.open(tmp_path / "run", config) as folder:
        restored = folder.restore(begin(plan))
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(restored), strict=True):
        assert (old.dtype, old.shape) == (new.dtype, new.shape)
        assert np.asarray(old).tobytes() == np.asarray(new).tobytes()


@pytest.mark.thorough
@pytest.mark.parametrize("lacking", [{"goal"}, {"push", "goal"}])
def test_a_state_of_an_older_version_goes_on(tmp_path, lacking):
    """It knew fewer volumes, and one status less."""

    def older(part):
        return Volumes(part.per_knot, {name: volume for name, volume in part.named.items() if name not in lacking})

    is_volumes = lambda part: isinstance(part, Volumes)  # noqa: E731
    config = experiment()
    plan = plan_of(config)
    (state, _), *_ = search.run(plan, bowl, begin(plan))
    former = jax.tree.map(lambda part: older(part) if is_volumes(part) else part, state, is_leaf=is_volumes)
    with RunFolder.open(tmp_path / "run", config) as folder:
        folder.append({"index": 0})
        folder.save(dataclasses.replace(former, counts=former.counts[:5]), 1)
    with RunFolder.open(tmp_path / "run", config) as folder:
        restored = folder.restore(begin(plan))
    assert jax.tree.structure(restored) == jax.tree.structure(state)
    for old, new in zip(jax.tree.leaves(state), jax.tree.leaves(restored), strict=True):
        assert (old.dtype, old.shape) == (new.dtype, new.shape)
    for name, volumes in restored.elites.evaluation.volumes.named.items():
        np.testing.assert_array_equal(
            volumes, state.elites.evaluation.volumes[name] * (np.nan if name in lacking else 1)
        )
    np.testing.assert_array_equal(state.elites.costs, restored.elites.costs)
    np.testing.assert_array_equal(state.counts, restored.counts)


def test_only_the_latest_states_are_kept_and_saving_one_twice_is_harmless(tmp_path):
    with RunFolder.open(tmp_path / "run", experiment()) as folder:
        for generation in (1, 2, 3, 3):
            folder.append({"index": generation})
            folder.save({"a": jnp.arange(3.0)}, generation)
    assert {item.name for item in (tmp_path / "run" / "state").iterdir()} == {"2", "3"}


def test_saves_are_no_closer_than_the_configured_seconds(tmp_path, monkeypatch):
    now = 1000.0
    monkeypatch.setattr(storage.time, "monotonic", lambda: now)
    with RunFolder.open(tmp_path / "run", experiment()) as folder:
        for elapsed, saved in ((0.1, False), (0.19, False), (0.21, True), (0.3, False), (0.42, True)):
            now = 1000.0 + elapsed
            assert folder.save_if_due({"a": jnp.zeros(2)}, int(100 * elapsed)) == saved


def test_fewer_elites_replace_more_and_the_initial_candidate_has_their_format(tmp_path):
    def elites(count):
        return [({"genome": np.full(2, k)}, {"rank": k}) for k in range(count)]

    with RunFolder.open(tmp_path / "run", experiment()) as folder:
        folder.write_initial({"genome": np.zeros(2)}, {"rank": None})
        folder.write_elites(elites(12))
        assert records.elite_names(folder.path) == [f"{k:03d}" for k in range(12)]
        folder.write_elites(elites(2))
    assert {file.name for file in (tmp_path / "run" / "elites").iterdir()} == {
        "000.npz",
        "000.json",
        "001.npz",
        "001.json",
    }
    assert records.read_elite(tmp_path / "run", "initial")[1] == {"rank": None}
    assert records.read_elite(tmp_path / "run" / "elites", "001")[1] == {"rank": 1}


def test_the_folder_tells_its_configuration_and_every_start(tmp_path):
    config = experiment()
    for _ in range(2):
        RunFolder.open(tmp_path / "run", config).close()
    assert records.read_config(tmp_path / "run") == config
    told = json.loads((tmp_path / "run" / "provenance.json").read_text())
    assert told["config_hash"] == configuration.config_hash(config)
    first, second = told["starts"]
    assert first["time"] <= second["time"]
    assert first["versions"]["jax"] == jax.__version__
    assert first["versions"]["python"] == ".".join(map(str, sys.version_info[:3]))
    assert (first["platform"], first["precision"]) == (jax.devices()[0].platform, "float64")
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=False)
    if head.returncode == 0:
        assert first["commit"].removesuffix("+") == head.stdout.strip()


def test_every_start_tells_how_long_it_worked(tmp_path):
    with RunFolder.open(tmp_path / "run", experiment()) as folder:
        time.sleep(0.11)
        folder.tell_time()
    RunFolder.open(tmp_path / "run", experiment()).close()
    first, second = json.loads((tmp_path / "run" / "provenance.json").read_text())["starts"]
    assert 0.1 <= first["seconds"] < 60
    assert "seconds" not in second


def refused(path, config=None):
    with pytest.raises(UserError) as error:
        RunFolder.open(path, config or experiment())
    assert str(path) in str(error.value)
    return str(error.value)


@pytest.mark.thorough
def test_another_configuration_is_refused_with_every_differing_key_and_both_values(tmp_path):
    drive(tmp_path / "run", experiment(generations=1))
    before = results(tmp_path / "run")
    message = refused(tmp_path / "run", experiment(generations=3, sigma=0.2))
    assert "search.generations: 1 in the folder, 3 now" in message
    assert "search.sigma: 0.3 in the folder, 0.2 now" in message
    assert "population" not in message
    assert results(tmp_path / "run") == before
    # The refusal has freed the folder.
    RunFolder.open(tmp_path / "run", experiment(generations=1)).close()


def test_a_folder_with_other_things_in_it_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years")
    assert "is not empty and not a run: it has thesis.tex" in refused(tmp_path)
    assert [item.name for item in tmp_path.iterdir()] == ["thesis.tex"]


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "run").write_text("")
    assert "is a file: a run needs a folder" in refused(tmp_path / "run")


def test_an_empty_folder_is_taken(tmp_path):
    RunFolder.open(tmp_path, experiment()).close()
    assert records.read_config(tmp_path) == experiment()


def test_a_folder_that_cannot_be_created_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    assert "cannot write" in refused(tmp_path / "file" / "run")


@pytest.mark.thorough
def test_two_processes_cannot_work_on_one_folder(tmp_path):
    process = driver(tmp_path / "run", "joint", 5.0)
    try:
        assert [process.stdout.readline() for _ in range(2)] == ["opening\n", "from 0\n"]
        assert f"is in use by process {process.pid} on " in refused(tmp_path / "run", experiment("joint"))
    finally:
        process.kill()
        end(process)
    RunFolder.open(tmp_path / "run", experiment("joint")).close()


def test_a_lock_without_a_name_is_still_a_lock(tmp_path):
    RunFolder.open(tmp_path / "run", experiment()).close()
    with (tmp_path / "run" / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert "is in use by another process" in refused(tmp_path / "run")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"format": "rtcd_jax run", "version": 3}', "version 3, but this rtcd_jax reads 'rtcd_jax run', version 1"),
        ('{"format": "other", "version": 1}', "says 'other'"),
        ('{"version": 1}', "says None, version 1, but this"),
    ],
)
def test_another_format_is_refused(tmp_path, content, message):
    RunFolder.open(tmp_path / "run", experiment()).close()
    (tmp_path / "run" / "format.json").write_text(content)
    assert message in refused(tmp_path / "run")
    with pytest.raises(UserError, match=r"format\.json"):
        records.read_config(tmp_path / "run")


def test_a_damaged_configuration_is_named(tmp_path):
    RunFolder.open(tmp_path / "run", experiment()).close()
    (tmp_path / "run" / "config.yaml").write_text("plant: [")
    assert "config.yaml: no valid YAML" in refused(tmp_path / "run")


@pytest.mark.parametrize("like", [{"a": jnp.zeros(3)}, {"b": jnp.zeros(2)}, {"a": jnp.zeros(2), "b": jnp.zeros(1)}])
def test_a_state_of_other_shapes_is_refused(tmp_path, like):
    with RunFolder.open(tmp_path / "run", experiment()) as folder:
        folder.append({})
        folder.save({"a": jnp.zeros(2)}, 1)
        assert np.array_equal(folder.restore({"a": jnp.ones(2)})["a"], [0, 0])
        with pytest.raises(UserError, match=r"state/1 is no state of this search: it is damaged, or another"):
            folder.restore(like)


def test_a_full_disk_is_named_for_every_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with RunFolder.open(tmp_path / "run", experiment()) as folder:
        monkeypatch.setattr(os, "fsync", full)
        for write, name in (
            (lambda: folder.write_initial({"genome": np.zeros(2)}, {}), "initial.npz"),
            (lambda: folder.write_elites([({"genome": np.zeros(2)}, {})]), "elites/000.npz"),
            (lambda: folder.save({"a": jnp.zeros(2)}, 1), "generations.jsonl"),
        ):
            with pytest.raises(UserError, match=rf"cannot write .*/run/{name}: No space left on device"):
                write()


def at_generations(path, *saved):
    """A run of `experiment`, with states saved after these generations."""
    config = experiment(generations=9)
    plan = plan_of(config)
    with RunFolder.open(path, config) as folder:
        for state, record in search.run(plan, bowl, folder.restore(begin(plan))):
            folder.append(record.record())
            if record.index + 1 in saved:
                folder.save(state, record.index + 1)
    return config, plan


def damaged(state):
    for file in [file for file in state.rglob("*") if file.is_file()]:
        file.write_bytes(file.read_bytes()[:10])


@pytest.mark.thorough
def test_a_damaged_newest_state_is_set_aside_and_the_one_before_goes_on(tmp_path):
    config, plan = at_generations(tmp_path / "run", 3, 6)
    damaged(tmp_path / "run" / "state" / "6")
    with RunFolder.open(tmp_path / "run", config) as folder:
        assert int(folder.restore(begin(plan)).generation) == 3
        (note,) = folder.notes
    assert "state/6 is no state of this search" in note
    assert note.endswith("going on with the state of generation 3")
    assert [path.name for path in (tmp_path / "run" / "state.damaged").iterdir()] == ["6"]
    assert "state/6/" not in (tmp_path / "run" / "state.sha256").read_text()
    assert len((tmp_path / "run" / "generations.jsonl").read_bytes().splitlines()) == 3
    drive(tmp_path / "run", config)
    drive(tmp_path / "whole", config)
    assert results(tmp_path / "run") == results(tmp_path / "whole")


def test_where_every_state_is_damaged_nothing_is_moved(tmp_path):
    config, plan = at_generations(tmp_path / "run", 3, 6)
    for state in (3, 6):
        damaged(tmp_path / "run" / "state" / f"{state}")
    with (
        RunFolder.open(tmp_path / "run", config) as folder,
        pytest.raises(UserError, match=r"state/6 is no state of this search"),
    ):
        folder.restore(begin(plan))
    assert sorted(path.name for path in (tmp_path / "run" / "state").glob("[0-9]*")) == ["3", "6"]
    assert not (tmp_path / "run" / "state.damaged").exists()


def largest_file(state):
    return max((file for file in state.rglob("*") if file.is_file()), key=lambda file: file.stat().st_size)


def test_one_other_byte_in_a_state_is_seen_before_it_is_read(tmp_path):
    config, plan = at_generations(tmp_path / "run", 3, 6)
    file = largest_file(tmp_path / "run" / "state" / "6")
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    with RunFolder.open(tmp_path / "run", config) as folder:
        assert int(folder.restore(begin(plan)).generation) == 3
        (note,) = folder.notes
    assert "state/6 is no state of this search: it is damaged" in note


def test_the_digests_are_those_of_the_kept_states_as_sha256sum_reads_them(tmp_path):
    run = tmp_path / "run"
    at_generations(run, 2, 4, 6)
    subprocess.run(["sha256sum", "--check", "--strict", "--quiet", "state.sha256"], cwd=run, check=True)
    noted = {line.split("  ")[1] for line in (run / "state.sha256").read_text().splitlines()}
    assert noted == {f"{file.relative_to(run)}" for file in (run / "state").rglob("*") if file.is_file()}


def test_a_state_without_digests_is_read_as_older_versions_left_it(tmp_path):
    config, plan = at_generations(tmp_path / "run", 3)
    (tmp_path / "run" / "state.sha256").unlink()
    with RunFolder.open(tmp_path / "run", config) as folder:
        assert int(folder.restore(begin(plan)).generation) == 3


def keep_lines(run, kept, damage=b""):
    lines = (run / "generations.jsonl").read_bytes().splitlines(keepends=True)
    (run / "generations.jsonl").write_bytes(damage.join(lines[k] for k in kept))


def held_lines(run):
    return [line["index"] for line in records.read_generations(run)]


@pytest.mark.thorough
@pytest.mark.parametrize("kept", [range(4), range(5), [0, 1, 2, 4, 5]])
def test_lines_that_are_lost_take_the_state_before_them(tmp_path, kept):
    config, plan = at_generations(tmp_path / "run", 3, 6)
    keep_lines(tmp_path / "run", kept, b"{torn\n")
    with RunFolder.open(tmp_path / "run", config) as folder:
        assert int(folder.restore(begin(plan)).generation) == 3
        (note,) = folder.notes
    assert f"generations.jsonl lacks {6 - len(kept)} of the 6 lines before" in note
    assert note.endswith("going on with the state of generation 3")
    drive(tmp_path / "run", config)
    drive(tmp_path / "whole", config)
    assert results(tmp_path / "run") == results(tmp_path / "whole")


@pytest.mark.parametrize("damage", [b"{torn\n", b"\n", b"[]\n", b'{"index": true}\n', b"[" * 100_000 + b"\n"])
def test_damaged_lines_among_whole_ones_are_taken_out(tmp_path, damage):
    config, plan = at_generations(tmp_path / "run", 3, 6)
    keep_lines(tmp_path / "run", range(6), damage)
    with RunFolder.open(tmp_path / "run", config) as folder:
        assert int(folder.restore(begin(plan)).generation) == 6
        assert not folder.notes
    assert held_lines(tmp_path / "run") == list(range(6))


@pytest.mark.thorough
@pytest.mark.parametrize("kept", [None, [], [1, 4, 5]])
def test_without_a_state_that_has_its_lines_the_latest_goes_on_and_says_so(tmp_path, kept):
    config, plan = at_generations(tmp_path / "run", 3, 6)
    if kept is None:
        (tmp_path / "run" / "generations.jsonl").unlink()
    else:
        keep_lines(tmp_path / "run", kept)
    held = [*(kept or [])]
    for done in (6, 9):  # at every later start, too
        with RunFolder.open(tmp_path / "run", config) as folder:
            assert int(folder.restore(begin(plan)).generation) == done
            (note,) = folder.notes
        assert f"generations.jsonl lacks {6 - len(held)} of the {done} lines before" in note
        assert note.endswith(f"going on with the state of generation {done}")
        drive(tmp_path / "run", config)
        assert held_lines(tmp_path / "run") == [*held, 6, 7, 8]
    drive(tmp_path / "whole", config)
    lost = "generations.jsonl"
    whole = results(tmp_path / "whole") | {lost: (tmp_path / "run" / lost).read_bytes()}
    assert results(tmp_path / "run") == whole


def test_without_lines_a_damaged_newest_state_leaves_the_one_before(tmp_path):
    config, plan = at_generations(tmp_path / "run", 3, 6)
    damaged(tmp_path / "run" / "state" / "6")
    (tmp_path / "run" / "generations.jsonl").unlink()
    with RunFolder.open(tmp_path / "run", config) as folder:
        assert int(folder.restore(begin(plan)).generation) == 3
        (note,) = folder.notes
    assert "state/6 is no state of this search" in note
    assert "lacks 3 of the 3 lines before" in note


@pytest.mark.parametrize("content", [None, b"", b"[" * 100_000, b'{"format": '])
def test_a_mark_that_is_lost_or_damaged_is_written_again(tmp_path, content):
    config, plan = at_generations(tmp_path / "run", 3)
    mark = tmp_path / "run" / "format.json"
    whole = mark.read_bytes()
    mark.unlink() if content is None else mark.write_bytes(content)
    with RunFolder.open(tmp_path / "run", config) as folder:
        assert folder.notes == [f"{mark} was lost or damaged, and is written again"]
        assert int(folder.restore(begin(plan)).generation) == 3
    assert mark.read_bytes() == whole


def test_another_configuration_is_refused_even_without_the_stored_one(tmp_path):
    config, _ = at_generations(tmp_path / "run", 3)
    (tmp_path / "run" / "config.yaml").unlink()
    other = experiment(generations=8)
    with pytest.raises(UserError, match=r"has lost its config.yaml, and provenance.json is of another configuration"):
        RunFolder.open(tmp_path / "run", other)
    assert not (tmp_path / "run" / "config.yaml").exists()
    with RunFolder.open(tmp_path / "run", config):
        assert (tmp_path / "run" / "config.yaml").is_file()


@pytest.mark.parametrize("name", ["provenance.json", "format.json", "config.yaml"])
@pytest.mark.parametrize("content", [b"[" * 100_000, b'{"a": ' * 100_000])
def test_deep_nesting_is_one_error_that_names_the_file(tmp_path, name, content):
    config, plan = at_generations(tmp_path / "run", 3)
    for lost in ("config.yaml", "format.json") if name == "format.json" else ():
        (tmp_path / "run" / lost).unlink()
    (tmp_path / "run" / name).write_bytes(content + b"\n")
    with pytest.raises(UserError, match=name), RunFolder.open(tmp_path / "run", config) as folder:
        folder.restore(begin(plan))


def test_a_write_that_fails_leaves_no_temporary(tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(UserError, match="No space left on device"):
        files.replace(tmp_path / "a.json", b"long")
    assert list(tmp_path.iterdir()) == []


FULL = """
import resource, signal, sys
from pathlib import Path
import jax.numpy as jnp
from rtcd_jax.system.errors import UserError
from rtcd_jax.types import Volumes
from rtcd_jax.run.folder import RunFolder
from tests.search.search_driver import experiment

def attempt(name, action):
    try:
        action()
    except UserError as error:
        print(name, error, flush=True)

def states():
    with RunFolder.open(Path(sys.argv[1]), experiment()) as folder:
        resource.setrlimit(resource.RLIMIT_FSIZE, (600, 600))
        attempt("append", lambda: folder.append({"long": [0.123456789] * 200}))
        attempt("save", lambda: folder.save({"a": jnp.arange(1000.0)}, 1))

attempt("close", states)
"""


@pytest.mark.thorough
def test_a_disk_that_is_really_full_ends_a_run_with_the_path_and_no_hang(tmp_path):
    """A limit on file sizes stands for the disk: the system refuses the writes of JAX's and Python's alike."""
    command = [sys.executable, "-c", FULL, str(tmp_path / "run")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=100, check=False)
    lines = done.stdout.splitlines()
    assert lines[0] == f"append cannot write {tmp_path}/run/generations.jsonl: File too large", done.stderr
    assert lines[1].startswith(f"save cannot write {tmp_path}/run/state: "), done.stderr
