"""The classical pipeline for one pendulum candidate, written with Drake (Girlanda et al., ICRA 2024, section II).

A candidate is a design (m, l) and weights (q, r). Step by step:

1. Direct transcription, N + 1 = 51 knots, explicit midpoint Phi, one free step h, solved by SNOPT:
       min   h sum_k 1/2 (xbar_k' Q xbar_k + r u_k^2) + w_t N h
       s.t.  x_{k+1} = Phi(x_k, u_k, h),  x_0 and x_N pinned,  boxes on x, u, h.
   Without the factor h before the sum (`cost="knot_sum"`) it gives the published angles to 0.01 rad.
2. TVLQR: Drake's finite-horizon LQR about it; the final S and K are those of the goal's own LQR.
3. Region of attraction of the goal's LQR: the largest rho_N, by bisection, for which every saturation case has
       -Vdot - eps |y|^2 - lambda (rho_N - V) - sum_i sigma_i g_i   a sum of squares (SOS), lambda and sigma_i SOS.
4. Funnel, backward over the knots (Tedrake et al., IJRR 2010): with rhodot = (rho_{k+1} - rho_k) / h, for each case
       rhodot - Vdot - lambda (rho_k - V) - sum_i sigma_i g_i - gamma   SOS, lambda free, sigma_i SOS.
   Bilinear in rho_k and lambda, hence alternated: gamma is maximized over the multipliers for a fixed rho_k,
   then rho_k over (rho_k, sigma) for fixed lambda and gamma = 0.

The saturation cases are {|u| <= limit}, {u >= limit}, {u <= -limit} with u = u* - K xbar, g_i >= 0 describing each.
Vdot is taken along the third-order Taylor polynomial of the closed loop about the nominal. Clarabel solves all
programs, in coordinates y in which the known ellipsoid is the unit disc.

A baseline for time, not a proof: the conditions hold at the knots only, and for a polynomial plant.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from pydrake.solvers import ClarabelSolver, MathematicalProgram, SnoptSolver
from pydrake.symbolic import MakeVectorVariable, Polynomial, Variables
from pydrake.systems.controllers import (
    FiniteHorizonLinearQuadraticRegulator,
    FiniteHorizonLinearQuadraticRegulatorOptions,
    LinearQuadraticRegulator,
)
from pydrake.systems.primitives import SymbolicVectorSystem
from pydrake.trajectories import PiecewisePolynomial

from rtcd_jax.config.load import Config

COSTS = ("integral", "knot_sum")
STEP_GUESS = 0.06  # [s]
BISECTION_TOLERANCE, ALTERNATION_TOLERANCE = 1e-2, 1e-3  # relative, on rho
SMALLEST_RATIO = 1e-6  # of successive levels, below which a funnel counts as empty
LARGEST_SLACK = 10.0  # caps gamma, which is unbounded where a saturation case is empty

Y = MakeVectorVariable(2, "y")
INDETERMINATES = Variables(Y)
SQUARED_NORM = Polynomial(Y @ Y, INDETERMINATES)


class NoFunnel(RuntimeError):
    """The classical pipeline ends without a funnel; the text says at which step."""


@dataclass(frozen=True)
class Candidate:
    """A pendulum's design, mass [kg] and length [m], and the diagonals of its weights; all else is the config's."""

    mass: float
    length: float
    q: tuple[float, float]
    r: float
    config: Config

    @property
    def inertia(self) -> float:
        return self.mass * self.length**2

    @property
    def damping(self) -> float:
        return self.config.plant.damping

    @property
    def weight_torque(self) -> float:
        return self.mass * self.config.plant.gravity * self.length

    @property
    def torque_limit(self) -> float:
        return self.config.plant.torque_limit

    @property
    def goal(self) -> np.ndarray:
        return np.array(self.config.task.goal)

    @property
    def intervals(self) -> int:
        return self.config.trajectory.knots - 1


def dynamics(candidate: Candidate, x, u):
    """State derivative [2] of the pendulum, of numbers or symbols."""
    return np.array([x[1], (u - candidate.damping * x[1] - candidate.weight_torque * np.sin(x[0])) / candidate.inertia])


def explicit_midpoint(candidate: Candidate, x, u, step):
    return x + step * dynamics(candidate, x + step / 2 * dynamics(candidate, x, u), u)


def plan(candidate: Candidate, cost: str) -> tuple[np.ndarray, np.ndarray, float]:
    """States [N+1, 2], torques [N] and step [s] by direct transcription; `NoFunnel` if SNOPT finds none."""
    settings, start = candidate.config.trajectory, np.array(candidate.config.task.start)
    program = MathematicalProgram()
    step = program.NewContinuousVariables(1, "h")[0]
    xs = program.NewContinuousVariables(candidate.intervals + 1, 2, "x")
    us = program.NewContinuousVariables(candidate.intervals, "u")
    program.AddBoundingBoxConstraint(settings.step.min, settings.step.max, step)
    program.AddBoundingBoxConstraint(-candidate.torque_limit, candidate.torque_limit, us)
    box = np.tile(candidate.config.task.state_limits, (candidate.intervals + 1, 1))
    program.AddBoundingBoxConstraint(-box, box, xs)
    program.AddLinearEqualityConstraint(xs[0], start)
    program.AddLinearEqualityConstraint(xs[-1], candidate.goal)
    for k in range(candidate.intervals):
        defect = xs[k + 1] - explicit_midpoint(candidate, xs[k], us[k], step)
        for component in defect:
            program.AddConstraint(component, 0, 0)
    running = 0.5 * (((xs[:-1] - candidate.goal) ** 2) @ candidate.q + candidate.r * us**2).sum()
    program.AddCost((step if cost == "integral" else 1.0) * running + settings.time_weight * candidate.intervals * step)
    program.SetInitialGuess(step, STEP_GUESS)
    program.SetInitialGuess(xs, np.linspace(start, candidate.goal, candidate.intervals + 1))
    program.SetInitialGuess(us, np.zeros(candidate.intervals))
    result = SnoptSolver().Solve(program)
    if not result.is_success():
        raise NoFunnel(f"SNOPT found no trajectory: exit code {result.get_solver_details().info}")
    return result.GetSolution(xs), result.GetSolution(us), result.GetSolution(step)


@dataclass(frozen=True)
class Linearized:
    """The closed loop at one knot: nominal angle [rad] and torque [N m], gain K [2], S and dS/dt [2, 2]."""

    angle: float
    torque: float
    gain: np.ndarray
    value: np.ndarray
    value_rate: np.ndarray


def stabilize(candidate: Candidate, xs: np.ndarray, us: np.ndarray, step: float) -> list[Linearized]:
    """TVLQR at the N+1 knots; the last one is the goal's infinite-horizon LQR with the same weights."""
    state, torque = MakeVectorVariable(2, "x"), MakeVectorVariable(1, "u")
    plant = SymbolicVectorSystem(state=state, input=torque, dynamics=dynamics(candidate, state, torque[0]))
    weights = np.diag(candidate.q), np.diag([candidate.r])
    a = np.array([[0.0, 1.0], [candidate.weight_torque / candidate.inertia, -candidate.damping / candidate.inertia]])
    goal_gain, goal_value = LinearQuadraticRegulator(a, np.array([[0.0], [1 / candidate.inertia]]), *weights)

    times = step * np.arange(candidate.intervals + 1)
    torques = [*us, 0.0]
    rates = np.array([dynamics(candidate, x, u) for x, u in zip(xs, torques, strict=True)])
    options = FiniteHorizonLinearQuadraticRegulatorOptions()
    options.x0 = PiecewisePolynomial.CubicHermite(times, xs.T.tolist(), rates.T.tolist())
    options.u0 = PiecewisePolynomial.ZeroOrderHold(times, [torques])
    options.Qf = goal_value
    lqr = FiniteHorizonLinearQuadraticRegulator(plant, plant.CreateDefaultContext(), 0, times[-1], *weights, options)
    value_rate = lqr.S.MakeDerivative()
    knots = [
        Linearized(x[0], u, lqr.K.value(t)[0], lqr.S.value(t), value_rate.value(t))
        for t, x, u in zip(times[:-1], xs[:-1], us, strict=True)
    ]
    return [*knots, Linearized(candidate.goal[0], 0.0, goal_gain[0], goal_value, np.zeros((2, 2)))]


