"""A file's parts, as docs/certificates.md has them. Whatever is not so is refused with its place."""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.claim import Catch, Claim, Reset, Shift
from rtcd_jax.certificate.check.exact import (
    MAX_FURTHER,
    MAX_ORDER,
    MAX_TERMS,
    MOST_HALVINGS,
    Q,
    require,
    rounded,
)
from rtcd_jax.certificate.check.funnel import Interval
from rtcd_jax.certificate.check.goal import Shell
from rtcd_jax.certificate.check.keep_out import Ellipsoid, HalfSpace
from rtcd_jax.certificate.check.node import Node
from rtcd_jax.certificate.check.robot import (
    HINGE,
    SLIDE,
    Equations,
    Function,
    Robot,
    Term,
    derive,
    mass_is_definite,
    numbers_of,
)
from rtcd_jax.certificate.check.squares import GramCertificate, Halves, Squares, monomials
from rtcd_jax.certificate.check.version1 import PLANTS

MAX_NOTES = 20
MOST_JOINTS, MOST_TERMS_OF_ROBOT, HIGHEST = 4, 200, 8
"""Of a robot; wave numbers and powers are at most `HIGHEST`."""
MOST_UNCERTAIN = 6
"""Numbers of a robot."""
MOST_SHIFTS, HIGHEST_SHIFT = 20, 3
"""Of the centers' parts, and the highest power of a number in one."""
_CASE = re.compile(r"((free|high|low)[-+]?(late)?|caught)(/[0-9]{1,3}(,[0-9]{1,3})*)?")


def read_claim(node: Node) -> Claim:
    """A claim of either version: one of version 1 names its robot."""
    if isinstance(node.value, dict) and "plant" in node.value:
        return _read_claim_1(node)
    first_order = isinstance(node.value, dict) and "jerk" in node.value
    kept_out = isinstance(node.value, dict) and "keep_out" in node.value
    shifted = isinstance(node.value, dict) and "shifts" in node.value
    caught = isinstance(node.value, dict) and "catch" in node.value
    names = (
        *("robot", "parameters", "limit", "disturbance", "noise", "age", "speed", *_LOOP, "push"),
        *(("catch",) if caught else _GOAL),
        *(("jerk", "reaction", "jumps") if first_order else ()),
        *(("keep_out",) if kept_out else ()),
        *(("shifts",) if shifted else ()),
    )
    entries: dict[str, Node] = dict(zip(names, node.keys(*names), strict=True))
    node.require_digests()
    robot = read_robot(entries["robot"])
    parameters = {name: _range(value) for name, value in entries["parameters"].named()}
    used = numbers_of(robot)
    entries["parameters"].require(parameters.keys() == used, f"must be the robot's, {', '.join(sorted(used))[:80]}")
    entries["parameters"].require(
        sum(low < high for low, high in parameters.values()) <= MOST_UNCERTAIN,
        f"has more than {MOST_UNCERTAIN} uncertain numbers",
    )
    limits = _range(entries["limit"])
    entries["limit"].require(limits[0] > 0, "must be > 0")
    require(
        mass_is_definite(robot, parameters), f"{node.place}.robot.mass", "its determinant is not shown to be positive"
    )
    n = len(robot.states)
    return _claim(
        entries,
        derive(robot),
        parameters,
        limits,
        disturbance=_at_least_zero(entries["disturbance"]),
        noise=[_at_least_zero(each) for each in entries["noise"].items(n)],
        age=_at_least_zero(entries["age"]),
        speed=_at_least_zero(entries["speed"]),
        push=_at_least_zero(entries["push"]),
        jerk=_at_least_zero(entries["jerk"]) if first_order else None,
        reaction=_at_least_zero(entries["reaction"]) if first_order else None,
        jumps=[_at_least_zero(each) for each in entries["jumps"].items(len(entries["u"].items()))]
        if first_order
        else [],
        keep_out=[_read_set(each, n) for each in entries["keep_out"].items(at_least=1)] if kept_out else [],
        shifts=_read_shifts(entries["shifts"], parameters, len(entries["x"].items()), n) if shifted else (),
        catch=_read_catch(entries["catch"], robot, parameters) if caught else None,
    )


