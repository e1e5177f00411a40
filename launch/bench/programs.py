"""What cvxpy adds to the solver's own time in the certificates' programs: solve() should stay below 1.5 times of it.

The shapes are those of the funnels' intervals of two and of four states, the data random about p = 1, so that every
program has a margin.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from measure import RESULTS, environment, save

from rtcd_jax.certificate import check
from rtcd_jax.certificate.prove.sdp import OPTIONS, SOLVER, Data, Program, Shape, require_solver, solve

SHAPES = {
    "two states, degree 3, 2 conditions": Shape(2, 3, 5, 1, 2),
    "two states, degree 3, 1 condition": Shape(2, 3, 5, 1, 1),
    "four states, degree 2": Shape(4, 2, 5, 0, 0),
    "four states, degree 2, 1 condition": Shape(4, 2, 5, 1, 1),
    "four states, degree 3": Shape(4, 3, 5, 0, 0),
}


def data(shape: Shape, random: np.random.Generator) -> Data:
    p = 0.05 * random.normal(size=(shape.bernstein + 1, len(check.monomials(shape.n, 2 * shape.degree))))
    p[:, 0] += 1
    sizes = shape.constraints, shape.bernstein - shape.multiplier + 1, len(check.monomials(shape.n, 1))
    return Data(p, random.normal(size=sizes))


def measured(shape: Shape, count: int, solver: str) -> dict[str, float]:
    """Milliseconds of CPU, medians but for the first solution: of the solver alone on data that cvxpy has made, of
    cvxpy's solve(), and of all that `prove.sdp.solve` does, the rounding of the matrices included.
    """
    random = np.random.default_rng(0)
    clock = Clock()
    program = Program(shape)
    program.margin(data(shape, random), solver)
    first = clock.lap()
    solve(data(shape, random), shape, solver)  # states it once more
    laps: dict[str, list[float]] = {"the solver": [], "solve()": [], "with rounding": []}
    for _ in range(count):
        here = data(shape, random)
        clock.lap()
        program.margin(here, solver)
        laps["solve()"].append(clock.lap())
        problem, options = program.problem, OPTIONS.get(solver, {})
        matrices, chain, _ = problem.get_problem_data(solver)
        clock.lap()
        chain.solve_via_data(problem, matrices, solver_opts=dict(options))
        laps["the solver"].append(clock.lap())
        solve(here, shape, solver)
        laps["with rounding"].append(clock.lap())
    return {"first": first} | {name: float(np.median(times)) for name, times in laps.items()}


class Clock:
    """Milliseconds of CPU since the last lap."""

    def __init__(self):
        self._last = time.process_time()

    def lap(self) -> float:
        now, before = time.process_time(), self._last
        self._last = now
        return 1e3 * (now - before)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--solver", default=SOLVER, help="by cvxpy's name")
    parser.add_argument("--repeats", type=int, default=12)
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    solver = require_solver(arguments.solver)
    names = "first", "the solver", "solve()", "with rounding"
    print(f"{'ms':36}" + "".join(f"{name:>15}" for name in names) + f"{'ratio':>8}")
    rows = []
    for title, shape in SHAPES.items():
        row = measured(shape, arguments.repeats, solver)
        row["ratio"] = row["solve()"] / row["the solver"]
        rows.append({"program": title, **row})
        print(f"{title:36}" + "".join(f"{row[name]:15.1f}" for name in names) + f"{row['ratio']:8.2f}", flush=True)
    record = {"environment": environment("cvxpy", "clarabel", "numpy"), "solver": solver, "rows": rows}
    print(save(f"programs_{solver.lower()}.json", record, arguments.results))


if __name__ == "__main__":
    main()
