"""The catch of a brachiator of two arms in a plane: the free hook takes the next bar, and the other one lets go.

    q+ = (q1 + q2 - pi, -q2),        M+(q+) v+ = X(q) v-

The arms change places: the joints count from the new bar. The impact is plastic: what the new bar exerts goes through
its axis, so that of the links' momentum as much is kept as motions about that axis (J+, w+) see of it,
X = sum_i m_i J+_i' J-_i + I_i w+_i' w-_i; M+ is the same sum with J+ and w+ alone, the mass matrix of the robot that
hangs from the new bar. Angles are not wrapped.
"""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from rtcd_jax.numerics.trigonometry import cos, sin

FIELDS = (
    "arm_length", "support_mass", "support_center", "support_inertia", "swing_mass", "swing_center", "swing_inertia",
)  # fmt: skip
"""Of a robot that can brachiate: the length of both arms, and of each mass, center (from its joint), and inertia."""

PAIRS = (("support_mass", "swing_mass"), ("support_inertia", "swing_inertia"))
"""Of the `FIELDS`, those that change places as they are."""

Numbers = Mapping[str, Any]
"""Of a robot, constants and design, by name."""


def exchanged(numbers: Numbers) -> dict[str, Any]:
    """Those of the `FIELDS` as the robot hangs from its other hook: the arms change places; the inverse of itself."""
    arm, m1, c1, i1, m2, c2, i2 = (numbers[name] for name in FIELDS)
    return dict(zip(FIELDS, (arm, m2, arm - c2, i2, m1, arm - c1, i1), strict=True))


def hook(numbers: Numbers, x: Float[Array, "4 *batch"]) -> Float[Array, "2 *batch"]:
    """Where the free hook is, from the bar that the robot hangs from, forward and up [m], elementwise."""
    arm, first, second = numbers["arm_length"], x[0], x[0] + x[1]
    return jnp.stack([arm * (sin(first) + sin(second)), -arm * (cos(first) + cos(second))])


def catch(numbers: Numbers, x: Float[Array, "4 *batch"]) -> Float[Array, "4 *batch"]:
    """x+ of the `exchanged` robot after the catch at x, elementwise; positions [rad], velocities [rad/s]."""
    arm, m1, c1, i1, m2, c2, i2 = (numbers[name] for name in FIELDS)
    q1, q2, v1, v2 = x
    bend = cos(q2)
    first, second = v1, v1 + v2  # absolute rates of the arms; those after the catch are of the same two, second first
    second_momentum = -(arm - c2) * m2 * (arm * bend * first + c2 * second) - arm * m1 * c1 * bend * first + i2 * second
    first_momentum = (i1 - (arm - c1) * m1 * c1) * first
    m11 = m2 * (arm - c2) ** 2 + m1 * arm**2 + i2
    m12 = m1 * arm * (arm - c1) * bend
    m22 = m1 * (arm - c1) ** 2 + i1
    determinant = m11 * m22 - m12**2
    second_after = (m22 * second_momentum - m12 * first_momentum) / determinant
    first_after = (m11 * first_momentum - m12 * second_momentum) / determinant
    return jnp.stack([q1 + q2 - jnp.pi, -q2, second_after, first_after - second_after])
