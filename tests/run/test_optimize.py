"""A whole run, small in every number: its folder, its resumption after kills, its promise before the simulators."""

import json
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.cli.exits import STOPPED, Exit
from rtcd_jax.config import load as configuration
from rtcd_jax.elite.records import elite_names, read_elite, read_generations
from rtcd_jax.run import optimize as run
from rtcd_jax.run import reevaluation
from rtcd_jax.run.optimize import LAST_FILE
from rtcd_jax.system.cluster import Cluster
from rtcd_jax.system.errors import UserError
from rtcd_jax.types import Status
from tests.consoles import Screen
from tests.paths import ROOT
from tests.run.small import GENERATIONS, SMALL, Small
from tests.search.fake_evaluation import bowl, population
from tests.stopping import stop


@pytest.fixture(scope="module")
def finished(searched) -> Path:
    """The folder of an uninterrupted run."""
    folder, code, screen = searched
    assert code == 0, screen
    assert f"generation {GENERATIONS}/{GENERATIONS}" in screen
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    """Bytes of all that must not depend on interruptions."""
    patterns = ("generations.jsonl", "config.yaml", "initial.*", "elites/*")
    found = {str(path.relative_to(folder)): path.read_bytes() for p in patterns for path in sorted(folder.glob(p))}
    assert {"generations.jsonl", "initial.npz", "initial.json", "elites/000.npz", "elites/000.json"} <= found.keys()
    return found


@pytest.mark.thorough
def test_a_run_leaves_its_elites_best_first(finished):
    """With the volumes of their second evaluation, each with its promise, the initial candidate beside them."""
    volumes = []
    for name in elite_names(finished):
        arrays, record = read_elite(finished / "elites", name)
        assert (record["status"], record["rung"]) == ("OK", "sampled")
        assert record["followed_to_the_goal"]
        assert 0 < record["epsilon"] < 1
        areas = np.pi * arrays["rho"] / np.sqrt(np.linalg.det(arrays["S"]))
        np.testing.assert_allclose(arrays["volumes_sum"], areas.sum())
        volumes.append(float(arrays["volumes_sum"]))
    assert volumes == sorted(volumes, reverse=True)
    arrays, record = read_elite(finished, "initial")
    assert record["design"] == pytest.approx({"mass": 0.7, "length": 0.4})
    assert record["weights"]["q"] == pytest.approx([10, 1])
    assert record["weights"]["r"] == pytest.approx([0.1])
    assert record["config_hash"] == read_elite(finished / "elites", "000")[1]["config_hash"]
    (start,) = json.loads((finished / "provenance.json").read_text())["starts"]
    assert start["seconds"] > 0
    assert "<h1>whole</h1>" in (finished / "report.html").read_text()


def test_a_run_tells_its_generations(finished):
    """Whole populations, the best so far never worse than before, the first genome the initial one."""
    generations = read_generations(finished)
    assert [g["index"] for g in generations] == list(range(GENERATIONS))
    assert [g["evaluations"] for g in generations] == [6 * (k + 1) for k in range(GENERATIONS)]
    best = [g["best_so_far"] for g in generations if g["best_so_far"] is not None]
    assert best == sorted(best)
    arrays, _ = read_elite(finished, "initial")
    np.testing.assert_array_equal(generations[0]["genomes"][0], arrays["genome"])
    elite, _ = read_elite(finished / "elites", "000")
    assert elite["genome"].tolist() in [genome for g in generations for genome in g["genomes"]]


def test_the_stored_configuration_is_the_runs(finished, small):
    assert configuration.load(finished / "config.yaml") == configuration.load(small.config)


@pytest.mark.thorough
def test_a_finished_run_says_so_and_is_left_as_it_is(finished, small):
    before = contents(finished) | {"page": (finished / "report.html").read_bytes()}
    code, output, errors = small.optimize(finished)
    assert code == 0, errors
    assert f"is complete: {GENERATIONS} generations, {len(elite_names(finished))} elites" in output
    assert "generation 1/" not in output
    assert contents(finished) | {"page": (finished / "report.html").read_bytes()} == before