def _read_catch(node: Node, robot: Robot, parameters: Mapping[str, Any]) -> Catch:
    n = len(robot.states)
    resets = isinstance(node.value, dict) and "reset" in node.value
    center, axes, *reset = node.keys("center", "axes", *(("reset",) if resets else ()))
    node.require_digests()
    return Catch(center.array(n), axes.array(n, n), _read_reset(reset[0], robot, parameters) if resets else None)


def _read_reset(node: Node, robot: Robot, parameters: Mapping[str, Any]) -> Reset:
    joints = len(robot.joints)
    node.require(len(robot.hinges) == joints, "needs a robot whose joints are all hinges")
    positions, turns, numbers, momentum = node.keys("positions", "turns", "numbers", "momentum")
    node.require_digests()
    rows = [[k.integer(-HIGHEST, HIGHEST) for k in row.items(joints)] for row in positions.items(joints)]
    after = dict(numbers.named())
    numbers.require(after.keys() == parameters.keys(), f"must be the robot's, {', '.join(sorted(parameters))[:80]}")
    values = {}
    for name, value in after.items():
        values[name] = value.value if value.value in tuple(parameters) else value.number()
    functions = [[_read_function(entry, robot.joints) for entry in row.items(joints)] for row in momentum.items(joints)]
    used = {name for row in functions for entry in row for term in entry for name, _ in term.powers}
    momentum.require(used <= parameters.keys(), f"must be of the robot's numbers, {', '.join(sorted(parameters))[:80]}")
    half_turns = [each.integer(-HIGHEST, HIGHEST) for each in turns.items(joints)]
    return Reset(rows, half_turns, values, tuple(map(tuple, functions)))


def _read_shifts(node: Node, parameters: Mapping[str, tuple[Any, Any]], knots: int, n: int) -> tuple[Shift, ...]:
    uncertain = sorted(name for name, (low, high) in parameters.items() if low < high)
    shifts = []
    for each in node.items(at_least=1):
        powers, x, rates = each.keys("powers", "x", "rates")
        each.require_digests()
        by_name = {name: power.integer(1, HIGHEST_SHIFT) for name, power in powers.named()}
        powers.require(by_name.keys() <= set(uncertain) and bool(by_name), f"must be of {', '.join(uncertain)[:80]}")
        values = x.array(knots, n)
        x.items()[0].require(all(value == 0 for value in values[0]), "must be zero: all robots begin about x*(0)")
        shifts.append(Shift(tuple(by_name.get(name, 0) for name in uncertain), values, rates.array(knots - 1, 2, n)))
    node.require(len(shifts) <= MOST_SHIFTS, f"has {len(shifts)} entries, must have at most {MOST_SHIFTS}")
    node.require(len({shift.powers for shift in shifts}) == len(shifts), "has the same powers twice")
    return tuple(shifts)


def _read_set(node: Node, n: int) -> HalfSpace | Ellipsoid:
    half = isinstance(node.value, dict) and "normal" in node.value
    names = ("normal", "offset") if half else ("center", "semi_axes")
    holds = isinstance(node.value, dict) and node.value.keys() == set(names)
    node.require(holds, f"must have the keys {', '.join(names)}")
    place, size = (Node(f"{node.place}.{name}", node.value[name]) for name in names)
    if half:
        return HalfSpace(place.array(n), size.number())
    center, axes = place.array(n), []
    for each in size.items(n):
        axes.append(None if each.value is None else each.number())
        each.require(axes[-1] is None or axes[-1] > 0, "must be > 0")
    return Ellipsoid(center, axes)


def _read_sides(node: Node, claim: Claim, ends: int) -> list[tuple]:
    """Of every ellipsoid to keep out of, its side at each of the `ends`."""
    sides, ellipsoids = [], claim.ellipsoids
    for each, ellipsoid in zip(node.items(len(ellipsoids)), ellipsoids, strict=True):
        sides.append([row.array(claim.n) for row in each.items(ends)])
        infinite = [i for i, axis in enumerate(ellipsoid.semi_axes) if axis is None]
        flat = all(row[i] == 0 for row in sides[-1] for i in infinite)
        each.require(flat, "must be zero where the ellipsoid has no end")
    return sides


