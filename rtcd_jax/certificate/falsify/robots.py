"""The robots of a certificate's box and what acts on them, drawn for simulation; their equations are written apart.

M v' = motor (u + w) - damping v - dU/dq - c, c = (dM/dt) v - d(v'M v / 2)/dq, solved motion by motion.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rtcd_jax.certificate.check import HINGE, Claim, Function, Reset, Robot
from rtcd_jax.certificate.check.matrix import dot

CORNERS = 0.5
"""Share of the robots that sit at a corner of the box; the others are uniform in it."""
LEAST_LIMIT = 1e-9
"""Of a motor whose limit is drawn beyond the claim's box [share of the claim's]."""


class Drawn(NamedTuple):
    """Of every motion: its robot's numbers, its motor's limit, the largest |w| and share of the feedback's errors.

    The `greedy` ones choose signs by which |y| grows fastest, the others at random.
    """

    numbers: dict[str, Float[np.ndarray, " M"]]
    limit: Float[np.ndarray, " M"]
    disturbance: Float[np.ndarray, " M"]
    errors: Float[np.ndarray, " M"]
    greedy: Float[np.ndarray, " M"]

    def part(self, who) -> "Drawn":
        return Drawn({name: value[who] for name, value in self.numbers.items()}, *(each[who] for each in self[1:]))


def draw(claim: Claim, count: int, beyond: float, random: np.random.Generator) -> Drawn:
    """Robots of the claim's box, its half widths and all that acts `beyond` times as large."""
    corner = random.uniform(size=count) < CORNERS

    def within(low: float, high: float) -> np.ndarray:
        place = random.uniform(-1, 1, count) if high > low else np.zeros(count)
        place = np.where(corner, np.sign(place), place)
        return np.clip(
            (low + high) / 2 + beyond * (high - low) / 2 * place, *((low, high) if beyond == 1 else (None, None))
        )

    numbers = {name: within(float(low), float(high)) for name, (low, high) in claim.parameters.items()}
    limit = within(*map(float, claim.limits))
    return Drawn(
        numbers,
        np.maximum(limit, LEAST_LIMIT * float(claim.limits[1])),
        np.full(count, beyond * float(claim.disturbance)),
        np.full(count, beyond),
        (random.uniform(size=count) < CORNERS).astype(float),
    )


def rate(
    robot: Robot, drawn: Drawn, x: Float[np.ndarray, "n M"], u: Float[np.ndarray, " M"]
) -> Float[np.ndarray, "n M"]:
    """x' of every motion's own robot."""
    joints = len(robot.joints)
    q, v = x[:joints], x[joints:]

    def value(function: Function, by: int | None = None) -> np.ndarray:
        return _value(robot, function, drawn.numbers, q, by)

    def entry(i: int, j: int, by: int | None = None) -> np.ndarray:
        return value(robot.mass[max(i, j)][min(i, j)], by)

    every = range(joints)
    force = []
    for i in every:
        total = value(robot.motor[i]) * u - value(robot.damping[i]) * v[i] - value(robot.potential, i)
        for j in every:
            for k in every:
                slope = entry(i, j, k) - entry(j, k, i) / 2
                total = total - slope * v[j] * v[k]
        force.append(total)
    mass = [[entry(i, j) for j in every] for i in every]
    return np.concatenate([v, _solved(mass, force)])


def after_reset(robot: Robot, reset: Reset, drawn: Drawn, x: Float[np.ndarray, "n M"]) -> Float[np.ndarray, "n M"]:
    """What the reset makes of every motion's state."""
    every = range(len(robot.joints))
    q, v = x[: len(every)], x[len(every) :]
    after = np.array(reset.positions) @ q + np.pi * np.array(reset.turns)[:, None]
    numbers = {
        name: drawn.numbers[a] if isinstance(a, str) else np.full(x.shape[1], float(a))
        for name, a in reset.numbers.items()
    }
    mass = [[_value(robot, robot.mass[max(i, j)][min(i, j)], numbers, after) for j in every] for i in every]
    momentum = [dot([_value(robot, entry, drawn.numbers, q) for entry in row], v) for row in reset.momentum]
    return np.concatenate([after, _solved(mass, momentum)])


def _value(robot: Robot, function: Function, numbers: dict, q: np.ndarray, by: int | None = None) -> np.ndarray:
    """Of a function of the positions q [joints M], or of its derivative by one of them."""
    total = zero = np.zeros(q.shape[1])
    for term in function:
        factor = np.prod([numbers[name] ** power for name, power in term.powers], axis=0)
        angle = sum((k * q[i] for i, k in enumerate(term.joints) if robot.joints[i] == HINGE), zero)
        sine, cosine, a, b = np.sin(angle), np.cos(angle), float(term.cosine), float(term.sine)
        turned, slides = a * cosine + b * sine, [
            (i, e) for i, e in enumerate(term.joints) if robot.joints[i] != HINGE and e
        ]  # fmt: skip
        if by is not None and robot.joints[by] == HINGE:
            turned = term.joints[by] * (b * cosine - a * sine)
        for i, e in slides:
            turned = turned * (q[i] ** e if i != by else e * q[i] ** (e - 1))
        if by is not None and robot.joints[by] != HINGE and not term.joints[by]:
            continue
        total = total + factor * turned
    return total


def _solved(mass: list[list[np.ndarray]], right: list[np.ndarray]) -> np.ndarray:
    """M^-1 b [joints M], motion by motion."""
    if len(mass) == 1:
        return (right[0] / mass[0][0])[None]
    return np.linalg.solve(np.moveaxis(np.array(mass), 2, 0), np.array(right).T[..., None])[..., 0].T
