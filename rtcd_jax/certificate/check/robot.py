"""A robot's equations of motion, derived from its mass matrix, its potential, its dampers and its motor.

    M(q) v' = motor (u + w) - damping v - dU/dq - c(q, v),    c_i = sum_jk (dM_ij/dq_k - 1/2 dM_jk/dq_i) v_j v_k

(Lagrange). The entries of M, and U, are sums of terms (cosine cos(k.q) + sine sin(k.q)) q^e: k has an integer for
every hinge, e one for every slide, and the coefficients are products of powers of the robot's numbers. Times
D = det M these are D x' = a + b (u + w), by the adjugate of M.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.exact import Q
from rtcd_jax.certificate.check.matrix import cofactors, dot
from rtcd_jax.certificate.check.squares import is_positive
from rtcd_jax.certificate.check.taylor import Space

HINGE, SLIDE = "hinge", "slide"


class Term(NamedTuple):
    """By joint, the factor k of a hinge's angle or the power e of a slide; powers of the robot's numbers by name."""

    joints: tuple[int, ...]
    powers: tuple[tuple[str, int], ...]
    cosine: Any
    sine: Any


Function = tuple[Term, ...]
"""Of the joints' positions."""


class Robot(NamedTuple):
    """What a claim says of a robot: states are the positions, then their rates; M has its lower triangle."""

    name: str
    states: tuple[str, ...]
    units: tuple[str, ...]
    input_unit: str
    joints: tuple[str, ...]
    mass: tuple[tuple[Function, ...], ...]
    potential: Function
    damping: tuple[Function, ...]
    motor: tuple[Function, ...]

    @property
    def hinges(self) -> tuple[int, ...]:
        return tuple(i for i, joint in enumerate(self.joints) if joint == HINGE)

    def wave(self, term: Term) -> tuple[int, ...]:
        """The term's k, by joint."""
        return tuple(k if joint == HINGE else 0 for k, joint in zip(term.joints, self.joints, strict=True))


def numbers_of(robot: Robot) -> set[str]:
    """The names in it."""
    rows = (*robot.mass, (robot.potential,), robot.damping, robot.motor)
    return {name for row in rows for function in row for term in function for name, _ in term.powers}


class Equations(NamedTuple):
    """A robot's equations: `christoffel`[i] has the factor of v_j v_k in c_i by (j, k), j <= k. The `waves` are all k
    but zero.
    """

    robot: Robot
    slopes: tuple[Function, ...]
    christoffel: tuple[dict[tuple[int, int], Function], ...]
    waves: tuple[tuple[int, ...], ...]

    def field(self, numbers: Mapping[str, Any], x: Sequence, waves: Mapping) -> tuple[Any, list, list]:
        """D, a [n] and b [n] at the states x, for any kind of number.

        `waves` has the sine and the cosine of k.q by k.
        """
        robot = self.robot
        joints = range(len(robot.joints))
        q, v = x[: len(joints)], x[len(joints) :]

        def value(function: Function) -> Any:
            return value_of(robot, function, numbers, q, waves)

        lower = [[value(entry) for entry in row] for row in robot.mass]
        mass = [[lower[max(i, j)][min(i, j)] for j in joints] for i in joints]
        forces = []
        for i in joints:
            force = value(self.slopes[i]) * -1 + value(robot.damping[i]) * v[i] * -1
            for (j, k), factor in self.christoffel[i].items():
                force = force + value(factor) * v[j] * v[k] * -1
            forces.append(force)
        motor = [value(gear) for gear in robot.motor]
        adjugate, determinant = cofactors(mass)
        a = [determinant * rate for rate in v] + [dot(row, forces) for row in adjugate]
        return determinant, a, [0 for _ in joints] + [dot(row, motor) for row in adjugate]


def derive(robot: Robot) -> Equations:
    joints = range(len(robot.joints))
    christoffel = []
    for i in joints:
        factors = {}
        for k in joints:
            for j in range(k + 1):
                both = [
                    term
                    for (a, b, by), sign in (((i, j, k), 1), ((i, k, j), 1), ((j, k, i), -1))
                    for term in _slope(robot, robot.mass[max(a, b)][min(a, b)], by, sign * (Q(1, 2) if j == k else 1))
                ]
                if merged := _merged(both):
                    factors[j, k] = merged
        christoffel.append(factors)
    slopes = tuple(_merged(_slope(robot, robot.potential, i)) for i in joints)
    everything = (*(entry for row in robot.mass for entry in row), robot.potential)
    waves = sorted({robot.wave(term) for function in everything for term in function if any(robot.wave(term))})
    return Equations(robot, slopes, tuple(christoffel), tuple(waves))