@pytest.mark.thorough
def test_a_finished_run_without_its_page_gets_it_and_nothing_else(finished, small, tmp_path):
    folder = tmp_path / "whole"
    shutil.copytree(finished, folder, ignore=shutil.ignore_patterns("report.html", "figures"))
    code, output, errors = small.optimize(folder)
    assert code == 0, errors
    assert "is complete" in output
    assert "<h1>whole</h1>" in (folder / "report.html").read_text()
    assert contents(folder) == contents(finished)


@pytest.mark.thorough
def test_another_configuration_is_refused_by_its_key(finished, small):
    before = contents(finished)
    code, _, errors = small.optimize(finished, "--search.sigma", "0.2")
    assert code == 2
    assert "another configuration" in errors
    assert "search.sigma: 0.3 in the folder, 0.2 now" in errors
    assert "funnel." not in errors
    assert contents(finished) == before


@pytest.mark.thorough
def test_the_run_keeps_its_promise(finished, small):
    """Of the best and the initial candidate, before both independent simulators."""
    code, output, errors = small.call("verify", finished, "--states", "400")
    assert code == 0, output + errors
    for name in ("000", "initial"):
        found = json.loads((finished / "verification" / f"{name}.json").read_text())
        assert found["kept"]
        assert set(found["witnesses"]) == {"C MuJoCo", "RK45"}


def _kill_after(small: Small, folder: Path, generation: int, delay: float) -> int:
    """Kills a run some time after a generation's line; its exit status."""
    process = small.start("optimize", small.config, "--run", folder)
    for line in process.stdout:
        if line.startswith(f"generation {generation}/"):
            break
    time.sleep(delay)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    return process.returncode


@pytest.mark.thorough
def test_a_killed_run_ends_as_if_nothing_had_happened(finished, small, tmp_path):
    """Bit by bit: elites, initial candidate and generations."""
    folder = tmp_path / "killed"
    assert _kill_after(small, folder, 2, 0.0) == -signal.SIGKILL
    assert not (folder / "elites").exists()
    code, output, errors = small.optimize(folder)
    assert code == 0, errors
    assert "going on after generation" in output
    assert contents(folder) == contents(finished)


LONG = "--elites.trials", "100000000", "--search.generations", "1"
"""Held-out samples for hours."""


@pytest.mark.thorough
@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, Exit.PREEMPTED), (signal.SIGINT, Exit.INTERRUPTED)])
def test_asked_to_stop_while_its_elites_are_sampled_again_a_run_ends_and_goes_on(small, tmp_path, sent, code):
    """While their program compiles or is at work. Both ask a start and its resume."""
    for first in ("compiling", "going on after generation 1"):
        process = small.start("optimize", small.config, "--run", tmp_path / "run", *LONG)
        output = iter(process.stdout.readline, "")
        assert any(first in line for line in output)
        assert first != "compiling" or any(line.startswith("generation 1/1") for line in output)
        time.sleep(3)
        told, errors = stop(process, sent)
        assert process.returncode == code, told + errors
        assert (f"saved in {tmp_path / 'run'}" if sent == signal.SIGTERM else STOPPED) in told + errors
    assert not (tmp_path / "run" / "elites").exists()


@pytest.mark.thorough
def test_asked_to_stop_while_it_compiles_a_run_ends_and_leaves_a_folder_that_goes_on(small, tmp_path):
    environment = small.environment | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-u", "-m", "rtcd_jax", "optimize", str(small.config), "--run", str(tmp_path / "run")]
    process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)
    assert any(line.startswith("compiling") for line in iter(process.stdout.readline, ""))
    time.sleep(2)
    output, _ = stop(process, signal.SIGTERM)
    assert process.returncode == Exit.PREEMPTED, output
    assert "generation" not in output
    code, output, errors = small.optimize(tmp_path / "run")
    assert code == 0, errors


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_run_killed_at_random_moments_ends_as_if_nothing_had_happened(finished, small, tmp_path, seed):
    """Between and in generations, in a save, and while the elites are sampled again."""
    rng, folder, kills = random.Random(seed), tmp_path / "killed", 0
    for _ in range(4):
        done = len(read_generations(folder)) if (folder / "generations.jsonl").exists() else 0
        target = min(GENERATIONS, done + rng.randint(1, 2))
        kills += _kill_after(small, folder, target, rng.uniform(0, 0.6)) == -signal.SIGKILL
    assert kills > 0
    code, _, errors = small.optimize(folder)
    assert code == 0, errors
    assert contents(folder) == contents(finished)