_LOOP = ("state_limits", "dt", "x", "rates", "u", "K", "start")
_GOAL = ("x_goal", "K_goal")


def _read_claim_1(node: Node) -> Claim:
    names = ("plant", "parameters", *_LOOP, *_GOAL)
    entries: dict[str, Node] = dict(zip(names, node.keys(*names), strict=True))
    node.require_digests()
    entries["plant"].require(entries["plant"].value in tuple(PLANTS), f"must be one of {', '.join(PLANTS)}")
    plant = PLANTS[entries["plant"].value]
    given = entries["parameters"]
    given.require(isinstance(given.value, dict) and given.value.keys() == set(plant.parameters), "must be the plant's")
    parameters = {name: Node(f"{given.place}.{name}", given.value[name]).number() for name in plant.parameters}
    for name, value in parameters.items():
        must = ">= 0" if name in plant.at_least_zero else "> 0"
        holds = value >= 0 if must == ">= 0" else value > 0
        require(holds, f"{given.place}.{name}", f"= {rounded(value):g}: must be {must}")
    limit = parameters.pop(plant.limit)
    exact = {name: (value, value) for name, value in parameters.items()}
    nothing, noise = Q(0), [Q(0)] * len(plant.robot.states)
    return _claim(
        entries, derive(plant.robot), exact, (limit, limit), disturbance=nothing, noise=noise, age=nothing,
        speed=nothing, jerk=None, reaction=None, jumps=[], push=nothing,
    )  # fmt: skip


def _claim(entries: Mapping[str, Node], equations: Equations, parameters, limits, **acts: Any) -> Claim:
    """With the closed loop, which both versions state alike."""
    n = len(equations.robot.states)
    bounds = [None if limit.value is None else limit.number() for limit in entries["state_limits"].items(n)]
    dt = entries["dt"].number()
    entries["dt"].require(dt > 0, "must be > 0")
    knots = len(entries["x"].items(at_least=2))
    start = entries["start"].items(2)
    return Claim(
        equations, parameters, limits, bounds=bounds, dt=dt, x=entries["x"].array(knots, n),
        rates=entries["rates"].array(knots - 1, 2, n), u=entries["u"].array(knots - 1), K=entries["K"].array(knots, n),
        x_goal=entries["x_goal"].array(n) if "x_goal" in entries else [],
        K_goal=entries["K_goal"].array(n) if "K_goal" in entries else [],
        start=(start[0].integer(0, knots - 1), start[1].number()), **acts,
    )  # fmt: skip


def _at_least_zero(node: Node) -> Any:
    value = node.number()
    node.require(value >= 0, "must be >= 0")
    return value


def _range(node: Node) -> tuple[Any, Any]:
    """The least and the largest value."""
    low, high = node.array(2)
    node.require(low <= high, "must rise")
    return low, high


def read_robot(node: Node) -> Robot:
    """A robot in its own words."""
    entries = node.keys("name", "states", "units", "input_unit", "joints", "mass", "potential", "damping", "motor")
    node.require_digests()
    name, states, units, input_unit, joints, mass, potential, damping, motor = entries
    kinds = joints.texts(at_least=1)
    count = len(kinds)
    joints.require(set(kinds) <= {HINGE, SLIDE}, f"must be {HINGE} or {SLIDE}")
    joints.require(count <= MOST_JOINTS, f"has {count} entries, must have at most {MOST_JOINTS}")
    rows = [row.items(i + 1) for i, row in enumerate(mass.items(count))]

    def constants(each: Node) -> tuple[Function, ...]:
        found = tuple(_read_function(entry, kinds) for entry in each.items(count))
        each.require(not any(any(term.joints) for function in found for term in function), "must not move")
        return found

    return Robot(
        name.text(), states.texts(2 * count), units.texts(2 * count), input_unit.text(), kinds,
        tuple(tuple(_read_function(entry, kinds) for entry in row) for row in rows),
        _read_function(potential, kinds), constants(damping), constants(motor),
    )  # fmt: skip


