"""The checker's arithmetic: enclosures enclose, and the models are the plants'."""

import math
import subprocess
import sys
from fractions import Fraction

import mpmath
import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import PI, PI_ERROR, Q, Space, Taylor, polynomial

SPACE = Space(2, 4, 5)


def fraction(q):
    return Fraction(int(q.numerator), int(q.denominator))


def value(p, s, y):
    return sum(float(c) * s ** e[0] * y[0] ** e[1] * y[1] ** e[2] for e, c in check.terms_of(p))


def points(count=200):
    random = np.random.default_rng(0)
    y = random.normal(size=(count, 2))
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    y[::2] *= random.uniform(size=(len(y[::2]), 1))
    return zip(random.uniform(-1, 1, count), y, strict=True)


def test_pi():
    mpmath.mp.dps = 60
    assert abs(mpmath.mpf(int(PI.numerator)) / int(PI.denominator) - mpmath.pi) < mpmath.mpf(1) / 10**49
    assert fraction(PI_ERROR) == Fraction(1, 10**49)


@pytest.mark.parametrize("x", [0.0, 1e-3, -2.5, 3.0, 6.28, -40.0])
def test_series_of_sine_and_cosine(x):
    mpmath.mp.dps = 60
    for k, f in ((1, mpmath.sin), (0, mpmath.cos)):
        total, error = check.alternating(Q(*x.as_integer_ratio()), k)
        assert abs(mpmath.mpf(int(total.numerator)) / int(total.denominator) - f(mpmath.mpf(x))) < float(error) < 1e-22


def test_rounding_and_roots():
    third = Q(1, 3)
    low, error = check.near(third)
    assert 0 < abs(fraction(low) - Fraction(1, 3)) <= fraction(error)
    assert check.near(Q(5, 8)) == (Q(5, 8), Q(0))
    assert Fraction(1, 3) < fraction(check.up(third)) < Fraction(1, 3) + Fraction(1, 2**79)
    for q in (Q(2), Q(1, 3), Q(0), Q(10**40)):
        root = fraction(check.root_up(q))
        assert fraction(q) < root**2
        assert root**2 <= fraction(q) * (1 + Fraction(1, 10**20)) + Fraction(1, 2**150) * 4


@pytest.mark.parametrize("exponents", [(1, 0), (1, 1), (3, 2), (0, 4), (5, 1)])
def test_peaks_of_monomials(exponents):
    angle = np.linspace(0, 2 * np.pi, 100001)
    highest = np.max(np.abs(np.cos(angle) ** exponents[0] * np.sin(angle) ** exponents[1]))
    assert highest * (1 - 1e-12) <= float(check.peak(exponents)) <= highest * (1 + 1e-8)


