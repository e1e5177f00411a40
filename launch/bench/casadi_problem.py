"""The swing-up of rtcd_jax/trajectory.py as a nonlinear program of CasADi, for IPOPT and for fatrop.

The same problem: multiple shooting with RK4 in every interval, one free step, boxes, pinned ends, the same cost.
Both solvers run C code that CasADi writes and the compiler optimizes for this machine; the programs map one interval's
function (swing_up.py) over the intervals.
"""

import contextlib
import tempfile
from collections.abc import Callable
from typing import NamedTuple

import casadi as ca
import numpy as np
from swing_up import Motion, Solved, interval

from rtcd_jax.problem import Problem, initial_design

FLAGS = ("-O2", "-march=native")
SETTINGS = {
    "ipopt": {
        "tol": 1e-4,
        "constr_viol_tol": 1e-9,
        "compl_inf_tol": 1e-5,
        "max_iter": 500,
        "linear_solver": "mumps",
        "sb": "yes",
        "print_level": 0,
    },
    "fatrop": {"tol": 1e-6, "max_iter": 500, "print_level": 0},
}
"""Tolerances as near to rtcd_jax's (defects 1e-9, stationarity 1e-4, complementarity 1e-5) as each solver has them."""


class _Layout(NamedTuple):
    """A nonlinear program for `ca.nlpsol`, and how a motion stands in its variables."""

    nlp: dict[str, ca.MX]
    lower: np.ndarray
    upper: np.ndarray
    point: Callable[[Motion], np.ndarray]
    gaps: np.ndarray  # the rows of g that are gaps of the dynamics
    options: dict


class Program:
    """One robot's problem for "ipopt" or "fatrop", started from `guess`."""

    def __init__(self, problem: Problem, kind: str, guess: Motion):
        self.layout = {"ipopt": _free_step, "fatrop": _stages}[kind](problem)
        # CasADi cleans up only when the process ends, and writes its C code into the working directory.
        jit = {"jit": True, "compiler": "shell", "jit_cleanup": False}
        quiet = {"print_time": False, "error_on_fail": False}
        with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
            jit["jit_options"] = {"flags": list(FLAGS), "directory": f"{folder}/", "cleanup": False}
            options = jit | quiet | self.layout.options | {kind: SETTINGS[kind]}
            self.solver = ca.nlpsol("swing_up", kind, self.layout.nlp, options)
        self.start = self.layout.point(guess)
        self.value = ca.Function("value", self.layout.nlp, ["x", "p"], ["f", "g"])

    def solve(self, numbers: np.ndarray) -> dict:
        """CasADi's answer for the candidate of these numbers."""
        lower, upper = self.layout.lower, self.layout.upper
        return self.solver(p=numbers, x0=self.start, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)

    def solved(self, answer: dict) -> Solved:
        """What the last call came to."""
        stats = self.solver.stats()
        return Solved(bool(stats["success"]), float(answer["f"]), self._defect(answer["g"]), int(stats["iter_count"]))

    def at(self, numbers: np.ndarray, motion: Motion) -> tuple[float, float]:
        """Cost and largest defect of a motion in this program."""
        cost, constraints = self.value(self.layout.point(motion), numbers)
        return float(cost), self._defect(constraints)

    def _defect(self, constraints: ca.DM) -> float:
        return float(np.max(np.abs(np.asarray(constraints).ravel()[self.layout.gaps])))


def _interval(problem: Problem) -> tuple[ca.Function, ca.Function]:
    """(x, u, h, p) -> next x, and -> the interval's share of the cost."""
    n, m = problem.plant.n, problem.plant.m
    sizes = {"x": n, "u": m, "h": 1, "p": len(problem.plant.design_units) + n + m}
    symbols = [ca.SX.sym(name, size) for name, size in sizes.items()]
    x, u, h, p = map(ca.vertsplit, symbols)
    end, cost = interval(problem, ca, x, u, h[0], p)
    return ca.Function("next", symbols, [ca.vertcat(*end)]), ca.Function("cost", symbols, [cost])


def _free_step(problem: Problem) -> _Layout:
    """Variables (x_0 .. x_N, u_0 .. u_{N-1}, h); the ends are pinned by their bounds."""
    count, n, m = problem.intervals, problem.plant.n, problem.plant.m
    following, cost = _interval(problem)
    xs, us, h = ca.MX.sym("x", n, count + 1), ca.MX.sym("u", m, count), ca.MX.sym("h")
    p = ca.MX.sym("p", following.size1_in(3))
    each = xs[:, :count], us, ca.repmat(h, 1, count), ca.repmat(p, 1, count)
    gaps = ca.vec(following.map(count)(*each) - xs[:, 1:])
    nlp = {"x": ca.veccat(xs, us, h), "f": ca.sum2(cost.map(count)(*each)), "g": gaps, "p": p}

    def point(motion: Motion) -> np.ndarray:
        return np.concatenate([motion.xs.ravel(), motion.us.ravel(), [motion.h]])

    step = problem.config.trajectory.step
    limits = problem.config.trajectory.limit_share * problem.state_limits
    inputs = problem.input_limits(initial_design(problem))
    upper = np.concatenate([np.tile(limits, count + 1), np.tile(inputs, count), [step.max]])
    lower = np.concatenate([-upper[:-1], [step.min]])
    for end, state in ((slice(0, n), problem.start), (slice(count * n, (count + 1) * n), problem.goal)):
        lower[end] = upper[end] = state
    return _Layout(nlp, lower, upper, point, np.arange(count * n), {})


def _stages(problem: Problem) -> _Layout:
    """Stage by stage (x_k, h_k, u_k), as fatrop wants it: the free step is a state that does not change."""
    count, n, m = problem.intervals, problem.plant.n, problem.plant.m
    following, cost = _interval(problem)
    rows, wide = n + 1, n + 1 + m
    w, p = ca.MX.sym("w", wide * count + rows), ca.MX.sym("p", following.size1_in(3))
    stages, last = ca.reshape(w[: wide * count], wide, count), w[wide * count :]
    xs, h, us = stages[:n, :], stages[n, :], stages[rows:, :]
    each = xs, us, h, ca.repmat(p, 1, count)
    gaps = ca.horzcat(stages[:rows, 1:], last) - ca.vertcat(following.map(count)(*each), h)
    # A stage's gap, then its own constraints.
    g = ca.vertcat(gaps[:, 0], xs[:, 0] - problem.start, ca.vec(gaps[:, 1:]), last[:n] - problem.goal)
    nlp = {"x": w, "f": ca.sum2(cost.map(count)(*each)), "g": g, "p": p}

    def point(motion: Motion) -> np.ndarray:
        steps = np.full((count, 1), motion.h)
        return np.concatenate([np.hstack([motion.xs[:-1], steps, motion.us]).ravel(), motion.xs[-1], [motion.h]])

    step, intervals = problem.config.trajectory.step, np.ones((count, 1))
    limits = problem.config.trajectory.limit_share * problem.state_limits
    states = np.tile(limits, (count + 1, 1))
    inputs = problem.input_limits(initial_design(problem)) * intervals
    lower, upper = point(Motion(-states, -inputs, step.min)), point(Motion(states, inputs, step.max))
    size = g.size1()
    mine = np.concatenate([np.arange(rows), np.arange(rows + n, size - n)])
    options = {"structure_detection": "auto", "equality": [True] * size}
    return _Layout(nlp, lower, upper, point, mine, options)
