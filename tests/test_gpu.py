"""Every program that a run puts on its devices lowers for a GPU, and asks nothing of the host.

Lowered without one. That they are fast there is counted by launch/bench/gpu_budget.py.
"""

import importlib
import json
import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from rtcd_jax.analysis.disturb import scenarios
from rtcd_jax.config import load as configuration
from rtcd_jax.evaluation import elite_budget, make_evaluate, resample
from rtcd_jax.numerics.loops import compiled_for
from rtcd_jax.problem import make_problem
from rtcd_jax.search import cmaes
from tests.analysis.disturb import comparisons
from tests.paths import CONFIGS, ROOT

ON_DEVICE = {"cusolver_syevd_ffi", "Sharding", "SPMDFullToShardShape", "SPMDShardToFullShape"}
"""Calls that are a GPU library's or the partitioner's own."""


def lowered(function, *arguments):
    """The program for CUDA as text."""
    with compiled_for("cuda"):
        return jax.jit(function).trace(*arguments).lower(lowering_platforms=("cuda",)).as_text()


def calls(program):
    """Everything that the program asks of somebody else."""
    return set(re.findall(r"custom_call @([\w$.]+)", program)) - ON_DEVICE


@pytest.fixture(scope="module")
def robots(tmp_path_factory):
    return comparisons.comparison(tmp_path_factory.mktemp("robots") / "run", "pendulum")


@pytest.fixture(scope="module", params=["pendulum", pytest.param("cartpole", marks=pytest.mark.slow)])
def problem(request):
    data = yaml.safe_load((CONFIGS / f"{request.param}_rtcd.yaml").read_text())
    data["funnel"] = data.get("funnel", {}) | {"rollouts": "closed_form"}
    return make_problem(configuration.parse(data))


@pytest.mark.thorough
def test_a_generation_and_an_elite_ask_nothing_of_the_host(problem):
    genomes, key = jnp.zeros((16, len(problem.free))), jax.random.key_data(jax.random.key(0))
    wrapped = jax.random.wrap_key_data
    evaluate = make_evaluate(problem)
    program = lowered(lambda genomes, key: evaluate(genomes, wrapped(key)), genomes, key)
    assert calls(program) == set()
    assert "xla_python" not in program
    shapes = jax.eval_shape(lambda genomes, key: evaluate(genomes, wrapped(key)), genomes, key)
    one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), shapes)
    again = partial(resample, problem, elite_budget)
    assert calls(lowered(lambda evaluation, key: again(evaluation, wrapped(key)), one, key)) == set()


@pytest.mark.thorough
def test_the_search_asks_and_tells_on_the_device():
    strategy = cmaes.Strategy(5, 128, 0.3)
    state = jax.eval_shape(partial(cmaes.start, strategy), np.full(5, 0.5))
    key = jax.random.key_data(jax.random.key(0))
    ask = lowered(lambda state, key: cmaes.ask(strategy, state, jax.random.wrap_key_data(key)), state, key)
    tell = lowered(partial(cmaes.tell, strategy), state, np.zeros((128, 5)), np.zeros(128))
    assert calls(ask) | calls(tell) == set()


@pytest.mark.thorough
def test_disturbed_motions_ask_nothing_of_the_host(robots):
    lanes = scenarios.undisturbed(robots.plant, robots.design, np.zeros(64, int), np.zeros((robots.plant.n, 64)))
    motion = scenarios.start(robots.loops, lanes)
    with compiled_for("cuda"):
        traced = scenarios.advance.trace(robots.loops, lanes, motion, jnp.asarray(0), jax.random.key(0))
        assert calls(traced.lower(lowering_platforms=("cuda",)).as_text()) == set()


@pytest.mark.slow
def test_a_chunk_on_a_gpu_is_one_graph_that_never_waits_for_the_host(monkeypatch):
    """Compiled for an H100 without one; `make gpu-budget` installs the compiler's wheels."""
    bench = ROOT / "launch" / "bench"
    if not (bench / ".wheels" / "nvidia").is_dir():
        pytest.skip("the compiler's wheels are not here: make gpu-budget")
    monkeypatch.syspath_prepend(str(bench))
    budget = importlib.import_module("gpu_budget")
    known = json.loads(budget.BUDGET.read_text())["pendulum_rtcd"]
    row = budget.measure(CONFIGS / "pendulum_rtcd.yaml", 64, bench / ".wheels", budget.trips_of(known, 64))
    assert row["graphs"] == 1 / 64
    assert row["outside"] == row["syncs"] == row["slices_in_loops"] == 0
    assert 0 < row["launches"] < 700
