"""The time-varying LQR against scipy's Riccati solvers along the same motion."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicHermiteSpline

from rtcd_jax.config.load import load
from rtcd_jax.policy import final_value, linearize, nominal, options, stabilize
from rtcd_jax.problem import make_problem
from rtcd_jax.trajectory import plan
from rtcd_jax.types import Candidate, Status
from tests.paths import CONFIGS
from tests.plants.robots import packaged

CONFIG = CONFIGS / "pendulum_rtcd.yaml"

# The paper's initial candidate, the stiffest corner of the box, its softest, and two between.
MASS, LENGTH = np.array([0.7, 0.6, 0.8, 0.65, 0.75]), np.array([0.4, 0.4, 0.6, 0.5, 0.45])
Q = np.array([[10.0, 1.0], [10.0, 10.0], [1.0, 1.0], [3.0, 2.0], [2.0, 8.0]])
R = np.array([[0.1], [0.001], [10.0], [1.0], [0.01]])
STIFF, SOFT = 1, 2


def take(tree, row):
    return jax.tree.map(lambda leaf: leaf[row], tree)


@pytest.fixture(scope="module")
def problem():
    return make_problem(load(CONFIG))


@pytest.fixture(scope="module")
def candidates():
    return Candidate(
        packaged("pendulum").Design(jnp.asarray(MASS), jnp.asarray(LENGTH)), jnp.asarray(Q), jnp.asarray(R)
    )


@pytest.fixture(scope="module")
def planned(problem, candidates):
    return jax.jit(partial(plan, problem))(candidates)


@pytest.fixture(scope="module")
def track(problem):
    return jax.jit(jax.vmap(partial(stabilize, problem)))


@pytest.fixture(scope="module")
def policies(track, candidates, planned):
    return track(candidates, planned)


class Linearized:
    """The linearization of candidate `row` by hand."""

    def __init__(self, plant, row):
        self.inertia = MASS[row] * LENGTH[row] ** 2
        self.damping, self.stiffness = plant.damping, MASS[row] * plant.gravity * LENGTH[row]
        self.b = np.array([[0.0], [1 / self.inertia]])

    def a(self, theta):
        return np.array([[0.0, 1.0], [-self.stiffness * np.cos(theta) / self.inertia, -self.damping / self.inertia]])

    def rate(self, x, u):
        torque = u - self.damping * x[:, 1] - self.stiffness * np.sin(x[:, 0])
        return np.stack([x[:, 1], torque / self.inertia], 1)


@pytest.mark.thorough
def test_every_candidate_has_a_policy(policies):
    np.testing.assert_array_equal(policies.status, Status.OK)


@pytest.mark.thorough
def test_values_are_symmetric_positive_definite_at_every_knot(policies):
    """The stiff candidate as well: its closed loop has poles that no explicit step of this size survives."""
    values = np.asarray(policies.values)
    np.testing.assert_array_equal(values, np.swapaxes(values, -1, -2))
    assert np.all(np.linalg.eigvalsh(values)[..., 0] > 0)
    assert np.max(np.abs(policies.gains[STIFF])) > 100


@pytest.mark.thorough
def test_the_last_value_is_the_goals_algebraic_riccati_solution(problem, policies):
    for row in range(len(MASS)):
        model = Linearized(problem.plant, row)
        exact = scipy.linalg.solve_continuous_are(model.a(np.pi), model.b, np.diag(Q[row]), np.diag(R[row]))
        np.testing.assert_allclose(policies.values[row, -1], exact, rtol=1e-8)


def test_gains_are_r_inverse_b_transposed_s(problem, policies):
    for row in range(len(MASS)):
        b = Linearized(problem.plant, row).b
        expected = np.einsum("mn,knj->kmj", b.T / R[row], policies.values[row])
        np.testing.assert_allclose(policies.gains[row], expected, rtol=1e-12)


def riccati_by_radau(problem, trajectory, row):
    """S(t_k) [N+1 n n] by an implicit integrator on the Hermite nominal, from scipy's algebraic solution."""
    model, q, r_inverse = Linearized(problem.plant, row), np.diag(Q[row]), 1 / R[row, 0]
    spread = r_inverse * model.b @ model.b.T
    xs, us, dt = (np.asarray(leaf) for leaf in (trajectory.xs, trajectory.us[:, 0], trajectory.dt))
    start_rates, end_rates = model.rate(xs[:-1], us), model.rate(xs[1:], us)
    values = [scipy.linalg.solve_continuous_are(model.a(np.pi), model.b, q, np.diag(R[row]))]
    for k in reversed(range(len(us))):
        theta = CubicHermiteSpline([0, dt], xs[k : k + 2, 0], [start_rates[k, 0], end_rates[k, 0]])

        def backward(t, flat, theta=theta):
            s, a = flat.reshape(2, 2), model.a(theta(dt - t))
            return (a.T @ s + s @ a - s @ spread @ s + q).ravel()

        flow = solve_ivp(backward, (0, dt), values[-1].ravel(), method="Radau", rtol=1e-9, atol=1e-10)
        values.append(flow.y[:, -1].reshape(2, 2))
    return np.array(values[::-1])


