"""The robot inside a claim, from the equations that the search uses: those of its MJCF, in closed form.

Every number of the MJCF that is arithmetic of names is expanded into a polynomial of the stored parameters, so that the
claim's mass matrix and potential say which parameter enters with which power. What is no polynomial (a quotient by a
name, a root) becomes a number of its own, which may not be uncertain.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, final

from rtcd_jax.certificate import check
from rtcd_jax.config.plants import PlantConfig, RobotPlant
from rtcd_jax.config.robot import Robot, needs, value_of
from rtcd_jax.elite.elite import Elite
from rtcd_jax.plants.lagrange import Equations
from rtcd_jax.plants.laurent import ROUNDING, Laurent
from rtcd_jax.plants.mjcf import closed_form
from rtcd_jax.system.errors import UserError, closest

LONGEST_NAME = 40
"""Of a number in a claim."""
HIGHEST = 8
"""Power of a number, and factor of an angle, in a claim."""

Powers = tuple[tuple[str, int], ...]


class NoPolynomial(ArithmeticError):
    """Arithmetic that leaves the polynomials."""


@final
@dataclass(frozen=True)
class Polynomial:
    """Of numbers by name: coefficients by powers."""

    terms: Mapping[Powers, float]

    @classmethod
    def of(cls, value: "Polynomial | float") -> "Polynomial":
        return value if isinstance(value, Polynomial) else cls({(): float(value)} if value else {})

    @classmethod
    def number(cls, name: str) -> "Polynomial":
        return cls({((name, 1),): 1.0})

    def __add__(self, other: "Polynomial | float") -> "Polynomial":
        terms = dict(self.terms)
        for powers, c in Polynomial.of(other).terms.items():
            terms[powers] = terms.get(powers, 0.0) + c
        return Polynomial({powers: c for powers, c in terms.items() if c})

    __radd__ = __add__

    def __neg__(self) -> "Polynomial":
        return self * -1.0

    def __pos__(self) -> "Polynomial":
        return self

    def __sub__(self, other: "Polynomial | float") -> "Polynomial":
        return self + -Polynomial.of(other)

    def __rsub__(self, other: float) -> "Polynomial":
        return Polynomial.of(other) - self

    def __mul__(self, other: "Polynomial | float") -> "Polynomial":
        terms: dict[Powers, float] = {}
        for a, c in self.terms.items():
            for b, d in Polynomial.of(other).terms.items():
                powers = dict(a)
                for name, power in b:
                    powers[name] = powers.get(name, 0) + power
                key = tuple(sorted(powers.items()))
                terms[key] = terms.get(key, 0.0) + c * d
        return Polynomial({powers: c for powers, c in terms.items() if c})

    __rmul__ = __mul__

    def __truediv__(self, other: "Polynomial | float") -> "Polynomial":
        divisor = Polynomial.of(other).terms
        if divisor.keys() != {()}:
            raise NoPolynomial
        return Polynomial({powers: c / divisor[()] for powers, c in self.terms.items()})

    def __rtruediv__(self, other: float) -> "Polynomial":
        return Polynomial.of(other) / self

    def __pow__(self, power: Any) -> "Polynomial":
        if not isinstance(power, int) or not 0 <= power <= HIGHEST:
            raise NoPolynomial
        return math.prod([self] * power, start=Polynomial.of(1.0))

    def __rpow__(self, base: Any) -> "Polynomial":
        raise NoPolynomial

    def at(self, numbers: Mapping[str, float]) -> float:
        return sum(c * math.prod(numbers[name] ** power for name, power in powers) for powers, c in self.terms.items())


class ClaimedRobot(NamedTuple):
    """A robot as a claim says it.

    `numbers` are the values of those in `description`; `limit` is the motor's, `limit_name` its arithmetic. `names` has
    every number that a configuration may call uncertain, with its name in a claim. `mixed` has those that are in
    arithmetic which is no polynomial, with it. `derived` has the stored parameters that follow from others.
    """

    description: check.Robot
    numbers: dict[str, float]
    limit: float
    limit_name: str
    names: dict[str, str]
    mixed: dict[str, str]
    derived: dict[str, Polynomial]

    def ranges(self, widths: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Least and largest values of `numbers` by the relative half widths of names, rounded outward.

        Raises:
            UserError: a name that the robot does not have, or that enters by no polynomial.
        """
        widths = {name: width for name, width in widths.items() if width}
        for name in widths:
            if name not in self.names:
                known = closest(name, tuple(self.names))
                raise UserError(f"uncertainty: no number of the {self.description.name} is {name!r}; {known}")
            if text := self.mixed.get(self.names[name]):
                raise UserError(
                    f"uncertainty: no certificate bears {name}, which the robot has in {text!r}: proofs know sums and "
                    "products of what is uncertain"
                )
        ranges = {name: (value, value) for name, value in self.numbers.items()}
        for name, width in widths.items():
            symbol = self.names[name]
            if symbol in ranges:
                ranges[symbol] = around(self.numbers[symbol], width)
        return ranges


