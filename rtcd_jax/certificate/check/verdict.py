"""Every obligation of a certificate, and what follows when all of them hold."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.catch import catch_obligations
from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.exact import Damaged, Q, Undecided, require, root_up, rounded
from rtcd_jax.certificate.check.file import Goal, read_catch, read_claim, read_goal, read_interval, read_notes
from rtcd_jax.certificate.check.funnel import (
    Interval,
    funnel_obligations,
    motion,
    require_bounds,
    require_jump,
    require_kept_out,
)
from rtcd_jax.certificate.check.goal import goal_field, goal_obligations, require_arrival
from rtcd_jax.certificate.check.keep_out import half_spaces
from rtcd_jax.certificate.check.matrix import cofactors, dot
from rtcd_jax.certificate.check.node import Node, digest, parse, read_bytes
from rtcd_jax.certificate.check.push import require_push
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


def check_file(path: Path, progress: Callable[[int, int], None] = lambda done, of: None) -> Report:
    """`check` of a file.

    Raises:
        Refused, Undecided: as `check`.
        OSError: the file cannot be read.
    """
    return check(parse(read_bytes(path)), progress)