@pytest.mark.slow
def test_fifty_kills_over_the_smoke_run_change_nothing(tmp_path):
    """At random moments from its start to its end; every start goes on, and no file is left half-written."""
    smoke = Small(tmp_path)
    smoke.config = ROOT / "configs" / "smoke.yaml"
    whole, folder = tmp_path / "whole", tmp_path / "killed"
    assert smoke.optimize(whole)[0] == 0
    begun = time.monotonic()
    assert smoke.optimize(tmp_path / "timed")[0] == 0
    longest, rng, killed = time.monotonic() - begun, random.Random(0), 0
    while killed < 50:
        process = smoke.start("optimize", smoke.config, "--run", folder)
        try:
            output, errors = process.communicate(timeout=rng.uniform(0, longest))
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            killed += 1
        else:
            assert process.returncode == 0, output + errors
            assert contents(folder) == contents(whole)
            shutil.rmtree(folder)
    code, output, errors = smoke.optimize(folder)
    assert code == 0, output + errors
    assert contents(folder) == contents(whole)
    assert not list(folder.rglob(".*.tmp"))


@pytest.mark.slow
def test_a_run_killed_while_it_stores_its_elites_stores_them_all(finished, small, tmp_path):
    """Whatever is missing at its end, the same command brings the same bytes."""
    folder = tmp_path / "torn"
    shutil.copytree(finished, folder, ignore=shutil.ignore_patterns("verification"))
    assert len(elite_names(folder)) == 2
    for lost in (folder / "elites" / "001.npz", folder / "elites" / "001.json", folder / LAST_FILE):
        lost.unlink()
    (folder / "report.html").write_text("of before")
    code, output, errors = small.optimize(folder)
    assert code == 0, errors
    assert "generation 1/" not in output
    assert contents(folder) == contents(finished)
    assert (folder / LAST_FILE).is_file()
    assert "<h1>torn</h1>" in (folder / "report.html").read_text()


# ---- with a fake evaluation, whose volumes are a known function of the genome


def _failing(genomes, key):
    return population(genomes, jnp.ones(len(genomes)), jnp.full(len(genomes), Status.FUNNEL_EMPTY))


def _run_with(monkeypatch, evaluate, folder):
    monkeypatch.setattr(run, "make_evaluate", lambda problem: evaluate)
    monkeypatch.setattr(reevaluation, "resample", lambda problem, budget, row, key, samples: eqx.tree_at(
        lambda e: e.status, row, jnp.int32(Status.FUNNEL_EMPTY)))  # fmt: skip
    screen = Screen()
    try:
        with screen.console as console:
            run.optimize(configuration.parse(SMALL), folder, console, Cluster.of())
    finally:
        assert f"generation {GENERATIONS}/{GENERATIONS}  best" in screen.text, "drawn on the terminal"
        assert re.search(r"compiled  elapsed \d+:\d\d", screen.text)


@pytest.mark.thorough
def test_a_run_without_any_funnel_says_why(monkeypatch, tmp_path):
    with pytest.raises(UserError, match=f"none of {6 * GENERATIONS} candidates in {GENERATIONS} generations") as error:
        _run_with(monkeypatch, _failing, tmp_path / "run")
    assert f"{6 * GENERATIONS} FUNNEL_EMPTY: {Status.FUNNEL_EMPTY.message}" in str(error.value)
    assert not (tmp_path / "run" / "elites").exists()


@pytest.mark.thorough
def test_elites_that_were_only_lucky_are_not_reported(monkeypatch, tmp_path):
    """Not one of them has a funnel when it is sampled again."""
    with pytest.raises(UserError, match="none of the elites kept a funnel under more samples"):
        _run_with(monkeypatch, bowl, tmp_path / "run")
    assert not (tmp_path / "run" / "elites").exists()
