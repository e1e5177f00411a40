"""A whole run with a fake evaluation, for tests that kill it; see killable.py.

Prints a line before it opens the folder, one when it begins to search, one a generation, one at its end or when it was
asked to stop.
"""

import os
import time

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from rtcd_jax.cli.exits import Exit
from rtcd_jax.config import load as configuration
from rtcd_jax.run import folder as storage
from rtcd_jax.run.sharding import ShardedEvaluate
from rtcd_jax.search import search
from rtcd_jax.system.cluster import Cluster, Preempted, shutdown
from tests.search.fake_evaluation import bowl

CHUNK = 4


def experiment(mode="joint", **search_changes):
    settings = {"mode": mode, "population": 16, "generations": 24, "patience": 0}
    settings |= {"nested": {"designs": 4, "generations": 3}}
    data = yaml.safe_load(configuration.EXAMPLE)
    data |= {"search": settings | search_changes, "elites": {"count": 3}, "checkpoint": {"seconds": 0.2}}
    return configuration.parse(data)


def plan_of(config):
    return search.Plan(config.search, config.elites, (0.3, 0.5, 0.7), (True, False, False))


def begin(plan):
    genomes = jnp.zeros((plan.settings.population, len(plan.initial)))
    return search.start(plan, jax.eval_shape(bowl, genomes, jax.random.key(0)))


def results(found):
    """Arrays and record of every elite."""
    for k in range(int(found.count)):
        evaluation = jax.tree.map(lambda leaf, k=k: np.asarray(leaf[k]), found.evaluation)
        arrays = {"genome": evaluation.genome, "rho": evaluation.funnel.levels}
        yield arrays, {"volume": evaluation.volumes["sum"], "generation": found.generations[k]}


def drive(path, config, seconds=0.0, cluster=None):
    plan = plan_of(config)
    print("opening", flush=True)
    cluster = cluster or Cluster.of()
    evaluate = ShardedEvaluate(bowl, cluster, CHUNK)
    with storage.RunFolder.open(path, config, cluster) as folder:
        begun = state = folder.restore(begin(plan))
        print("from", int(begun.generation), flush=True)
        try:
            for state, record in search.run(plan, evaluate, begun):
                time.sleep(seconds)
                folder.append(record.record())
                print("generation", record.index, flush=True)
                folder.save_if_due(state, int(state.generation))
                cluster.raise_if_preempted(int(state.generation))
        except Preempted:
            folder.save(state, int(state.generation))
            print("preempted", int(state.generation), flush=True)
            shutdown()
            os._exit(Exit.PREEMPTED)
        folder.save(state, int(state.generation))
        again = jax.device_get(bowl(state.elites.evaluation.genome, jax.random.key(1)))
        cluster.on_first(lambda: folder.write_elites(results(search.finish(plan, state, again))))
    print("done", flush=True)
