"""CPU milliseconds per swing-up: CasADi with IPOPT and with fatrop, as C code, beside rtcd_jax, on one core in one run.

All of them solve the same problems from the same guess (casadi_problem.py): candidates uniform in the box of the
search. CasADi solves them one by one, rtcd_jax in one batch, and once more in a batch of `--population`. Compilation is
timed apart. CPU time is that of all threads.
"""

import argparse
import os
from dataclasses import asdict
from functools import partial
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy loads its BLAS: IPOPT and MUMPS have one thread

import numpy as np
from casadi_problem import Program
from measure import CONFIG, RESULTS, environment, save
from swing_up import SAME, Motion, Solved, numbers_of

from rtcd_jax.analysis.scale.clock import timed
from rtcd_jax.config.load import Config, load
from rtcd_jax.system.devices import prepare_jax

SOLVERS = ("ipopt", "fatrop")
AGREEMENT = 1e-3
"""Relative difference of two costs below which they are of one optimum."""
REPEATS = 3


def ours(problem, candidates) -> tuple[list[Solved], list[Motion], dict[str, float]]:
    """rtcd_jax's answers and motions, and its CPU ms a candidate: the fastest of the calls."""
    import jax

    from rtcd_jax.trajectory import plan

    program, compilation = timed(lambda: jax.jit(partial(plan, problem)).lower(candidates).compile())
    found = jax.tree.map(np.asarray, program(candidates))
    calls = [timed(lambda: jax.block_until_ready(program(candidates)))[1].cpu for _ in range(REPEATS)]
    rows = zip(found.status == 0, found.cost, found.defect, found.iterations, strict=True)
    answers = [Solved(bool(ok), float(cost), float(defect), int(count)) for ok, cost, defect, count in rows]
    motions = [Motion(xs, us, float(h)) for xs, us, h in zip(found.xs, found.us, found.dt, strict=True)]
    return answers, motions, {"compilation_cpu_s": compilation.cpu, "cpu_ms": 1e3 * min(calls) / len(answers)}


def theirs(program: Program, rows: list[np.ndarray]) -> tuple[list[Solved], float]:
    """CasADi's answers, and its CPU ms a candidate, mean over all."""
    answers, seconds = [], 0.0
    for numbers in rows:
        answer, call = timed(lambda numbers=numbers: program.solve(numbers))
        seconds += call.cpu
        answers.append(program.solved(answer))
    return answers, 1e3 * seconds / len(rows)


def check(program: Program, rows: list[np.ndarray], motions: list[Motion], answers: list[Solved]) -> dict[str, float]:
    """How far CasADi's cost and dynamics are from rtcd_jax's along rtcd_jax's solutions: then it is one problem.

    Raises:
        SystemExit: they differ.
    """
    costs, defects = [], []
    for numbers, motion, answer in zip(rows, motions, answers, strict=True):
        if answer.solved:
            cost, defect = program.at(numbers, motion)
            costs.append(abs(cost / answer.cost - 1))
            defects.append(defect)
    apart = {"cost": max(costs, default=0.0), "defect": max(defects, default=0.0)}
    if max(apart.values()) > SAME:
        raise SystemExit(f"CasADi's problem is not rtcd_jax's: they differ by {apart}, at most {SAME:g} is allowed")
    return apart


def told(answers: list[Solved], reference: list[Solved], cost: dict[str, float]) -> dict:
    """One solver's row: how many it solved, its time, and its costs over rtcd_jax's where both are solved."""
    pairs = zip(answers, reference, strict=True)
    ratios = np.array([one.cost / other.cost for one, other in pairs if one.solved and other.solved])
    near = np.abs(ratios - 1) <= AGREEMENT
    solved = sum(answer.solved for answer in answers)
    return cost | {
        "solved": solved,
        "cpu_ms_per_solved": cost["cpu_ms"] * len(answers) / max(1, solved),
        "iterations_median": float(np.median([answer.iterations for answer in answers])),
        "largest_defect": max((answer.defect for answer in answers if answer.solved), default=float("nan")),
        "cost_ratio_median": float(np.median(ratios)) if ratios.size else None,
        "equal_costs": int(near.sum()),
        "other_optima": [round(float(ratio), 4) for ratio in ratios[~near]],
        "answers": [asdict(answer) for answer in answers],
    }