@pytest.mark.parametrize("degree", [2, 4, 6])
def test_economized_series_stay_within_their_bound(degree):
    series = [Q(0) if k % 2 else Q((-1) ** (k // 2), math.factorial(k + 1)) for k in range(31)]
    radius = Q(3, 2)
    coefficients, error = check.economize(series, radius, degree)
    x = np.linspace(-1.5, 1.5, 2001)
    off = np.max(np.abs(np.polynomial.polynomial.polyval(x, [float(c) for c in coefficients]) - np.sinc(x / np.pi)))
    taylor = 1.5 ** (degree + 2) / math.factorial(degree + 3)
    assert 0.5 * float(error) < off <= float(error) * (1 + 1e-9)
    assert float(error) < taylor / 2**degree


@pytest.mark.parametrize("center", [0.3, 2.9])
@pytest.mark.parametrize("width", [0.2, 1.2])
def test_taylor_models_enclose_sine_and_cosine(center, width):
    angle = polynomial(
        2,
        {
            (0, 0, 0): Q(*center.as_integer_ratio()),
            (1, 0, 0): Q(1, 8),
            (0, 1, 0): Q(*width.as_integer_ratio()),
            (1, 0, 1): Q(1, 100),
        },
    )
    at = Q(*center.as_integer_ratio())
    (sine, error), (cosine, _) = check.alternating(at, 1), check.alternating(at, 0)
    models = check.sine_and_cosine(Taylor(SPACE, angle), at, (sine, cosine, error), "x")
    for model, f in zip(models, (np.sin, np.cos), strict=True):
        errors = [abs(f(value(angle, s, y)) - value(model.p, s, y)) for s, y in points()]
        bound = float(model.r + model.d)
        assert max(errors) <= bound
        assert bound < 50 * max(errors)


def test_products_enclose():
    f = Taylor(SPACE, polynomial(2, {(0, 1, 0): Q(1), (3, 0, 1): Q(1, 3)}), Q(1, 100))
    g = Taylor(SPACE, polynomial(2, {(2, 2, 1): Q(1, 7), (0, 0, 0): Q(2)}), Q(0), Q(1, 50))
    product = f * g
    for s, y in points():
        for a in (-1, 1):
            for b in (-1, 1):
                truth = (value(f.p, s, y) + a / 100) * (value(g.p, s, y) + b / 50)
                assert abs(truth - value(product.p, s, y)) <= float(product.r + product.d)


def test_remainders_that_vanish_with_the_level():
    """At the goal s is the level l and every y comes with it: r l + d bounds the error, d alone where l = 0."""
    f = Taylor(SPACE, polynomial(2, {(1, 1, 0): Q(1)}), Q(1, 10), Q(1, 1000))
    g = Taylor(SPACE, polynomial(2, {(0, 0, 0): Q(1), (1, 0, 1): Q(1)}), Q(1, 20), Q(1, 500))
    product = f * g
    for level in (0.0, 0.01, 0.3, 1.0):
        for _, z in points(50):
            for a in (-1, 1):
                for b in (-1, 1):
                    first = value(f.p, level, z) + a * (level / 10 + 1 / 1000)
                    second = value(g.p, level, z) + b * (level / 20 + 1 / 500)
                    error = abs(first * second - value(product.p, level, z))
                    assert error <= float(product.r) * level + float(product.d) + 1e-15


def test_what_is_rounded_vanishes_with_the_level_only_where_its_term_does():
    """A third of y, without l, is not the model's multiple of 2^-80 at l = 0 either."""
    third = Taylor(SPACE, polynomial(2, {(0, 1, 0): Q(1, 3)})).tidy()
    off = abs(fraction(dict(check.terms_of(third.p))[0, 1, 0]) - Fraction(1, 3))
    assert 0 < off <= fraction(third.d)
    with_level = Taylor(SPACE, polynomial(2, {(1, 1, 0): Q(1, 3)})).tidy()
    assert 0 < off <= fraction(with_level.r)
    assert with_level.d == 0


def test_reduction_to_the_sphere():
    angle = 0.7
    y = np.array([np.cos(angle), np.sin(angle)])
    for exponents in [(0, 2), (1, 5), (3, 4)]:
        reduced = sum(c * y[0] ** e[0] * y[1] ** e[1] for e, c in check.reduced(exponents))
        assert reduced == pytest.approx(y[0] ** exponents[0] * y[1] ** exponents[1], abs=1e-14)
    assert [len(check.monomials(n, d)) for n, d in ((2, 3), (4, 2), (4, 3))] == [7, 14, 30]


IN_TIME = polynomial(2, {(3, 1, 0): Q(2), (1, 0, 2): Q(-1), (0, 0, 0): Q(1, 3), (2, 3, 1): Q(5)})
LOW, HIGH = Q(1, 4), Q(3, 2)


def by_parts(parts, s, y):
    t, degree = (s - float(LOW)) / float(HIGH - LOW), len(parts) - 1
    values = [sum(float(c) * y[0] ** e[0] * y[1] ** e[1] for e, c in part.items()) for part in parts]
    return sum(math.comb(degree, j) * t**j * (1 - t) ** (degree - j) * each for j, each in enumerate(values))


def on_circle(count):
    for angle in np.linspace(0, 2 * np.pi, count):
        yield np.array([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("degree", [3, 5])
def test_bernstein_parts_are_the_polynomial(degree):
    parts, error = check.bernstein(IN_TIME, degree, LOW, HIGH)
    assert error == 0
    for s in np.linspace(0.25, 1.5, 7):
        assert by_parts(parts, s, [0.6, 0.8]) == pytest.approx(value(IN_TIME, s, [0.6, 0.8]), abs=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_bernstein_parts_of_too_low_a_degree_are_within_their_error(degree):
    parts, error = check.bernstein(IN_TIME, degree, LOW, HIGH)
    assert len(parts) == degree + 1
    apart = [
        abs(by_parts(parts, s, y) - value(IN_TIME, s, y)) for s in np.linspace(0.25, 1.5, 41) for y in on_circle(41)
    ]
    assert 0.3 * float(error) < max(apart) <= float(error) + 1e-12
    above = check.condition(IN_TIME, 2, degree, LOW, HIGH)
    for s in np.linspace(0.25, 1.5, 41):
        assert all(by_parts(above, s, y) >= value(IN_TIME, s, y) - 1e-12 for y in on_circle(9))


def test_what_is_cut_are_the_chebyshev_polynomials():
    """s^2 = (1 + T_2) / 2 and s^3 = (3 s + T_3) / 4 on [-1, 1]."""
    square, cube = (polynomial(1, {(k, 0): Q(1)}) for k in (2, 3))
    assert check.bernstein(square, 1, Q(-1), Q(1)) == ([{(0,): Q(1, 2)}, {(0,): Q(1, 2)}], Q(1, 2))
    assert check.bernstein(cube, 1, Q(-1), Q(1)) == ([{(0,): Q(-3, 4)}, {(0,): Q(3, 4)}], Q(1, 4))
    assert check.bernstein(square, 1, Q(0), Q(1))[1] == Q(1, 8)


def test_positive_definite_matrices():
    random = np.random.default_rng(1)
    for size in (1, 3, 6):
        root = random.integers(-9, 9, (size, size))
        square = root @ root.T
        exact = [[Q(int(c), 4) for c in row] for row in square]
        assert check.is_positive_definite(exact) == (round(np.linalg.det(square)) != 0)
        exact[-1][-1] = Q(-1)
        assert not check.is_positive_definite(exact)
    assert not check.is_positive_definite([[Q(1), Q(1)], [Q(1), Q(1)]])
    assert check.is_positive_definite([[Q(1), Q(1)], [Q(1), Q((1 << 60) + 1, 1 << 60)]])


def test_positive_polynomials():
    def shown(*coefficients):
        return check.is_positive(SPACE.compose(coefficients, SPACE.s), {0: (Q(-1), Q(1))})

    assert shown(Q(1), Q(0), Q(-99, 100))
    assert not shown(Q(1), Q(0), Q(-1))
    assert shown(Q(101, 10000), Q(-2, 10), Q(1))  # (s - 1/10)^2 + 1/10000
    assert not shown(Q(99, 10000), Q(-2, 10), Q(1))
    assert shown(Q(1))
    assert not shown(Q(0))


def test_cofactors():
    random = np.random.default_rng(2)
    for n in (2, 4):
        a = random.normal(size=(n, n))
        adjugate, determinant = check.cofactors([[Q(*c.as_integer_ratio()) for c in row] for row in a])
        assert float(determinant) == pytest.approx(np.linalg.det(a))
        numbers = np.array([[float(c) for c in row] for row in adjugate])
        np.testing.assert_allclose(numbers, np.linalg.inv(a) * np.linalg.det(a), atol=1e-12)


def test_the_checker_runs_on_the_standard_library_alone():
    code = (
        "import sys; sys.modules['flint'] = None\n"
        "from rtcd_jax.certificate import check\n"
        "assert check.Q.__module__ == 'fractions'\n"
        "p = check.polynomial(1, {(0, 2): check.Q(2)}) * check.polynomial(1, {(1, 1): check.Q(1, 2)})\n"
        "print(check.terms_of(p - p * 3), sorted({'numpy', 'jax', 'cvxpy', 'pydantic'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[((1, 3), Fraction(-2, 1))] []"
