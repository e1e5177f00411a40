"""A whole run with a fake evaluation, for tests that kill it: `python -m tests.search_driver FOLDER MODE SECONDS`.

SECONDS is the least time of a generation. Prints a line before it opens the folder, one when it begins
to search, one a generation, one at its end.
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import yaml

from rtcd_jax import config as configuration
from rtcd_jax import search, storage
from tests.fake_evaluation import bowl


def experiment(mode="joint", **search_changes):
    settings = {"mode": mode, "population": 16, "generations": 24, "nested": {"designs": 4, "generations": 3}}
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
        yield arrays, {"volume": evaluation.volumes.total, "generation": found.generations[k]}


def drive(path, config, seconds=0.0):
    plan = plan_of(config)
    print("opening", flush=True)
    with storage.RunFolder.open(path, config) as folder:
        begun = state = folder.restore(begin(plan))
        print("from", int(begun.generation), flush=True)
        for state, record in search.run(plan, bowl, begun):
            time.sleep(seconds)
            folder.append(vars(record))
            print("generation", record.index, flush=True)
            folder.save_if_due(state, int(state.generation))
        folder.save(state, int(state.generation))
        folder.write_elites(results(search.finish(plan, bowl, state)))
    print("done", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    drive(Path(sys.argv[1]), experiment(sys.argv[2]), float(sys.argv[3]))