@dataclass(frozen=True)
class Case:
    """One saturation case in y: Vdot / rho, and the polynomials g_i >= 0 of its set."""

    decrease: Polynomial
    domain: tuple[Polynomial, ...]


def saturation_cases(candidate: Candidate, knot: Linearized, rho: float) -> tuple[Case, Case, Case]:
    """The closed loop in y, where xbar = sqrt(rho) L^-T y and S = L L', so that V = rho |y|^2."""
    to_y = np.linalg.cholesky(knot.value).T / np.sqrt(rho)
    to_x = np.linalg.inv(to_y)
    error = to_x @ Y
    torque = knot.torque - knot.gain @ error
    angle = error[0]
    gravity_error = candidate.weight_torque * (
        np.cos(knot.angle) * (angle - angle**3 / 6) - np.sin(knot.angle) * angle**2 / 2
    )

    def case(applied, *domain) -> Case:
        acceleration = (applied - knot.torque - candidate.damping * error[1] - gravity_error) / candidate.inertia
        rate = 2 * Y @ (to_y @ np.array([error[1], acceleration])) + Y @ (to_x.T @ knot.value_rate @ to_x / rho) @ Y
        return Case(Polynomial(rate, INDETERMINATES), tuple(Polynomial(g, INDETERMINATES) for g in domain))

    below, above = 1 - torque / candidate.torque_limit, 1 + torque / candidate.torque_limit
    return case(torque, below, above), case(candidate.torque_limit, -below), case(-candidate.torque_limit, -above)


