"""Known theorems on both sides of their thresholds, shown by the program and accepted by the checker's arithmetic."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import GramCertificate, Halves, Obligation, Q, Refused, polynomial
from rtcd_jax.certificate.prove import sdp as program
from rtcd_jax.certificate.prove.backward import Effort, prove
from rtcd_jax.system.errors import UserError

NOTHING = Q(0)


def exact(value):
    return Q(*float(value).as_integer_ratio())


def anywhere(p, low=0.0, high=1.0):
    return Obligation(p, NOTHING, NOTHING, [], exact(low), exact(high))


def shown(todo, degree, bernstein=0, multiplier=0, solver=program.SOLVER, further=()):
    """The margin that the checker accepts, or None."""
    shape = program.shape_of(todo, degree, bernstein, multiplier, further)
    found = program.solve(program.data_of(todo, shape), shape, solver)
    return None if found.squares is None else float(check.margin(todo, found.squares, "theorem"))


def largest(todo, degree, bernstein=0, multiplier=0, solver=program.SOLVER, further=()):
    """The program's optimum, of whatever sign."""
    shape = program.shape_of(todo, degree, bernstein, multiplier, further)
    with program.program_of(shape) as stated:
        return stated.margin(program.data_of(todo, shape), solver)


def cubic(level):
    """x' = -x + x^3 on {x^2 <= level}: with x = sqrt(level) l z, -d/dt x^2 / (level l^2) = 2 - 2 level l^2 z^4."""
    return anywhere(polynomial(1, {(0, 2): Q(2), (2, 4): exact(-2 * level)}))


def test_cubic_field_has_the_unit_interval():
    assert shown(cubic(0.99), 1, 2) == pytest.approx(0.02, rel=1e-5)
    assert shown(cubic(1.01), 1, 2) is None


def motzkin():
    """x^4 y^2 + x^2 y^4 - 3 x^2 y^2 z^2 + z^6 >= 0 is no sum of squares; times x^2 + y^2 + z^2 it is one."""
    powers = {(0, 4, 2, 0): Q(1), (0, 2, 4, 0): Q(1), (0, 2, 2, 2): Q(-3), (0, 0, 0, 6): Q(1)}
    return anywhere(polynomial(3, powers))


def test_motzkin_is_refused_until_it_is_multiplied():
    assert largest(motzkin(), 3) < -1e-3
    assert largest(motzkin(), 4) == pytest.approx(0, abs=1e-5)
    assert shown(motzkin(), 3) is None


def lifted(amount):
    p = motzkin().p + polynomial(3, {(0, 0, 0, 0): exact(amount)})
    return anywhere(p)


def test_motzkin_lifted_by_what_it_lacks():
    lack = -largest(motzkin(), 3)
    assert shown(lifted(1.01 * lack), 3) > 0
    assert shown(lifted(0.99 * lack), 3) is None


VALUE = np.array([[1.5, -0.5], [-0.5, 1.0]])  # A'P + P A = -I for the field's linearization at the origin


def van_der_pol(x):
    """Reversed in time: the inside of the limit cycle is the region of attraction."""
    return np.stack([-x[1], x[0] + (x[0] ** 2 - 1) * x[1]])


def van_der_pol_level(level):
    """-V'/l^2 on V = level l^2, by substituting x = l L z into the polynomial field."""
    axes = np.linalg.cholesky(np.linalg.inv(VALUE) * level)
    space = check.Space(2, 16, 16)
    x = [sum_of(space, axes[i]) for i in range(2)]
    level_squared = polynomial(2, {(2, 0, 0): Q(1)})
    field = [x[1] * Q(-1), x[0] - x[1] + x[0] * x[0] * x[1] * level_squared]
    p = polynomial(2, {})
    for i in range(2):
        for j in range(2):
            p = p + x[i] * field[j] * exact(-2 * VALUE[i, j])
    return anywhere(p)


def sum_of(space, row):
    p = polynomial(2, {})
    for i, c in enumerate(row):
        p = p + space.y(i) * exact(c)
    return p


