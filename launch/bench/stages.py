"""Where the time goes: compilation and CPU time of every stage of the pipeline and of the search around it.

    python launch/bench/stages.py [--config configs/cartpole_rtcd.yaml] [--population 128]

Stages are compiled and timed one by one, each on the results of the one before; genomes are uniform in the box.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from measure import CONFIG, RESULTS, environment, prepare_jax, save, timed

REPEATS = 3


def stages(config, population: int) -> Iterator[tuple[str, float, float]]:
    """Name, compilation [s] and CPU time for one candidate [ms]."""
    import jax
    import jax.numpy as jnp

    from rtcd_jax import funnel, rollout, search
    from rtcd_jax.confirmation import confirm
    from rtcd_jax.evaluation import make_evaluate, search_effort
    from rtcd_jax.numerics.ellipsoid import Ellipsoids
    from rtcd_jax.policy import stabilize
    from rtcd_jax.population import decode, initial_genome
    from rtcd_jax.problem import make_problem
    from rtcd_jax.storage import RunFolder
    from rtcd_jax.trajectory import plan

    problem = make_problem(config)
    effort = search_effort(problem)
    key = jax.random.key(0)
    chunk = min(config.search.chunk, population)

    def measure(function: Callable, *arguments):
        compiled, compilation = timed(lambda: jax.jit(function).lower(*arguments).compile())
        result = jax.block_until_ready(compiled(*arguments))
        _, calls = timed(lambda: [jax.block_until_ready(compiled(*arguments)) for _ in range(REPEATS)])
        return result, (compilation.wall, 1e3 * calls.cpu / REPEATS / population)

    def chunked(function: Callable):
        return lambda *arguments: jax.lax.map(lambda row: function(*row), arguments, batch_size=chunk)

    def prepared(candidate, policy):
        sets = Ellipsoids.about(policy.trajectory.xs.T, jnp.moveaxis(policy.values, 0, -1))
        tracked = rollout.reference(problem, candidate, policy, effort.funnel.steps)
        return sets, sets.radii_inside(jnp.asarray(problem.state_limits)), tracked

    def goal(candidate, policy):
        sets, boxes, _ = prepared(candidate, policy)
        return funnel._goal_level(problem, candidate, policy, sets.part(slice(-1, None)), boxes[-1], key, effort)

    def scan(candidate, policy, last):
        sets, boxes, tracked = prepared(candidate, policy)
        return funnel._scan_knots(problem, candidate, sets, tracked, boxes, last, key, effort)

    def fresh(candidate, policy, levels):
        sets, _, tracked = prepared(candidate, policy)
        return confirm(problem, candidate, sets, tracked, levels, key, effort)

    genomes = jax.random.uniform(key, (population, len(problem.free)))
    candidates = jax.vmap(partial(decode, problem))(genomes)
    trajectories, cost = measure(partial(plan, problem), candidates)
    iterations = np.asarray(trajectories.iterations)
    print(f"iterations: median {np.median(iterations):.0f}, p90 {np.quantile(iterations, 0.9):.0f}, {iterations.max()}")
    print("histogram, bins of 10:", *np.bincount(iterations // 10))
    yield "trajectory", *cost
    policies, cost = measure(chunked(partial(stabilize, problem)), candidates, trajectories)
    yield "Riccati", *cost
    last, cost = measure(chunked(goal), candidates, policies)
    yield "goal region", *cost
    levels, cost = measure(chunked(scan), candidates, policies, last)
    yield "levels, knot by knot", *cost
    _, cost = measure(chunked(fresh), candidates, policies, levels)
    yield "fresh states", *cost
    evaluation, cost = measure(make_evaluate(problem), genomes, key)
    yield "all of these in one program", *cost

    settings = config.search.model_copy(update={"population": population})
    order = search.Plan(settings, config.elites, tuple(initial_genome(problem).tolist()), problem.design_dims)
    state = search.start(order, jax.eval_shape(lambda: evaluation))
    answered = lambda genomes, key: evaluation  # noqa: E731
    (state, _), first = timed(lambda: search.step(order, answered, state))
    (state, _), then = timed(lambda: search.step(order, answered, state))
    yield "CMA-ES and archive", first.wall - then.wall, 1e3 * then.cpu / population
    with tempfile.TemporaryDirectory() as folder, RunFolder.open(Path(folder) / "run", config) as run:
        run.save(state, 1)
        _, saved = timed(lambda: run.save(state, 2))
    yield "checkpoint", 0.0, 1e3 * saved.cpu / population


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", type=Path, default=CONFIG)
    parser.add_argument("--population", type=int, default=128)
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    prepare_jax()
    from rtcd_jax.config import load

    rows = []
    print(f"{'stage':30}{'compilation [s]':>16}{'CPU ms a candidate':>20}")
    for name, compilation, cpu in stages(load(arguments.config), arguments.population):
        print(f"{name:30}{compilation:16.1f}{cpu:20.3f}", flush=True)
        rows.append({"stage": name, "compilation_s": compilation, "cpu_ms_per_candidate": cpu})
    record = {"config": arguments.config.name, "population": arguments.population, **environment("jax", "jaxlib")}
    path = save(f"stages_{arguments.config.stem}.json", record | {"stages": rows}, arguments.results)
    print(f"written: {path}")


if __name__ == "__main__":
    main()