def errors(values, exact):
    """Largest error of a knot's value matrix over its largest entry, for every knot."""
    return np.max(np.abs(values - exact), (1, 2)) / np.max(np.abs(exact), (1, 2))


@pytest.mark.parametrize(("row", "tolerance"), [(0, 3e-5), (STIFF, 2e-6), (SOFT, 2e-3), (3, 2e-4)])
def test_values_solve_the_riccati_equation_along_the_motion(problem, planned, policies, row, tolerance):
    """A and B are held over a fifth of an interval: slow motions have the longest intervals and the largest error."""
    exact = riccati_by_radau(problem, take(planned, row), row)
    assert np.max(errors(policies.values[row], exact)) < tolerance


@pytest.mark.thorough
def test_the_error_of_the_values_falls_with_the_square_of_the_substep(problem, candidates, planned, policies):
    config = problem.config
    finer = config.trajectory.model_copy(update={"substeps": 2 * config.trajectory.substeps})
    halved = dataclasses.replace(problem, config=config.model_copy(update={"trajectory": finer}))
    values = jax.jit(partial(stabilize, halved))(take(candidates, SOFT), take(planned, SOFT)).values
    exact = riccati_by_radau(problem, take(planned, SOFT), SOFT)
    ratio = np.max(errors(policies.values[SOFT], exact)) / np.max(errors(values, exact))
    assert ratio == pytest.approx(4, rel=0.1)