def largest_falling_level():
    """The largest level below which V falls everywhere, by samples."""
    angle = np.linspace(0, 2 * np.pi, 4001)
    z = np.linalg.cholesky(np.linalg.inv(VALUE)) @ np.stack([np.cos(angle), np.sin(angle)])
    levels = np.linspace(0.5, 4, 7001)
    rises = [np.max(np.sum((VALUE @ z) * van_der_pol(np.sqrt(level) * z), axis=0)) >= 0 for level in levels]
    return levels[np.argmax(rises)]


def test_van_der_pol_reversed():
    level = largest_falling_level()
    assert shown(van_der_pol_level(0.998 * level), 3, 4) > 0
    assert shown(van_der_pol_level(1.002 * level), 3, 4) is None


def test_van_der_pol_s_ellipse_lies_inside_the_limit_cycle():
    """At least the published estimate with this V, level 2.25 (Khalil, Nonlinear Systems, 8.2); less than all."""
    cycle = solve_ivp(lambda _, x: -van_der_pol(x), (0, 100), [2.0, 0.0], rtol=1e-9, atol=1e-9, max_step=0.01).y
    x, y = cycle[:, 2000:]
    values = np.sum(cycle[:, 2000:] * (VALUE @ cycle[:, 2000:]), axis=0)
    rounds = np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0))
    turn = slice(rounds[0], rounds[1] + 1)
    inside = abs(np.trapezoid(x[turn], y[turn]))  # the true region: all of the limit cycle's inside
    level = largest_falling_level()
    assert 2.25 < level < values.min()
    assert shown(van_der_pol_level(2.25), 3, 4) > 0
    assert 0.45 < np.pi * level / np.sqrt(np.linalg.det(VALUE)) / inside < 0.5


def ellipse_in_a_case(threshold):
    """y_1 + 0.5 >= 0 wherever y_1 >= threshold, with a time-dependent threshold: needs a multiplier."""
    p = polynomial(2, {(0, 1, 0): Q(1), (0, 0, 0): exact(0.5)})
    g = polynomial(2, {(0, 1, 0): Q(1), (0, 0, 0): exact(-threshold), (1, 0, 0): exact(0.01)})
    return Obligation(p, NOTHING, NOTHING, [g], exact(-1), exact(1))


@pytest.mark.parametrize("solver", ["CLARABEL", "SCS"])
@pytest.mark.parametrize("threshold", [-0.4, -0.6])
def test_conditions_hold_by_multipliers_and_solvers_agree_on_both_sides(threshold, solver):
    todo, expected = ellipse_in_a_case(threshold), 0.5 + threshold - 0.01
    assert largest(todo, 2, 3, 1, solver) == pytest.approx(expected, abs=1e-4)
    margin = shown(todo, 2, 3, 1, solver)
    assert margin is None if expected < 0 else margin == pytest.approx(expected, abs=1e-4)


FOURTH = tuple(e for e in check.monomials(3, 4) if sum(e) == 4)


def test_further_monomials_make_up_for_a_lower_degree():
    """All those of the next degree are that degree."""
    assert largest(motzkin(), 3, further=FOURTH) == pytest.approx(largest(motzkin(), 4), abs=1e-5)
    lack = -largest(motzkin(), 3)
    assert shown(lifted(0.1 * lack), 3) is None
    assert shown(lifted(0.1 * lack), 3, further=FOURTH) > 0


def test_what_no_square_has_counts_as_error():
    """1 + y_1^8 / 2 on the circle: at least 1, of which squares of cubics show 1 / 2."""
    todo = anywhere(polynomial(2, {(0, 0, 0): Q(1), (0, 8, 0): Q(1, 2)}))
    assert shown(todo, 3) == pytest.approx(0.5, abs=1e-5)
    assert shown(todo, 3, further=((4, 0),)) == pytest.approx(1, abs=1e-5)
    shape = program.shape_of(todo, 3, 0, 0)
    assert program.lowest(program.data_of(todo, shape), shape, np.array([[0.0], [1.0]])) == pytest.approx(0.5)


def test_another_solver_finds_what_motzkin_lacks():
    lack = -largest(motzkin(), 3)
    assert largest(motzkin(), 3, solver="SCS") == pytest.approx(-lack, abs=1e-4)
    assert shown(lifted(1.05 * lack), 3, solver="SCS") > 0
    assert shown(lifted(0.95 * lack), 3, solver="SCS") is None


