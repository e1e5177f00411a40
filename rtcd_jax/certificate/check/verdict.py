"""Every obligation of a certificate, and what follows when all of them hold."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.catch import catch_obligations
from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.exact import Damaged, Q, Undecided, printable, require, root_up, rounded
from rtcd_jax.certificate.check.file import (
    Goal,
    Node,
    digest,
    parse,
    read_bytes,
    read_catch,
    read_claim,
    read_goal,
    read_interval,
    read_notes,
)
from rtcd_jax.certificate.check.funnel import (
    Interval,
    funnel_obligations,
    motion,
    require_bounds,
    require_jump,
    require_kept_out,
)
from rtcd_jax.certificate.check.goal import goal_field, goal_obligations, require_arrival
from rtcd_jax.certificate.check.keep_out import Ellipsoid, HalfSpace, half_spaces
from rtcd_jax.certificate.check.matrix import cofactors, dot
from rtcd_jax.certificate.check.push import require_push
from rtcd_jax.certificate.check.robot import Robot
from rtcd_jax.certificate.check.squares import Obligation, Squares, margin
from rtcd_jax.certificate.check.taylor import terms_of

FORMAT, VERSION = "rtcd certificate", 2
VERSIONS = 1, 2


class Report(NamedTuple):
    """What an accepted certificate proves, rounded: volumes in the product of the states' units, times in s.

    `digest` is the SHA-256 of the claim's canonical JSON, `inlet` has the first ellipsoid's axes, exact. `shells` are
    None, and `rest` is empty, where the motion ends in a catch.
    """

    claim: Claim
    digest: str
    inlet: list
    intervals: int
    shells: int | None
    start: float
    end: float
    volumes: dict[str, float]
    axes: dict[str, list[float]]
    rest: list[float]
    margin: float
    notes: dict[str, str]


def margins(todo: Mapping[str, Obligation], cases: Mapping[str, Squares], place: str) -> dict[str, Any]:
    """Margin by case; refused unless there are squares for exactly the cases that can occur."""
    require(todo.keys() == cases.keys(), place, f"must have the cases {', '.join(todo)}, has {', '.join(cases)}")
    return {case: margin(todo[case], cases[case], f"{place}.{case}") for case in todo}


def check_interval(claim: Claim, interval: Interval, place: str):
    """The margin of one interval's proof."""
    data = motion(claim, interval)
    require_bounds(claim, data, place)
    require_kept_out(claim, interval, data, place)
    if claim.push != 0:
        require_push(claim, interval, place)
    if claim.first_order:
        require_jump(claim, interval, place)
    return min(margins(funnel_obligations(claim, interval, place), interval.cases, f"{place}.cases").values())


def check_chain(claim: Claim, intervals: Sequence[Interval], place: str) -> None:
    """The intervals cover [start, t_N] without gap or overlap, and their ellipsoids join."""
    reached, axes = claim.start, None
    for i, interval in enumerate(intervals):
        here, at, begins = f"{place}[{i}]", reached[0] + reached[1], interval.knot + interval.start
        where = f"starts at {rounded(begins):.17g} knots, must start at {rounded(at):.17g}"
        require(begins <= at, here, f"leaves a gap: {where}")
        require(begins == at, here, f"overlaps: {where}")
        require(axes is None or axes == interval.first, f"{here}.first", "is not where the interval before it ends")
        reached, axes = (interval.knot, interval.end), interval.last
    require(reached[0] + reached[1] == len(claim.u), place, "does not reach the last knot")