@pytest.mark.thorough
def test_the_linearization_is_the_one_by_hand(problem, candidates):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(2, 5)))
    u = jnp.zeros((1, 5))
    for row in range(len(MASS)):
        model = Linearized(problem.plant, row)
        a, b = linearize(problem, take(candidates, row), x, u)
        for k in range(5):
            np.testing.assert_allclose(a[..., k], model.a(float(x[0, k])), rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(b[..., k], model.b, rtol=1e-12)


@pytest.mark.thorough
def test_the_nominal_motion_meets_knots_and_nearly_solves_the_dynamics(problem, candidates, planned):
    """Between the knots the interpolant's error is of fourth order in dt."""
    candidate, trajectory = take(candidates, 0), take(planned, 0)
    motion = nominal(problem, candidate, trajectory)
    at = motion.at(jnp.array([0.0, 0.5, 1.0]))
    np.testing.assert_array_equal(at[..., 0].T, trajectory.xs[:-1])
    np.testing.assert_array_equal(at[..., 2].T, trajectory.xs[1:])
    half = solve_ivp(
        lambda _, x: Linearized(problem.plant, 0).rate(x[None], float(trajectory.us[20, 0]))[0],
        (0, float(trajectory.dt) / 2),
        trajectory.xs[20],
        rtol=1e-10,
    ).y[:, -1]
    np.testing.assert_allclose(at[:, 20, 1], half, atol=1e-3)


@pytest.mark.thorough
def test_vmapped_is_one_by_one(problem, candidates, planned, policies):
    alone = jax.jit(partial(stabilize, problem))
    for row in range(len(MASS)):
        policy = alone(take(candidates, row), take(planned, row))
        np.testing.assert_allclose(policy.values, policies.values[row], rtol=1e-10)
        np.testing.assert_allclose(policy.gains, policies.gains[row], rtol=1e-10)


def test_a_broken_candidate_leaves_the_others_bit_equal(track, candidates, planned, policies):
    broken = dataclasses.replace(candidates, q=candidates.q.at[2, 1].set(jnp.nan))
    beside = track(broken, planned)
    assert beside.status[2] == Status.RICCATI_INDEFINITE
    for row in (0, 1, 3, 4):
        np.testing.assert_array_equal(beside.values[row], policies.values[row])
        np.testing.assert_array_equal(beside.gains[row], policies.gains[row])


class Unactuated(type(packaged("pendulum"))):
    """The pendulum with a motor that is not connected: its upright rest cannot be stabilized."""

    def dynamics(self, design, x, u):
        return super().dynamics(design, x, 0 * u)


@pytest.mark.thorough
def test_what_cannot_be_stabilized_is_indefinite(problem, candidates, planned):
    loose = dataclasses.replace(problem, plant=Unactuated(*jax.tree.leaves(problem.plant)))
    policy = jax.jit(partial(stabilize, loose))(take(candidates, 0), take(planned, 0))
    assert policy.status == Status.RICCATI_INDEFINITE


def test_the_first_failure_is_kept(track, candidates, planned):
    failed = dataclasses.replace(planned, status=jnp.full(5, Status.TRAJECTORY_NOT_SOLVED, jnp.int32))
    broken = dataclasses.replace(candidates, q=candidates.q.at[2, 1].set(jnp.nan))
    np.testing.assert_array_equal(track(broken, failed).status, Status.TRAJECTORY_NOT_SOLVED)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_dtype_and_shapes_are_kept(problem, candidates, planned, dtype):
    def cast(leaf):
        floating = jnp.issubdtype(leaf.dtype, jnp.floating)
        return jax.ShapeDtypeStruct(leaf.shape[1:], dtype if floating else leaf.dtype)

    policy = jax.eval_shape(partial(stabilize, problem), *jax.tree.map(cast, (candidates, planned)))
    assert policy.values == jax.ShapeDtypeStruct((51, 2, 2), dtype)
    assert policy.gains == jax.ShapeDtypeStruct((51, 1, 2), dtype)


OPTIONS = {"input_weight": 0.3, "authority": 0.2, "discount": 0.7}


@pytest.fixture(scope="module")
def cautious(problem):
    policy = problem.config.policy.model_copy(update=OPTIONS)
    return dataclasses.replace(problem, config=problem.config.model_copy(update={"policy": policy}))


def test_the_defaults_are_the_paper_s(problem):
    assert problem.config.policy.model_dump() == {"input_weight": 1.0, "authority": 1.0, "discount": 0.0}


@pytest.mark.thorough
def test_options_solve_their_own_riccati_equation(problem, cautious, candidates, planned):
    """S' = -((A + aI)'S + S (A + aI) - S B R^-1 B'S + Q) at the middle of intervals, R that of the interval's input."""
    soft, trajectory = take(candidates, SOFT), take(planned, SOFT)
    policy = jax.jit(partial(stabilize, cautious))(soft, trajectory)
    assert policy.status == Status.OK
    h, s = float(trajectory.dt), np.asarray(policy.values)
    motion = nominal(problem, soft, trajectory)

    @jax.jit
    def rate(k, share, s, u, weight):
        x = motion.at(share[None])[:, k, 0]
        a, b = linearize(problem, soft, x, u[None])
        a = a + 0.7 * jnp.eye(2)
        return a.T @ s + s @ a - s @ b @ b.T @ s / weight + jnp.diag(soft.q)

    inputs = np.asarray(trajectory.us)[:, 0]
    left = np.maximum(1 - np.abs(inputs) / 2.5, 0.2)
    weights = 0.3 * R[SOFT, 0] / left**2
    assert weights.max() > 5 * weights.min()
    for k in range(0, len(inputs), 7):
        found = solve_ivp(
            lambda t, v, k=k: rate(k, np.asarray(1 - t / h), v.reshape(2, 2), inputs[k], weights[k]).ravel(),
            (0, h),
            s[k + 1].ravel(),
            rtol=1e-7,
            atol=1e-7,
        ).y[:, -1]
        np.testing.assert_allclose(found.reshape(2, 2), s[k], rtol=3e-3)  # five substeps an interval
        _, b = linearize(problem, soft, trajectory.xs[k], trajectory.us[k])
        np.testing.assert_allclose(policy.gains[k], np.asarray(b).T @ s[k] / weights[k], rtol=1e-9)


@pytest.mark.thorough
def test_a_candidate_s_own_options_go_before_the_configuration_s(problem, cautious, candidates, planned):
    """Searched or fixed, the same numbers are the same controller; others are another."""
    soft, trajectory = take(candidates, SOFT), take(planned, SOFT)
    weighed = problem.config.policy.model_copy(update={"input_weight": 0.3})
    searched = dataclasses.replace(problem, config=problem.config.model_copy(update={"policy": weighed}))
    chosen = dataclasses.replace(soft, policy={"authority": jnp.asarray(0.2), "discount": jnp.asarray(0.7)})
    fixed = jax.jit(partial(stabilize, cautious))(soft, trajectory)
    found = jax.jit(partial(stabilize, searched))(chosen, trajectory)
    np.testing.assert_allclose(found.values, fixed.values, rtol=1e-12)
    np.testing.assert_allclose(found.gains, fixed.gains, rtol=1e-12)
    assert options(searched, chosen) == pytest.approx(OPTIONS)
    other = dataclasses.replace(chosen, policy=chosen.policy | {"discount": jnp.asarray(0.0)})
    assert not np.allclose(jax.jit(partial(stabilize, searched))(other, trajectory).gains, fixed.gains, rtol=1e-2)


@pytest.mark.thorough
def test_the_goal_s_lqr_is_discounted_too(problem, cautious, candidates):
    soft = take(candidates, SOFT)
    a, b = (np.asarray(m) for m in linearize(problem, soft, jnp.asarray(problem.goal), jnp.zeros(1)))
    expected = scipy.linalg.solve_continuous_are(a + 0.7 * np.eye(2), b, np.diag(Q[SOFT]), 0.3 * R[SOFT][:, None])
    found, reached = final_value(cautious, soft)
    assert reached
    np.testing.assert_allclose(found, expected, rtol=1e-8)
