"""The reset of a cycle inside a claim: that of `rtcd_jax.plants.brachiation`, as functions of the joints."""

from typing import Any

from rtcd_jax.certificate.check import HINGE, Function, Q, Reset, Term, rational
from rtcd_jax.certificate.prove.closed_loop import double, function_record, with_digests
from rtcd_jax.certificate.prove.robot import Polynomial, claimed_robot
from rtcd_jax.elite.elite import Elite
from rtcd_jax.plants.brachiation import FIELDS, PAIRS, exchanged
from rtcd_jax.system.errors import UserError

CHANGED = ("support_center", "swing_center")
"""What is not another number's value after the reset: each center counts from its other end."""


def reset_of(elite: Elite, ahead: Elite | None = None) -> Reset:
    """What follows an elite's motion. Its numbers are those of the elite `ahead`, or of its own robot turned around.

    Raises:
        UserError: a robot of which there is no such claim.
    """
    robot = claimed_robot(elite)
    joints = len(robot.description.joints)
    fields = FIELDS.get(joints, ())
    missing = [name for name in fields if name not in robot.names or robot.names[name] in robot.mixed]
    if not fields or missing or set(robot.description.joints) != {HINGE}:
        what = f"{missing[0]} is no number of it that proofs know" if missing else "it needs two or three hinges"
        raise UserError(f"no certificate of a reset of the {robot.description.name}: {what}")
    symbols = {name: robot.names[name] for name in fields}
    own = {name: robot.numbers[symbol] for name, symbol in symbols.items()}
    then = {symbols[name]: float(value) for name, value in exchanged(own).items()}
    then |= {} if ahead is None else claimed_robot(ahead).numbers
    numbers: dict[str, Any] = {name: name for name in robot.numbers}
    numbers |= {symbols[a]: symbols[b] for pair in PAIRS for a, b in (pair, pair[::-1])}
    numbers |= {symbols[name]: rational(then[symbols[name]]) for name in CHANGED}
    functions = momentum(joints, {name: Polynomial.number(symbol) for name, symbol in symbols.items()})
    return Reset(positions(joints), turns(joints), numbers, tuple(map(tuple, functions)))


def reset_record(reset: Reset) -> dict[str, Any]:
    """A reset as certificates write it."""
    return with_digests(
        {
            "positions": [[*row] for row in reset.positions],
            "turns": [*reset.turns],
            "numbers": {name: a if isinstance(a, str) else double(float(a)) for name, a in reset.numbers.items()},
            "momentum": [[function_record(entry) for entry in row] for row in reset.momentum],
        }
    )


def positions(joints: int) -> list[list[int]]:
    """q+ but for half turns: the last link's angle, then the differences back along the chain."""
    return [[1] * joints] + [[-int(j == joints - i) for j in range(joints)] for i in range(1, joints)]


def turns(joints: int) -> list[int]:
    """By so many half turns q+ is more: arms count from where they hang, the body does not turn over."""
    arms = [1, *[0] * (joints - 2), 1]
    return [-arms[-1]] + [arms[joints - i] - arms[joints - 1 - i] for i in range(1, joints)]


def momentum(joints: int, numbers: dict[str, Polynomial]) -> list[list[Function]]:
    """The X of v+'s M+(q+) v+ = X(q) v, both momenta about the axes of the joints after the reset.

    With link rates w = C v, and w+ = F C v+ in the order of the links, C sums and F turns the order around: X is
    (F C)' X_links C.
    """
    arm, *links = (numbers[name] for name in FIELDS[joints])
    support, swing, *body = (links[i : i + 3] for i in range(0, len(links), 3))
    chain = [support, *body, swing]
    every, last = range(joints), joints - 1
    arms = [1, *[0] * len(body), 1]

    def before(i: int, a: int) -> Polynomial | float:
        """How far the center of link i moves by the turn of link a about the old bar."""
        return chain[i][1] if i == a else arm if a == 0 and i > 0 else 0.0

    def after(i: int, a: int) -> Polynomial | float:
        """The same about the new one."""
        return chain[i][1] - arms[i] * arm if i == a else -arm if a == last and i < last else 0.0

    def of_links(a: int, b: int) -> Polynomial:
        total = Polynomial.of(chain[a][2] if a == b else 0.0)
        for i in every:
            total = total + chain[i][0] * (Polynomial.of(after(i, a)) * before(i, b))
        return total

    def entry(i: int, j: int) -> Function:
        total: dict[tuple[int, ...], Polynomial] = {}
        for a in range(joints - i):  # those with i <= last - a
            for b in range(j, joints):
                k = tuple(int(joint <= a) - int(joint <= b) for joint in every)
                k = max(k, tuple(-c for c in k))  # the cosine is even
                total[k] = total.get(k, Polynomial.of(0.0)) + of_links(a, b)
        return tuple(
            Term(k, powers, rational(c), Q(0)) for k, sums in sorted(total.items()) for powers, c in sums.terms.items()
        )

    return [[entry(i, j) for j in every] for i in every]