def test_a_program_is_stated_once_for_all_data_of_its_shape_but_where_it_is_in_use():
    shapes = {program.shape_of(cubic(level), 1, 2, 0) for level in (0.3, 0.9, 1.2)}
    assert len(shapes) == 1
    with program.program_of(*shapes) as first:
        with program.program_of(*shapes) as second:
            assert first is not second
        with program.program_of(*shapes) as third:
            assert third is second
    for level in (0.3, 0.9, 1.2):
        assert largest(cubic(level), 1, 2) == pytest.approx(2 - 2 * level, abs=1e-5)


def test_the_parameters_enter_so_that_no_program_is_canonicalized_twice():
    """Disciplined parametrized programming, with and without multipliers."""
    for shape in (program.Shape(2, 2, 3, 1, 1), program.Shape(4, 2, 5, 0, 0)):
        with program.program_of(shape) as stated:
            assert stated.problem.is_dcp(dpp=True)


def test_solvers_are_found_by_name_and_those_that_cannot_are_not_offered():
    assert program.require_solver("scs") == "SCS"
    for name in ("OSQP", "NOSUCH"):
        with pytest.raises(UserError, match=rf"--solver = {name}: must be one of CLARABEL, .*SCS.*semidefinite"):
            program.require_solver(name)


def test_an_error_is_taken_from_the_margin():
    todo = cubic(0.5)
    shape = program.shape_of(todo, 1, 2, 0)
    found = program.solve(program.data_of(todo, shape), shape)
    assert float(check.margin(todo, found.squares, "x")) == pytest.approx(1, abs=1e-5)
    assert float(check.margin(todo._replace(error=exact(0.25)), found.squares, "x")) == pytest.approx(0.75, abs=1e-5)
    with pytest.raises(Refused, match=r"x\.gram\[\d\]: proves no decrease: at best -0\.5"):
        check.margin(todo._replace(error=exact(1.5)), found.squares, "x")


def test_indefinite_matrices_are_refused():
    todo = cubic(0.5)
    shape = program.shape_of(todo, 1, 2, 0)
    found = program.solve(program.data_of(todo, shape), shape).squares
    gram = [[row[:] for row in matrix] for matrix in found.gram]
    gram[1][0][0] = Q(-1, 1 << 60)
    with pytest.raises(Refused, match=r"x\.gram\[1\]: is not positive definite"):
        check.margin(todo, GramCertificate(found.degree, gram, []), "x")
    with pytest.raises(Refused, match="needs 0 multipliers"):
        check.margin(todo, found._replace(multipliers=[[]]), "x")


def test_halves_show_what_the_whole_does_not():
    """s^2 + 1 / 100 on [-1, 1]: its least Bernstein coefficient is -0.99, on either half it is 0.01."""
    todo = Obligation(polynomial(1, {(2, 0): Q(1), (0, 0): exact(0.01)}), NOTHING, NOTHING, [], exact(-1), exact(1))
    shape = program.shape_of(todo, 1, 2, 0)
    assert largest(todo, 1, 2) == pytest.approx(-0.99, abs=1e-5)
    first, second = (program.solve(program.data_of(half, shape), shape).squares for half in check.halves_of(todo))
    assert float(check.margin(todo, Halves(first, second), "x")) == pytest.approx(0.01, abs=1e-5)
    with pytest.raises(Refused, match=r"x\.gram\[1\]: proves no decrease"):
        check.margin(todo, first, "x")
    with pytest.raises(Refused, match=r"x\[0\]\.gram\[2\]: proves no decrease"):
        check.margin(todo, Halves(second, first), "x")
    gram = [*second.gram[:2], [[Q(-1), Q(0)], [Q(0), Q(1)]]]
    with pytest.raises(Refused, match=r"x\[1\]\.gram\[2\]: is not positive definite"):
        check.margin(todo, Halves(first, second._replace(gram=gram)), "x")