def check_goal(claim: Claim, node: Node, outlet: list) -> tuple[Goal, list, Any]:
    """The goal region, how close motions come [n], and the least margin."""
    goal = read_goal(node, claim)
    for i, bound in enumerate(claim.bounds):
        left = None if bound is None else bound - abs(claim.x_goal[i])
        inside = left is None or (left > 0 and left * left > dot(goal.axes[i], goal.axes[i]))
        require(inside, f"{node.place}.axes", f"the limit on |{claim.robot.states[i]}| is not kept")
    sides = [(ends[0], ends) for ends in goal.sides]
    for i, (normal, center, offset) in enumerate(half_spaces(claim.keep_out, sides)):
        left = offset + dot([c - x for c, x in zip(center, claim.x_goal, strict=True)], normal)
        turned = [dot(normal, column) for column in zip(*goal.axes, strict=True)]
        outside = left > 0 and left * left > dot(turned, turned)
        require(outside, f"{node.place}.axes", f"the set claim.keep_out[{i}] is not kept out of")
    field = goal_field(claim, goal.axes, goal.order, node.place, goal.late)
    require_arrival(claim, outlet, goal.axes, goal.weight, f"{node.place}.axes")
    least, drift = None, Q(0)
    for i, shell in enumerate(goal.shells):
        todo = goal_obligations(claim, field, shell.start, shell.end, shell.cases)
        smallest = min(margins(todo, shell.cases, f"{node.place}.shells[{i}].cases").values())
        least = smallest if least is None else min(least, smallest)
        drift = max(drift, *(each.drift for each in todo.values()))
    rest = max(goal.rest, drift / least)
    require(rest < 1, node.place, "the rounding of the goal is too large for a proof")
    return goal, [rest * root_up(dot(row, row)) for row in goal.axes], least


def check_catch(claim: Claim, node: Node, outlet: list) -> Any:
    """The margin of the motion's end in its catch."""
    order, cases = read_catch(node, claim)
    todo = catch_obligations(claim, outlet, order, node.place)
    return min(margins(todo, cases, f"{node.place}.cases").values())


def check(content: Any, progress: Callable[[int, int], None] = lambda done, of: None) -> Report:
    """What the parsed certificate proves.

    Raises:
        Refused: it proves nothing, with the place and the reason.
        Undecided: there is not enough memory for it.
    """
    try:
        return _check(content, progress)
    except RecursionError:
        raise Damaged("certificate", "is nested too deeply") from None
    except MemoryError:
        raise Undecided("needs more memory than there is: undecided") from None


def _check(content: Any, progress: Callable[[int, int], None]) -> Report:
    top = Node("certificate", content)
    top.require(isinstance(content, dict), "must be an object")
    top.require(content.get("format") == FORMAT, f"is no {FORMAT!r}")
    version = content.get("version")
    top.require(type(version) is int and version in VERSIONS, "must be of version 1 or 2")
    ends = "catch" if "catch" in content else "goal"
    _, _, about, funnel, end, notes = top.keys("format", "version", "claim", "funnel", ends, "notes")
    texts, claim = read_notes(notes), read_claim(about)
    top.require(("plant" in about.value) == (version == 1), f"has the claim of another version than {version}")
    held = claim.catch is None
    top.require(held == (ends == "goal"), f"must have a {'goal' if held else 'catch'}, as its claim has")
    intervals = [read_interval(item, claim) for item in funnel.items(at_least=1)]
    check_chain(claim, intervals, funnel.place)
    outlet, shells, rest = intervals[-1].last, None, []
    if claim.catch is not None:
        region, least = claim.catch.axes, check_catch(claim, end, outlet)
    else:
        goal, rest, least = check_goal(claim, end, outlet)
        region, shells = goal.axes, len(goal.shells)
    for i, interval in enumerate(intervals):
        least = min(least, check_interval(claim, interval, f"{funnel.place}[{i}]"))
        progress(i + 1, len(intervals))
    top.require_digests()
    volumes, axes = volumes_of(claim, intervals, region)
    begin = rounded((claim.start[0] + claim.start[1]) * claim.dt)
    return Report(
        claim, digest(about.value), intervals[0].first, len(intervals), shells, begin,
        rounded(len(claim.u) * claim.dt), volumes, axes, [rounded(r) for r in rest], rounded(least), texts,
    )  # fmt: skip