def around(value: float, width: float) -> tuple[float, float]:
    """Least and largest value by the relative half width, rounded outward."""
    if not value * width:
        return value, value
    low, high = sorted((value * (1 - width), value * (1 + width)))
    return math.nextafter(low, -math.inf), math.nextafter(high, math.inf)


def claimed_robot(elite: Elite) -> ClaimedRobot:
    """The robot of an elite.

    Raises:
        UserError: there is no claim about it, with the reason.
    """
    if elite.u.shape[1] != 1:
        raise UserError(f"no certificate for {elite.u.shape[1]} inputs: the checker knows loops with one")
    claimed = robot_of(elite.robot, elite.parameters, elite.design_units)
    if float(elite.u_max[0]) != claimed.limit:
        raise UserError(f"u_max = {elite.u_max[0]}: must be {claimed.limit_name} = {claimed.limit}")
    return claimed


def robot_of(config: PlantConfig, parameters: Mapping[str, float], units: Mapping[str, str]) -> ClaimedRobot:
    """The robot of a configuration with these stored parameters; `units` are those of a design that has none.

    Raises:
        UserError: as `claimed_robot`.
    """
    if not isinstance(config, RobotPlant):
        raise UserError(f"no certificate for the {config.name}: its equations are a Python class's, no MJCF says them")
    robot = config.with_parameters(parameters).robot(units)
    if len(robot.inputs) != 1:
        raise UserError(f"no certificate for {len(robot.inputs)} inputs: the checker knows loops with one")
    values = {name: float(value) for name, value in robot.numbers(parameters).items()}
    limit = float(value_of(robot.limits[0], values))
    polynomials, numbers, mixed = _polynomials(robot, values)
    form = closed_form(robot)
    symbols = [_expanded(text, polynomials, numbers, mixed, values) for text in form.symbols]
    description = _described(robot, form.equations, symbols, numbers)
    used = check.numbers_of(description)
    names = {named.name: named.symbol for named in (*robot.design, *robot.constants)}
    uncertain = tuple(name for names in config.uncertain.values() for name in names)
    return ClaimedRobot(
        description,
        {name: value for name, value in numbers.items() if name in used},
        limit,
        f"{robot.limits[0]}",
        {name: names[name] for name in uncertain},
        mixed,
        {named.symbol: polynomials[named.name] for named, _ in robot.derived},
    )


def _polynomials(
    robot: Robot, values: Mapping[str, float]
) -> tuple[dict[str, Polynomial], dict[str, float], dict[str, str]]:
    """Every name's polynomial in the stored parameters, these parameters, and the names that enter by no polynomial.

    What follows from others is their arithmetic, times what the stored value is of it.
    """
    plain = (*robot.design, *robot.constants)
    polynomials = {named.name: Polynomial.number(named.symbol) for named in plain}
    numbers = {named.symbol: values[named.name] for named in plain}
    mixed: dict[str, str] = {}
    for named, value in robot.derived:
        arithmetic = float(value_of(value, values))
        if isinstance(value, str) and arithmetic:
            share = values[named.name] / arithmetic
            polynomials[named.name] = _expanded(value, polynomials, numbers, mixed, values) * (
                1.0 if abs(share - 1) < ROUNDING else share
            )
        else:
            numbers[named.symbol] = values[named.name]
            polynomials[named.name] = Polynomial.number(named.symbol)
    return polynomials, numbers, mixed