def _read_function(node: Node, kinds: Sequence[str]) -> Function:
    terms = node.items()
    node.require(len(terms) <= MOST_TERMS_OF_ROBOT, f"must have at most {MOST_TERMS_OF_ROBOT} terms")
    return tuple(_read_term(term, kinds) for term in terms)


def _read_term(node: Node, kinds: Sequence[str]) -> Term:
    node.require(isinstance(node.value, dict) and node.value.keys() == {"joints", "powers", "cos", "sin"},
                 "must have joints, powers, cos and sin")  # fmt: skip
    at, powers, cosine, sine = (
        Node(f"{node.place}.{key}", node.value[key]) for key in ("joints", "powers", "cos", "sin")
    )
    places = tuple(
        each.integer(-HIGHEST if kind == HINGE else 0, HIGHEST)
        for each, kind in zip(at.items(len(kinds)), kinds, strict=True)
    )
    by_name = tuple(sorted((name, power.integer(1, HIGHEST)) for name, power in powers.named()))
    return Term(places, by_name, cosine.number(), sine.number())


def read_cases(node: Node, n: int) -> dict[str, Squares]:
    node.require(isinstance(node.value, dict) and all(map(_CASE.fullmatch, node.value)), "must be cases")
    return {case: _read_squares(Node(f"{node.place}.{case}", value), n) for case, value in node.value.items()}