def volumes_of(
    claim: Claim, intervals: Sequence[Interval], region: list
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """Volumes |unit ball| det L, and half widths of the ellipsoids along each state; `region` has the axes of the goal
    region, or of the catch set.
    """
    last = "goal" if claim.catch is None else "catch"
    ball = math.pi ** (claim.n / 2) / math.gamma(claim.n / 2 + 1)

    def volume(axes) -> float:
        return ball * rounded(cofactors(axes)[1])

    def widths(axes) -> list[float]:
        return [rounded(root_up(dot(row, row))) for row in axes]

    knots = [volume(interval.first) for interval in intervals if interval.start == 0] + [volume(intervals[-1].last)]
    integral = Q(0)
    for interval in intervals:
        data = motion(claim, interval)
        powers = {e[0]: c for e, c in terms_of(cofactors(data.axes)[1])}
        integral += sum((c / (k + 1) for k, c in powers.items() if k % 2 == 0), Q(0)) * data.duration
    volumes = {
        "sum": total(knots), "integral": ball * rounded(integral), "inlet": volume(intervals[0].first),
        "outlet": knots[-1], last: volume(region),
    }  # fmt: skip
    return volumes, {"inlet": widths(intervals[0].first), "outlet": widths(intervals[-1].last), last: widths(region)}


def total(values: Sequence[float]) -> float:
    """The sum, correctly rounded; infinite where no double holds it."""
    try:
        return math.fsum(values)
    except OverflowError:
        return math.inf


def sentence(report: Report) -> str:
    """What is proved, in plain words on one line of ASCII, whatever the file calls its robot's states."""
    report = report._replace(claim=_printable(report.claim))
    claim, robot, v = report.claim, report.claim.robot, report.volumes
    unit = " ".join(robot.units)

    def extent(place: str) -> str:
        triples = zip(robot.states, report.axes[place], robot.units, strict=True)
        return f"{place} " + ", ".join(f"{state} +-{value:.3g} {unit}" for state, value, unit in triples)

    limits = [(s, b, u) for s, b, u in zip(robot.states, claim.bounds, robot.units, strict=True) if b is not None]
    bounds = " and ".join(
        [
            *(f"|{state}| <= {float(bound):.6g} {unit}" for state, bound, unit in limits),
            *(_outside(each, robot.states) for each in claim.keep_out),
        ]
    )
    least, largest = (f"{float(limit):.6g}" for limit in claim.limits)
    limit = (
        f"{largest} {robot.input_unit}" if least == largest else f"a limit in [{least}, {largest}] {robot.input_unit}"
    )
    on = "at the center of its robot's funnel" if claim.shifts else "on the nominal motion"
    push = (
        f" A state {on} that an impulse of up to {float(claim.push):.6g} {robot.input_unit} s on the "
        f"motor hits, once and at any instant of [{report.start:.6g} s, {report.end:.6g} s], stays in the funnel."
        if claim.push
        else ""
    )
    funnel = "the funnel of its robot, all of one size, each about its own center," if claim.shifts else "the funnel"
    last, region, levels = "goal", "goal region", f" and {report.shells} of level"
    if claim.catch is not None:
        last, region, levels = "catch", "catch set", ""
    return (
        f"PROVED in continuous time, by exact arithmetic, for {_robots(claim)} under the claimed controller, whose "
        f"input never exceeds {limit}{_acts(claim)}: every motion that is in {funnel} at some time of "
        f"[{report.start:.6g} s, {report.end:.6g} s] stays in it{_end(report)}; "
        f"{bounds or 'there is no limit on a state'} all the while.{push} Half widths: {extent('inlet')}; "
        f"{extent('outlet')}; {extent(last)}. Volumes (proved) [{unit}]: inlet {v['inlet']:.6g}, sum over the knots "
        f"{v['sum']:.6g}, integral over time {v['integral']:.6g} s, {region} {v[last]:.6g}. {report.intervals} "
        f"intervals of time{levels}, smallest margin {report.margin:.2g}. It is a statement about "
        f"{_reservation(claim)}, not about hardware. Claim: sha256 {report.digest}."
    )


def _end(report: Report) -> str:
    """What becomes of a motion at t_N and later."""
    claim, end = report.claim, f"{report.end:.6g} s"
    if claim.catch is not None:
        if claim.catch.reset is None:
            return f" until {end}, where it is in the catch set"
        return f" until {end}, where the claimed reset leads it into the catch set"
    comes = (
        f"comes and stays within {_widths(report)} of the goal"
        if claim.moves_the_goal
        else f"converges to within {max(report.rest):.1g} of the goal in every state"
    )
    return f", is in the goal region at {end}, never leaves that region, and {comes}"


def _outside(each: HalfSpace | Ellipsoid, states: Sequence[str]) -> str:
    """That a state is not in a set, as an inequality."""
    if isinstance(each, HalfSpace):
        terms = [f"{rounded(a):.6g} {state}" for a, state in zip(each.normal, states, strict=True) if a != 0]
        return f"{' + '.join(terms)} <= {rounded(each.offset):.6g}"
    parts = zip(states, each.center, each.semi_axes, strict=True)
    terms = [f"(({state} - {rounded(c):.6g}) / {rounded(a):.6g})^2" for state, c, a in parts if a is not None]
    return f"{' + '.join(terms)} >= 1"


def _printable(claim: Claim) -> Claim:
    """The same claim with a robot whose texts a terminal only shows."""
    name, states, units, input_unit = claim.robot[:4]
    texts = printable(name), tuple(map(printable, states)), tuple(map(printable, units)), printable(input_unit)
    return claim._replace(equations=claim.equations._replace(robot=Robot(*texts, *claim.robot[4:])))


def _robots(claim: Claim) -> str:
    """The model or models, with their numbers."""
    texts = []
    for name, (low, high) in claim.parameters.items():
        a, b = f"{rounded(low):.6g}", f"{rounded(high):.6g}"
        texts.append(f"{printable(name)} = {a}" if low == high else f"{printable(name)} in [{a}, {b}]")
    name, numbers = claim.robot.name, ", ".join(texts)
    if not claim.uncertain:
        return f"the model {name!r} ({numbers}; SI units)"
    in_time = "constant" if claim.constant else "constant or varying"
    return f"every robot {name!r} with {numbers} (SI units; {in_time} in time)"


def _acts(claim: Claim) -> str:
    """What else acts on the loop, each with its bound."""
    robot, acts = claim.robot, []
    if claim.disturbance:
        acts.append(
            f"every disturbance |w(t)| <= {float(claim.disturbance):.6g} {robot.input_unit} on top of the motor"
        )
    errors = [
        f"{state} +-{float(error):.3g} {unit}"
        for state, error, unit in zip(robot.states, claim.noise, robot.units, strict=True)
        if error
    ]
    if errors:
        acts.append(f"every error of the measured state within {', '.join(errors)}")
    if claim.age:
        acts.append(
            f"feedback whose state was measured at most {float(claim.age):.6g} s ago, under the controller in charge "
            "and not before the motion began"
        )
    return "".join(f", for {act}" for act in acts)


def _widths(report: Report) -> str:
    robot = report.claim.robot
    triples = zip(robot.states, report.rest, robot.units, strict=True)
    return ", ".join(f"{state} +-{rest:.3g} {unit}" for state, rest, unit in triples)


def _reservation(claim: Claim) -> str:
    known = "known up to these errors" if any(claim.noise) else "known exactly"
    sampled = "its feed-forward in time" if claim.age else "its input applied without sampling"
    model = "these models, their" if claim.uncertain else "this model, its"
    return f"{model} state {known} and {sampled}"


def check_file(path: Path, progress: Callable[[int, int], None] = lambda done, of: None) -> Report:
    """`check` of a file.

    Raises:
        Refused, Undecided: as `check`.
        OSError: the file cannot be read.
    """
    return check(parse(read_bytes(path)), progress)
