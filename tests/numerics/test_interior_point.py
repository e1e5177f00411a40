"""The optimizer on a cart on a line: closed forms where there are some, scipy's SLSQP where there are none.

p'' = gain u - sway sin p from rest at 0 to rest at 1, |p'| <= 1.2, |u| <= 2; cost time h + effort h u^2 / 2.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize

from rtcd_jax.numerics.integrate import rk4
from rtcd_jax.numerics.interior_point import ControlProblem, Guess, Settings, solve
from rtcd_jax.numerics.keep_out import sets_of

N, MOST = 10, 200
SPEED, FORCE, STEPS = 1.2, 2.0, (0.05, 0.4)
FAST, FRUGAL, SLOW_CART, SWAYING, WEAK, BROKEN = range(6)

# Columns: one problem each, in the order above.
PARAMETERS = {
    "time": np.array([1.0, 0.0, 1.0, 0.3, 1.0, 1.0]),
    "effort": np.array([0.0, 1.0, 0.001, 1.0, 1.0, 1.0]),
    "sway": np.array([0.0, 0.0, 0.0, 1.5, 0.0, np.nan]),
    "gain": np.array([0.5, 1.0, 2.0, 1.0, 1e-3, 1.0]),
}


def rate(x, u, parameters):
    return jnp.stack([x[1], parameters["gain"] * u[0] - parameters["sway"] * jnp.sin(x[0])])


def running(x, u, parameters):
    return parameters["time"] + 0.5 * parameters["effort"] * u[0] ** 2


def stage(x, u, h, parameters, substeps=4):
    return rk4(lambda x, u: rate(x, u, parameters), x, u, h, substeps), h * running(x, u, parameters)


START, GOAL = np.zeros(2), np.array([1.0, 0.0])
CART = ControlProblem(
    interval=lambda *arguments: stage(*arguments)[0],
    rate=rate,
    running=running,
    ends=lambda _: (START, GOAL),
    travel=GOAL - START,
    state_limits=np.array([np.inf, SPEED]),
    input_limits=np.array([FORCE]),
    step_limits=STEPS,
)


def guess(h):
    """The straight line, with ends that the solver has to pin."""
    line = np.stack([np.linspace(0.2, 1, N + 1), np.full(N + 1, 0.5)], 1)
    return Guess(jnp.asarray(line), jnp.zeros((N, 1)), jnp.asarray(h))


@jax.jit
def optimize(parameters, allowance):
    """Every problem from a slow and a fast guess, [.. P 2]: the last of three copies, on lanes that are refilled."""
    thrice = lambda leaf: jnp.tile(leaf, 3)  # noqa: E731
    allowance = thrice(jnp.broadcast_to(jnp.asarray(allowance), parameters["time"].shape))

    def from_guess(h):
        copies = solve(CART, jax.tree.map(thrice, parameters), guess(h), allowance, Settings(lanes=8))
        return jax.tree.map(lambda leaf: leaf[..., -6:], copies)

    return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), jax.lax.map(from_guess, jnp.array([0.3, 0.1])))


@pytest.fixture(scope="module")
def solution():
    return jax.tree.map(np.asarray, optimize(PARAMETERS, MOST))


@pytest.mark.thorough
def test_what_can_be_solved_is_solved_from_both_guesses(solution):
    np.testing.assert_array_equal(solution.solved, np.array([[True] * 2] * 4 + [[False] * 2] * 2))
    np.testing.assert_allclose(solution.cost[:4, 0], solution.cost[:4, 1], rtol=1e-4)


@pytest.mark.thorough
def test_the_minimum_time_is_that_of_full_force_to_the_middle_and_back(solution):
    """T = 2 sqrt(distance / acceleration), and force +2 then -2: the cart of gain 1/2 stays below its speed limit."""
    assert N * solution.h[FAST] == pytest.approx(np.full(2, 2 * np.sqrt(1 / (0.5 * FORCE))), rel=1e-4)
    expected = FORCE * np.repeat([1.0, -1.0], N // 2)
    np.testing.assert_allclose(solution.us[:, 0, FAST, 0], expected, atol=0.01)


@pytest.mark.thorough
def test_the_least_effort_is_the_shortest_solution_of_the_end_conditions(solution):
    """Without a price on time the step is the longest, and u the pseudo-inverse of the linear map to the end state."""
    h = STEPS[1]
    to_end = np.stack([h**2 * (N - 0.5 - np.arange(N)), np.full(N, h)])
    exact = np.linalg.pinv(to_end) @ GOAL
    np.testing.assert_allclose(solution.h[FRUGAL], h, rtol=1e-4)
    np.testing.assert_allclose(solution.us[:, 0, FRUGAL, 0], exact, atol=1e-3 * np.max(exact))
    np.testing.assert_allclose(solution.cost[FRUGAL], 0.5 * h * exact @ exact, rtol=1e-4)


def dense_optimum(index, keep_out=()):
    """Cost of problem `index` by SLSQP on all unknowns, with the accurate stage's own derivatives."""
    parameters = {key: values[index] for key, values in PARAMETERS.items()}

    def unpack(z):
        inner = z[: 2 * (N - 1)].reshape(N - 1, 2)
        xs = jnp.concatenate([START[None], inner, GOAL[None]])
        return xs, z[2 * (N - 1) : -1][None], z[-1]

    def simulate(z):
        xs, us, h = unpack(z)
        after, costs = stage(xs[:-1].T, us, h, parameters)
        return (after.T - xs[1:]).ravel(), jnp.sum(costs)

    def cost(z):
        return simulate(z)[1]

    def defects(z):
        return simulate(z)[0]

    def clearances(z):
        return jnp.concatenate([each.clearance(unpack(z)[0][1:-1].T) for each in keep_out])

    outside = {"type": "ineq", "fun": jax.jit(clearances), "jac": jax.jit(jax.jacfwd(clearances))} if keep_out else ()
    first = np.concatenate([np.stack([np.linspace(0, 1, N + 1)[1:-1], np.full(N - 1, 0.4)], 1).ravel(), np.zeros(N)])
    bounds = [(None, None), (-SPEED, SPEED)] * (N - 1) + [(-FORCE, FORCE)] * N + [STEPS]
    found = minimize(
        jax.jit(cost),
        np.append(first, 0.2),
        jac=jax.jit(jax.grad(cost)),
        bounds=bounds,
        constraints=[
            {"type": "eq", "fun": jax.jit(defects), "jac": jax.jit(jax.jacfwd(defects))},
            *([outside] if outside else []),
        ],
        method="SLSQP",
        options={"maxiter": 500, "ftol": 1e-12},
    )
    assert found.success, found.message
    return found.fun