def _read_squares(node: Node, n: int, halvings: int = 0) -> Squares:
    if isinstance(node.value, list):
        node.require(halvings < MOST_HALVINGS, f"halves the interval more than {MOST_HALVINGS} times")
        return Halves(*(_read_squares(half, n, halvings + 1) for half in node.items(2)))
    holds = isinstance(node.value, dict) and node.value.keys() - {"further"} == {"degree", "gram", "multipliers"}
    node.require(holds, "must have the keys degree, gram, multipliers, and may have further; or be a list of halves")
    value = {key: Node(f"{node.place}.{key}", each) for key, each in node.value.items()}
    degree = value["degree"].integer(1, MAX_ORDER // 2)
    further = _read_monomials(value["further"], n) if "further" in value else ()
    rows, sides = len(monomials(n, degree)) + len(further), len(monomials(n, degree - 1))
    grams = value["gram"].items(at_least=1)
    grams[0].require(len(grams) <= 2 * MAX_ORDER, f"must have at most {2 * MAX_ORDER} matrices")
    return GramCertificate(
        degree,
        [gram.symmetric(rows) for gram in grams],
        [[matrix.symmetric(sides) for matrix in each.items(at_least=1)] for each in value["multipliers"].items()],
        further,
    )


def _read_monomials(node: Node, n: int) -> tuple[tuple[int, ...], ...]:
    items = node.items(at_least=1)
    node.require(len(items) <= MAX_FURTHER, f"must have at most {MAX_FURTHER} monomials")
    return tuple(tuple(power.integer(0, MAX_ORDER // 2) for power in each.items(n)) for each in items)


def require_few_terms(node: Node, n: int, s_order: int, y_order: int, of_robots: tuple[int, int] = (0, 1)) -> None:
    """A polynomial of these orders in s, in y and in so many numbers, a power of which counts as so many of y, must be
    small enough to be multiplied in seconds.
    """
    terms = count_terms(n, s_order, y_order, of_robots)
    node.require(terms <= MAX_TERMS, f"asks for polynomials of {terms} terms, must be at most {MAX_TERMS}")


def count_terms(n: int, s_order: int, y_order: int, of_robots: tuple[int, int]) -> int:
    """Of a polynomial as `require_few_terms` has it."""
    m, stride = of_robots
    powers = range(y_order // stride + 1) if m else range(1)
    each = [math.comb(max(m + k - 1, 0), k) * math.comb(y_order - stride * k + n, n) for k in powers]
    return (s_order + 1) * sum(each)


def read_interval(node: Node, claim: Claim) -> Interval:
    others = (*(("late",) if claim.first_order else ()), *(("sides",) if claim.ellipsoids else ()))
    knot, start, end, first, last, bend, orders, cases, *more = node.keys(
        *("knot", "start", "end", "first", "last", "bend", "orders", "cases"), *others
    )
    node.require_digests()
    n = claim.n
    pair = [order.integer(1, MAX_ORDER - 1) for order in orders.items(3 + len(claim.uncertain) if claim.shifts else 2)]
    of_robots = (len(claim.uncertain), pair[2]) if claim.shifts else (0, 1)
    require_few_terms(orders, n, pair[0], pair[1], of_robots)
    interval = Interval(
        knot.integer(0, len(claim.u) - 1), start.number(), end.number(), first.array(n, n), last.array(n, n),
        bend.array(2, n, n), tuple(pair), read_cases(cases, n), more[0].array(2, n) if claim.first_order else [],
        _read_sides(more[-1], claim, 2) if claim.ellipsoids else [],
    )  # fmt: skip
    node.require(
        0 <= interval.start < interval.end <= 1, "must start before it ends, at fractions of its interval in [0, 1]"
    )
    return interval


def _read_shell(node: Node, n: int) -> Shell:
    start, end, cases = node.keys("start", "end", "cases")
    node.require_digests()
    shell = Shell(start.number(), end.number(), read_cases(cases, n))
    node.require(0 <= shell.start < shell.end <= 1, "must have levels that rise within [0, 1]")
    return shell


class Goal(NamedTuple):
    """Axes of the goal region, order of its Taylor models, weight of the S-lemma; the shells cover [rest, 1]. `late` is
    rho of delay.py where old measurements count to first order, `sides` are those of keep_out.py.
    """

    axes: list
    order: int
    weight: Any
    rest: Any
    shells: list[Shell]
    late: list
    sides: list


def read_goal(node: Node, claim: Claim) -> Goal:
    """The goal region; that of a file of version 1 has no `rest`, and its shells begin at 0."""
    names = ("axes", "order", "weight", "shells")
    ended = isinstance(node.value, dict) and "rest" in node.value
    others = (
        *(("rest",) if ended else ()),
        *(("late",) if claim.first_order else ()),
        *(("sides",) if claim.ellipsoids else ()),
    )
    axes, order, weight, items, *more = node.keys(*names, *others)
    rest = more[0].number() if ended else Q(0)
    shells, reached = [_read_shell(item, claim.n) for item in items.items(at_least=1)], rest
    node.require_digests()
    if claim.moves_the_goal:
        node.require(rest > 0, "must have a rest > 0: what acts on the robot moves it at the goal")
    for i, shell in enumerate(shells):
        place = f"{items.place}[{i}]"
        require(
            shell.start == reached, place, f"starts at {rounded(shell.start):g}, must start at {rounded(reached):g}"
        )
        reached = shell.end
    items.require(reached == 1, f"ends at {rounded(reached):g}, must end at 1")
    require_few_terms(order, claim.n, 0, order.integer(2, MAX_ORDER - 2))  # each power of y has the same one of l
    return Goal(
        axes.array(claim.n, claim.n), order.value, weight.number(), rest, shells,
        more[int(ended)].array(claim.n) if claim.first_order else [],
        _read_sides(more[-1], claim, 1) if claim.ellipsoids else [],
    )  # fmt: skip


def read_catch(node: Node, claim: Claim) -> tuple[int, dict[str, Squares]]:
    """The order of the Taylor models in y, and the squares."""
    order, cases = node.keys("order", "cases")
    node.require_digests()
    require_few_terms(order, claim.n, 0, order.integer(2, MAX_ORDER - 2))  # each power of y has the same one of l
    return order.value, read_cases(cases, claim.n)


def read_notes(node: Node) -> dict[str, str]:
    node.require(isinstance(node.value, dict), "must be an object")
    node.require(len(node.value) <= MAX_NOTES, f"has {len(node.value)} entries, must have at most {MAX_NOTES}")
    node.require(all(isinstance(note, str) for note in node.value.values()), "must hold texts")
    return node.value