def s_procedure(program: MathematicalProgram, case: Case) -> Polynomial:
    """sum_i sigma_i g_i with new quadratic SOS multipliers."""
    total = Polynomial(0)
    for g in case.domain:
        total += program.NewSosPolynomial(INDETERMINATES, 2)[0] * g
    return total


def is_attractive(candidate: Candidate, goal: Linearized, rho: float) -> bool:
    """Whether SOS shows that V decreases on {V <= rho} of the goal's LQR under saturation (program 3)."""
    program = MathematicalProgram()
    program.AddIndeterminates(Y)
    for case in saturation_cases(candidate, goal, rho):
        inside = program.NewSosPolynomial(INDETERMINATES, 2)[0] * (1 - SQUARED_NORM)
        program.AddSosConstraint(-case.decrease - 1e-6 * SQUARED_NORM - inside - s_procedure(program, case))
    return ClarabelSolver().Solve(program).is_success()


def goal_level(candidate: Candidate, goal: Linearized) -> float:
    """rho_N by doubling from 1, then geometric bisection."""
    low = 1.0
    while not is_attractive(candidate, goal, low):
        low /= 2
        if low < SMALLEST_RATIO:
            raise NoFunnel(f"no rho_N above {SMALLEST_RATIO:g} satisfies program 3")
    high = 2 * low
    while is_attractive(candidate, goal, high):
        low, high = high, 2 * high
    while high / low > 1 + BISECTION_TOLERANCE:
        middle = np.sqrt(low * high)
        low, high = (middle, high) if is_attractive(candidate, goal, middle) else (low, middle)
    return low