@pytest.mark.parametrize("index", [SLOW_CART, SWAYING])
def test_the_optimum_is_that_of_a_dense_solver(solution, index):
    """The derivatives are those of a coarser integration: the optimum is right to second order in their error."""
    np.testing.assert_allclose(solution.cost[index], dense_optimum(index), rtol=1e-4)


def test_a_bound_on_the_states_is_kept_and_used(solution):
    fastest = np.max(solution.xs[:, 1, SLOW_CART], 0)
    assert np.all(fastest < SPEED)
    np.testing.assert_allclose(fastest, SPEED, rtol=1e-3)


def test_solutions_are_inside_the_boxes_with_exact_ends(solution):
    """Unsolved ones as well: the iterates never leave the boxes."""
    finite = slice(0, BROKEN)
    assert np.all(np.abs(solution.xs[1:-1, 1, finite]) < SPEED)
    assert np.all(np.abs(solution.us[..., finite, :]) < FORCE)
    assert np.all((solution.h[finite] > STEPS[0]) & (solution.h[finite] < STEPS[1]))
    for end, pinned in ((0, START), (-1, GOAL)):
        np.testing.assert_array_equal(solution.xs[end], np.broadcast_to(pinned[:, None, None], (2, 6, 2)))


def test_defects_and_costs_are_those_of_the_accurate_stage(solution):
    """Not of the model: one coarse step an interval would leave the swaying cart a defect above 1e-7."""
    for index in range(4):
        parameters = {key: values[index] for key, values in PARAMETERS.items()}
        xs, us, h = (leaf[..., index, 0] for leaf in (solution.xs, solution.us, solution.h))
        after, costs = stage(xs[:-1].T, us.T, h, parameters)
        defect = np.max(np.abs(after.T - xs[1:]))
        assert defect <= 1e-9
        assert solution.defect[index, 0] == pytest.approx(defect, abs=1e-14)
        assert solution.cost[index, 0] == pytest.approx(float(np.sum(costs)), rel=1e-12)
    parameters = {key: values[SWAYING] for key, values in PARAMETERS.items()}
    xs, us, h = (leaf[..., SWAYING, 0] for leaf in (solution.xs, solution.us, solution.h))
    coarse, _ = stage(xs[:-1].T, us.T, h, parameters, substeps=1)
    assert np.max(np.abs(coarse.T - xs[1:])) > 1e-7


def test_an_unreachable_goal_is_told_after_the_last_iteration(solution):
    assert np.all(solution.iterations[[WEAK, BROKEN]] == MOST)
    assert np.all(solution.defect[WEAK] > 1e-3)
    assert np.all(solution.iterations[:4] < MOST)


def test_iterations_are_counted_to_the_one_that_solves(solution):
    needed = int(np.max(solution.iterations[:4]))
    assert np.all(optimize(PARAMETERS, needed).solved[:4])
    one_less = optimize(PARAMETERS, needed - 1)
    np.testing.assert_array_equal(one_less.solved[:4], solution.iterations[:4] < needed)


