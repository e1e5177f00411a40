"""What a certificate proves, in plain words."""

from collections.abc import Sequence

from rtcd_jax.certificate.check.claim import Claim
from rtcd_jax.certificate.check.exact import printable, rounded
from rtcd_jax.certificate.check.keep_out import Ellipsoid, HalfSpace
from rtcd_jax.certificate.check.robot import Robot
from rtcd_jax.certificate.check.verdict import Report


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