def maximize_slack(cases: tuple[Case, ...], step: float, ratio: float) -> tuple[float, list[Polynomial]]:
    """gamma and the multipliers lambda of the boundary, for rho_k = ratio * rho_{k+1} (program 4, first half)."""
    program = MathematicalProgram()
    program.AddIndeterminates(Y)
    slack = program.NewContinuousVariables(1, "gamma")[0]
    program.AddBoundingBoxConstraint(-np.inf, LARGEST_SLACK, slack)
    program.AddLinearCost(-slack)
    boundary = [program.NewFreePolynomial(INDETERMINATES, 2) for _ in cases]
    for case, multiplier in zip(cases, boundary, strict=True):
        residual = (1 - ratio) - step * case.decrease - multiplier * (ratio - SQUARED_NORM) - s_procedure(program, case)
        program.AddSosConstraint(residual - Polynomial(slack, INDETERMINATES))
    result = ClarabelSolver().Solve(program)
    if not result.is_success():
        raise NoFunnel(f"Clarabel: {result.get_solution_result().name} in program 4 for a fixed rho")
    return result.GetSolution(slack), [result.GetSolution(p) for p in boundary]


def maximize_ratio(cases: tuple[Case, ...], step: float, boundary: list[Polynomial]) -> float | None:
    """The largest rho_k / rho_{k+1} for fixed multipliers (program 4, second half); None if the solver has none."""
    program = MathematicalProgram()
    program.AddIndeterminates(Y)
    variable = program.NewContinuousVariables(1, "ratio")[0]
    program.AddLinearCost(-variable)
    ratio = Polynomial(variable, INDETERMINATES)
    for case, multiplier in zip(cases, boundary, strict=True):
        residual = (1 - ratio) - step * case.decrease - multiplier * (ratio - SQUARED_NORM) - s_procedure(program, case)
        program.AddSosConstraint(residual)
    result = ClarabelSolver().Solve(program)
    return result.GetSolution(variable) if result.is_success() else None


def level_ratio(cases: tuple[Case, ...], step: float) -> float:
    """rho_k / rho_{k+1} by alternation, from the largest power of 1/2 that is feasible; `NoFunnel` if none is."""
    ratio = 1.0
    slack, boundary = maximize_slack(cases, step, ratio)
    while slack < 0:
        ratio /= 2
        if ratio < SMALLEST_RATIO:
            raise NoFunnel(f"no rho_k above {SMALLEST_RATIO:g} rho_(k+1) satisfies program 4")
        slack, boundary = maximize_slack(cases, step, ratio)
    while (larger := maximize_ratio(cases, step, boundary)) is not None and larger > ratio * (
        1 + ALTERNATION_TOLERANCE
    ):
        ratio = larger
        _, boundary = maximize_slack(cases, step, ratio)
    return ratio


def estimate_funnel(candidate: Candidate, knots: list[Linearized], step: float) -> np.ndarray:
    """Levels rho [N+1], from the goal backward."""
    levels = [goal_level(candidate, knots[-1])]
    for knot in reversed(knots[:-1]):
        levels.append(levels[-1] * level_ratio(saturation_cases(candidate, knot, levels[-1]), step))
    return np.array(levels[::-1])


@contextmanager
def clocked(seconds: dict[str, float], step: str) -> Iterator[None]:
    """CPU time [s] of all threads of this process, also of a step that raises."""
    start = time.process_time()
    try:
        yield
    finally:
        seconds[step] = time.process_time() - start


def evaluate(candidate: Candidate, cost: str) -> dict:
    """One candidate's CPU seconds by step, and its funnel in numbers or why it has none."""
    seconds: dict[str, float] = {}
    record: dict = {"cpu_s": seconds}
    try:
        with clocked(seconds, "trajectory"):
            xs, us, step = plan(candidate, cost)
        with clocked(seconds, "lqr"):
            knots = stabilize(candidate, xs, us, step)
        with clocked(seconds, "funnel"):
            levels = estimate_funnel(candidate, knots, step)
    except NoFunnel as failure:
        record["failure"] = str(failure)
    else:
        areas = np.pi * levels / np.sqrt([np.linalg.det(knot.value) for knot in knots])
        record |= {"step_s": step, "sum_of_areas": areas.sum(), "inlet_area": areas[0], "goal_area": areas[-1]}
    seconds["total"] = sum(seconds.values())
    return record