@pytest.mark.thorough
def test_problems_without_allowance_are_left_out_and_change_no_other(solution):
    some = jax.tree.map(np.asarray, optimize(PARAMETERS, np.where(np.isin(np.arange(6), [FAST, WEAK]), 0, MOST)))
    others = [FRUGAL, SLOW_CART, SWAYING, BROKEN]
    for theirs, ours in zip(some, solution, strict=True):
        np.testing.assert_array_equal(theirs[..., others, :], ours[..., others, :])
    assert not np.any(some.solved[[FAST, WEAK]])
    np.testing.assert_array_equal(some.iterations[[FAST, WEAK]], 0)


def test_a_problem_does_not_notice_its_neighbours(solution):
    """The same programs on shuffled problems and with a NaN in place of another: equal to the last bit."""
    order = np.array([3, 5, 0, 4, 2, 1])
    shuffled = optimize({key: values[order] for key, values in PARAMETERS.items()}, MOST)
    for theirs, ours in zip(shuffled, solution, strict=True):
        np.testing.assert_array_equal(theirs, ours[..., order, :])
    broken = {key: np.where(np.arange(6) == FRUGAL, np.nan, values) for key, values in PARAMETERS.items()}
    others = [FAST, SLOW_CART, SWAYING, WEAK, BROKEN]
    beside = optimize(broken, MOST)
    for theirs, ours in zip(beside, solution, strict=True):
        np.testing.assert_array_equal(theirs[..., others, :], ours[..., others, :])
    assert not np.any(beside.solved[FRUGAL])


WALL = {"normal": [0.0, 1.0], "offset": SPEED}
COUPLED = {"normal": [1.0, 1.0], "offset": 1.3}
BALL = {"center": [0.5, 1.0], "semi_axes": [0.3, 0.25]}


def kept_out(*stated):
    """The slow and the swaying cart that keep out of the sets, without a limit on the speed."""
    sets = sets_of(stated, np.stack([START, GOAL]))
    free = CART._replace(state_limits=np.full(2, np.inf), keep_out=sets)
    two = {key: jnp.asarray(values[[SLOW_CART, SWAYING]]) for key, values in PARAMETERS.items()}
    return sets, jax.jit(lambda: solve(free, two, guess(0.3), jnp.full(2, MOST)))()


@pytest.mark.thorough
def test_a_half_space_in_the_place_of_a_bound_gives_the_same_optimum(solution):
    _, found = kept_out(WALL)
    assert found.solved.all()
    np.testing.assert_allclose(found.cost, solution.cost[[SLOW_CART, SWAYING], 0], rtol=1e-6)
    np.testing.assert_allclose(found.xs, solution.xs[..., [SLOW_CART, SWAYING], 0], atol=2e-3)


@pytest.mark.thorough
@pytest.mark.parametrize("stated", [(COUPLED,), (BALL,), (COUPLED, BALL)])
def test_motions_keep_out_of_sets_and_are_optimal_there(stated):
    """Both carts would go through the sets; a dense solver finds no cheaper way around them."""
    sets, found = kept_out(*stated)
    assert found.solved.all()
    clearances = np.stack([each.clearance(np.moveaxis(found.xs[1:-1], 1, 0)) for each in sets])
    assert clearances.min() > 0
    assert clearances.min() < 1e-3
    dense = [dense_optimum(index, sets) for index in (SLOW_CART, SWAYING)]
    np.testing.assert_allclose(found.cost, dense, rtol=1e-4)


@pytest.mark.thorough
def test_single_precision_stays_single():
    parameters = {key: jax.ShapeDtypeStruct((6,), jnp.float32) for key in PARAMETERS}
    single = Guess(*(jnp.asarray(leaf, jnp.float32) for leaf in guess(0.3)))
    shapes = jax.eval_shape(lambda parameters: solve(CART, parameters, single, jnp.full(6, MOST)), parameters)
    for name in ("us", "xs", "h", "cost", "defect"):
        assert getattr(shapes, name).dtype == jnp.float32


@pytest.mark.thorough
def test_a_step_whose_box_has_no_width_is_held_and_the_effort_is_the_least_for_it():
    """On a double integrator: the shortest vector of inputs that meets both end conditions."""
    h = 0.3
    fixed = CART._replace(step_limits=(h, h), state_limits=np.full(2, np.inf))
    frugal = {key: jnp.asarray(value[FRUGAL : FRUGAL + 1]) for key, value in PARAMETERS.items()}
    found = jax.jit(lambda: solve(fixed, frugal, guess(h), jnp.array([MOST])))()
    assert found.solved.all()
    assert float(found.h[0]) == h
    ahead = N - np.arange(N) - 0.5
    inputs = np.linalg.pinv(np.stack([h**2 * ahead, np.full(N, h)])) @ [1.0, 0.0]
    assert np.abs(inputs).max() < FORCE
    np.testing.assert_allclose(found.us[:, 0, 0], inputs, atol=1e-3 * inputs.max())
    np.testing.assert_allclose(found.cost[0], h * inputs @ inputs / 2, rtol=1e-6)