def _slope(robot: Robot, function: Function, by: int, factor: Any = 1) -> list[Term]:
    """The derivative by a position, times a factor."""
    terms = []
    for joints, powers, cosine, sine in function:
        k = joints[by] * factor
        if robot.joints[by] == HINGE:
            terms.append(Term(joints, powers, sine * k, cosine * -k))
        elif joints[by]:
            lowered = (*joints[:by], joints[by] - 1, *joints[by + 1 :])
            terms.append(Term(lowered, powers, cosine * k, sine * k))
    return terms


def _merged(terms: Sequence[Term]) -> Function:
    """The sum, without what cancels."""
    total: dict[tuple[tuple[int, ...], tuple[tuple[str, int], ...]], tuple[Any, Any]] = {}
    for joints, powers, cosine, sine in terms:
        a, b = total.get((joints, powers), (0, 0))
        total[joints, powers] = a + cosine, b + sine
    return tuple(Term(joints, powers, a, b) for (joints, powers), (a, b) in total.items() if a != 0 or b != 0)


def value_of(robot: Robot, function: Function, numbers: Mapping[str, Any], q: Sequence, waves: Mapping) -> Any:
    """The function at the positions q; `waves` has the sine and the cosine of k.q by k."""
    total = 0
    for term in function:
        factor = _product((numbers[name], power) for name, power in term.powers)
        wave = robot.wave(term)
        sine, cosine = waves[wave] if any(wave) else (0, 1)
        parts = [part * c for part, c in ((cosine, term.cosine), (sine, term.sine)) if c != 0]
        slides = ((q[i], e) for i, e in enumerate(term.joints) if robot.joints[i] == SLIDE)
        total = sum(parts) * factor * _product(slides) + total
    return total


def _product(powers) -> Any:
    total = 1
    for base, power in powers:
        for _ in range(power):
            total = base * total
    return total


# det M > 0 ------------------------------------------------------------------------------------------------------------


def mass_is_definite(robot: Robot, bounds: Mapping[str, tuple[Any, Any]]) -> bool:
    """Whether det M > 0 is shown for all angles and all numbers between their bounds.

    A quarter turn about 0 and one about pi are t in [-1, 1], e^(iq) = +-(1 + i t)^2 / (1 + t^2): without its positive
    denominators det M is a polynomial in t and in the numbers. A mass matrix that depends on a slide is not shown.
    """
    terms = [term for row in robot.mass for entry in row for term in entry]
    turning = [i for i in robot.hinges if any(term.joints[i] for term in terms)]
    most = {i: max(abs(term.joints[i]) for term in terms) for i in turning}
    if any(term.joints[i] for term in terms for i in range(len(robot.joints)) if i not in turning):
        return False
    uncertain = sorted(name for name, (low, high) in bounds.items() if low < high)
    space = Space(len(turning), 0, 0, len(uncertain))
    numbers = {name: space.poly(low) for name, (low, high) in bounds.items() if low == high}
    numbers |= {name: space.between(*bounds[name], i).p for i, name in enumerate(uncertain)}
    cube = {1 + i: (Q(-1), Q(1)) for i in range(len(turning) + len(uncertain))}
    for chart in range(1 << len(turning)):
        waves = {}
        for term in terms:
            wave, real, imaginary = robot.wave(term), space.poly(1), space.poly(0)
            for place, i in enumerate(turning):
                k, t = wave[i], space.y(place)
                turn = t if k > 0 else t * Q(-1)
                for _ in range(2 * abs(k)):
                    real, imaginary = real - imaginary * turn, imaginary + real * turn
                for _ in range(most[i] - abs(k)):
                    real, imaginary = real + real * t * t, imaginary + imaginary * t * t
                if chart >> place & 1 and k % 2:
                    real, imaginary = real * Q(-1), imaginary * Q(-1)
            waves[wave] = imaginary, real
        lower = [[_polynomial(space, robot, entry, numbers, waves) for entry in row] for row in robot.mass]
        joints = range(len(lower))
        _, determinant = cofactors([[lower[max(i, j)][min(i, j)] for j in joints] for i in joints])
        if not is_positive(determinant, cube):
            return False
    return True


def _polynomial(space: Space, robot: Robot, entry: Function, numbers: Mapping, waves: Mapping) -> Any:
    total = space.poly(0)
    for term in entry:
        sine, cosine = waves[robot.wave(term)]
        part = cosine * term.cosine + sine * term.sine
        for name, power in term.powers:
            for _ in range(power):
                part = part * numbers[name]
        total = total + part
    return total