def _expanded(
    text: str,
    polynomials: Mapping[str, Polynomial],
    numbers: dict[str, float],
    mixed: dict[str, str],
    values: Mapping[str, float],
) -> Polynomial:
    """Arithmetic as a polynomial; as a number of its own, which is added to `numbers`, where it is none."""
    try:
        return Polynomial.of(value_of(text, polynomials))
    except NoPolynomial:
        name = text.replace(" ", "")
        name = name if len(name) <= LONGEST_NAME else f"number {len(numbers)}"
        numbers[name] = float(value_of(text, values))
        mixed |= {leaf: text for each in needs(text) for powers in polynomials[each].terms for leaf, _ in powers}
        return Polynomial.number(name)


def _described(
    robot: Robot, equations: Equations, symbols: Sequence[Polynomial], numbers: Mapping[str, float]
) -> check.Robot:
    """The equations in the checker's words; `symbols` are what their symbols stand for."""

    def function(p: Laurent) -> check.Function:
        return _function(p, equations.angles, symbols)

    potential = list(function(equations.potential))
    for i, (stiffness, rest) in enumerate(equations.springs):
        for term in function(stiffness):
            if not float(term.cosine) * math.prod(numbers[name] ** power for name, power in term.powers):
                continue
            if equations.angles[i]:
                raise UserError(f"no certificate for a spring on the hinge {robot.joints[i].name}: it has no sine")
            for power, factor in ((2, 0.5), (1, -rest)):
                joints = tuple(power * (j == i) for j in range(len(equations.angles)))
                cosine = check.rational(float(term.cosine) * factor)
                potential.append(check.Term(joints, term.powers, cosine, check.Q(0)))
    states = robot.states
    return check.Robot(
        name=robot.name,
        states=tuple(states),
        units=tuple(states.values()),
        input_unit=robot.inputs[0][1],
        joints=tuple(check.HINGE if angle else check.SLIDE for angle in equations.angles),
        mass=tuple(tuple(function(entry) for entry in row) for row in equations.mass),
        potential=tuple(term for term in potential if any(term.joints) and (term.cosine != 0 or term.sine != 0)),
        damping=tuple(map(function, equations.damping)),
        motor=tuple(function(row[0]) for row in equations.motors),
    )


def _function(p: Laurent, angles: Sequence[bool], symbols: Sequence[Polynomial]) -> check.Function:
    """c e^(ik.q) and its conjugate are 2 Re(c) cos(k.q) - 2 Im(c) sin(k.q)."""
    joints = len(angles)
    total: dict[tuple[tuple[int, ...], Powers], list[float]] = {}
    for exponents, c in p.terms.items():
        places = exponents[:joints]
        wave = [k for k, angle in zip(places, angles, strict=True) if angle and k]
        if wave and wave[0] < 0:
            continue
        twice, c = (2 if wave else 1), complex(c)
        factor = math.prod((s**e for s, e in zip(symbols, exponents[joints:], strict=True)), start=Polynomial.of(1.0))
        for powers, d in factor.terms.items():
            entry = total.setdefault((places, powers), [0.0, 0.0, 0.0])
            parts = twice * c.real * d, -twice * c.imag * d
            entry[0], entry[1] = entry[0] + parts[0], entry[1] + parts[1]
            entry[2] = max(entry[2], *map(abs, parts))
    return tuple(
        check.Term(places, powers, *(check.rational(part if abs(part) > ROUNDING * largest else 0.0) for part in parts))
        for (places, powers), (*parts, largest) in sorted(total.items())
        if any(abs(part) > ROUNDING * largest for part in parts)
    )