def print_row(name: str, row: dict, count: int) -> None:
    others = f"  other optima, cost ratios {row['other_optima']}" if row["other_optima"] else ""
    print(
        f"{name:28}{row['solved']:>4} of {count:<4}{row['cpu_ms_per_solved']:>10.2f} ms"
        f"{row['iterations_median']:>8.0f} iterations"
        f"{row['largest_defect']:>10.1e} defect{row['equal_costs']:>5} costs equal{others}",
        flush=True,
    )


def parse_arguments() -> tuple[argparse.Namespace, Config]:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--config", type=Path, default=CONFIG, help="an experiment of the pendulum or the cart-pole")
    parser.add_argument("--candidates", type=int, default=32, help="problems that everybody solves")
    parser.add_argument("--population", type=int, default=512, help="a larger batch of rtcd_jax")
    parser.add_argument("--solvers", nargs="*", choices=SOLVERS, default=SOLVERS)
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    config = load(arguments.config)
    if config.plant.name not in ("pendulum", "cartpole"):
        allowed = "must be 'pendulum' or 'cartpole'"
        parser.error(f"--config {arguments.config}: plant.name = {config.plant.name!r}; {allowed}")
    one_start = config.trajectory.model_copy(update={"starts": 1})  # CasADi's solvers have one
    return arguments, config.model_copy(update={"trajectory": one_start})


def main() -> None:
    arguments, config = parse_arguments()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    prepare_jax(1)
    import jax

    from rtcd_jax.genome import decode
    from rtcd_jax.problem import make_problem
    from rtcd_jax.trajectory import starts

    problem = make_problem(config)
    size = max(arguments.population, arguments.candidates)
    genomes = jax.random.uniform(jax.random.key(0), (size, len(problem.free)))
    everybody = jax.vmap(partial(decode, problem))(genomes)
    chosen = jax.tree.map(lambda leaf: leaf[: arguments.candidates], everybody)
    each = [jax.tree.map(lambda leaf, i=i: leaf[i], chosen) for i in range(arguments.candidates)]
    first = jax.tree.map(lambda leaf: np.asarray(leaf[0]), starts(problem, genomes.dtype))
    guess = Motion(first.xs, first.us, float(first.h))
    numbers = [numbers_of(one) for one in each]

    reference, motions, cost = ours(problem, chosen)
    small = f"rtcd_jax, batch {arguments.candidates}"
    rows = {small: told(reference, reference, cost)}
    print_row(small, rows[small], arguments.candidates)
    for kind in arguments.solvers:
        program, compilation = timed(lambda kind=kind: Program(problem, kind, guess))
        same = check(program, numbers, motions, reference)
        answers, ms = theirs(program, numbers)
        name = f"CasADi + {kind}, C code"
        cost = {"compilation_wall_s": compilation.wall, "cpu_ms": ms}  # the C compiler is a child: wall clock
        rows[name] = {"same_problem": same} | told(answers, reference, cost)
        print_row(name, rows[name], arguments.candidates)
    answers, _, cost = ours(problem, everybody)
    large = f"rtcd_jax, batch {len(answers)}"
    rows[large] = told(answers, answers, cost)
    del rows[large]["answers"]
    print_row(large, rows[large], len(answers))
    ratios = {
        f"{name} against {base}": rows[name]["cpu_ms_per_solved"] / rows[base]["cpu_ms_per_solved"]
        for name in rows
        if name.startswith("CasADi")
        for base in (small, large)
    }
    for name, ratio in ratios.items():
        print(f"{name}: {ratio:.1f} times the CPU time")
    record = {"config": arguments.config.name, "candidates": arguments.candidates, "rows": rows, "ratios": ratios}
    name = f"versus_casadi_{arguments.config.stem}.json"
    path = save(name, record | environment("casadi", "jax", "numpy"), arguments.results)
    print(f"written: {path}")


if __name__ == "__main__":
    main()