def test_a_lower_degree_in_time_costs_what_is_cut():
    """1 + s^2 / 10 on [-1, 1] by constants: its mean 1.05, up to 0.05."""
    todo = Obligation(polynomial(1, {(0, 0): Q(1), (2, 0): exact(0.1)}), NOTHING, NOTHING, [], exact(-1), exact(1))
    assert shown(todo, 1, 0) == pytest.approx(1, abs=1e-5)


def test_a_condition_of_a_lower_degree_holds_wherever_it_did():
    """y >= -0.4 - 0.01 s - 0.04 s^3 allows -0.45. Its cut without what is cut, 0.01 T_3, would allow -0.44 only."""
    todo = ellipse_in_a_case(-0.4)
    todo = todo._replace(where=[todo.where[0] + polynomial(2, {(3, 0, 0): exact(0.04)})])
    assert shown(todo, 2, 3, 1) == pytest.approx(0.05, abs=1e-5)


def test_samples_bound_the_margin():
    """No program's margin exceeds the least sampled value, and here the sphere has but two points."""
    todo, z = cubic(0.75), np.array([[-1.0, 1.0]])
    shape = program.shape_of(todo, 1, 2, 0)
    assert program.lowest(program.data_of(todo, shape), shape, z) == pytest.approx(0.5)
    todo = ellipse_in_a_case(-0.6)
    shape, angle = program.shape_of(todo, 2, 3, 1), np.linspace(0, 2 * np.pi, 10000)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    assert program.lowest(program.data_of(todo, shape), shape, circle) == pytest.approx(-0.11, abs=1e-3)


# What the prover does with them ---------------------------------------------------------------------------------------

CIRCLE = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 60)]).T


@pytest.fixture
def solved(monkeypatch):
    """The shapes of all programs that are solved."""
    shapes, solve = [], program.solve
    monkeypatch.setattr(
        program, "solve", lambda data, shape, solver: shapes.append(shape) or solve(data, shape, solver)
    )
    return shapes


def proved(todo, shapes, enough, halvings, halved=0):
    effort = Effort(CIRCLE[: program.shape_of(todo, 1, 0, 0).n], program.SOLVER, halvings, {"free": halved})
    found = prove({"free": todo}, {"free": shapes}, enough, True, effort)
    return (None, None) if found is None else (found[0]["free"], found[1])


def bent(least):
    """s^2 + least on [-1, 1]."""
    return Obligation(
        polynomial(2, {(2, 0, 0): Q(1), (0, 0, 0): exact(least)}), NOTHING, NOTHING, [], exact(-1), exact(1)
    )


def test_intervals_are_halved_where_that_helps(solved):
    todo = bent(0.01)
    shapes = [program.shape_of(todo, 1, 2, 0)]
    assert proved(todo, shapes, 0.005, 0) == (None, None)
    squares, margin = proved(todo, shapes, 0.005, 3)
    assert isinstance(squares, Halves)
    assert not any(isinstance(half, Halves) for half in squares)
    assert margin == pytest.approx(0.01, abs=1e-5)
    assert len(solved) == 1 + 3
    again, _ = proved(todo, shapes, 0.005, 3, halved=1)
    assert again == squares
    assert len(solved) == 4 + 2


def test_a_positive_margin_is_kept_where_halves_cannot_have_more(solved):
    todo = bent(1.01)
    squares, margin = proved(todo, [program.shape_of(todo, 1, 2, 0)], 1.5, 3)
    assert margin == pytest.approx(1.01, abs=1e-5)
    assert len(solved) == 1 + 2 + 4
    assert all(isinstance(half, Halves) for half in squares)


def test_monomials_that_are_needed_anyhow_are_tried_before_halves(solved):
    """0.4 + y_1^8 / 2, of which squares of cubics show -0.1 at any time."""
    todo = anywhere(polynomial(2, {(0, 0, 0): exact(0.4), (0, 8, 0): Q(1, 2)}))
    usual, larger = (program.shape_of(todo, 3, 0, 0, further) for further in ((), ((4, 0),)))
    squares, margin = proved(todo, [usual, larger], 0.1, 3)
    assert squares.further == ((4, 0),)
    assert margin == pytest.approx(0.4, abs=1e-5)
    assert solved == [larger]
