"""The catch of a brachiator in a plane: the free hook takes the next bar, and the other one lets go.

    M+ w+ = X w,   M+_ab = cos(t_a - t_b) sum_i m_i A+_ia A+_ib + [a = b] I_a,   X the same with A-_ib

of the links' angles t and rates w, counted from hanging: two arms, and a body that hangs where they meet, if there is
one. A-_ia t_a' is what the center of link i moves by t_a about the old bar, A+ the same about the new one. The impact
is plastic: what the new bar exerts goes through its axis, so that of the links' momentum as much is kept as motions
about that axis see of it; M+ is the mass matrix of the robot that hangs from the new bar. The arms change places: the
joints count from the new bar. Angles are not wrapped.
"""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rtcd_jax.numerics.batched import mv, spd_solve
from rtcd_jax.numerics.trigonometry import cos, sin

ARMS = (
    "arm_length", "support_mass", "support_center", "support_inertia", "swing_mass", "swing_center", "swing_inertia",
)  # fmt: skip
"""The length of both arms, and of each mass, center (from its joint), and inertia."""

BODY = ("body_mass", "body_center", "body_inertia")
"""Of the body between the arms: it stays what it is."""

FIELDS = {2: ARMS, 3: (*ARMS, *BODY)}
"""The numbers of a robot that can brachiate, by its joints."""

PAIRS = (("support_mass", "swing_mass"), ("support_inertia", "swing_inertia"))
"""Of the `ARMS`, those that change places as they are."""

Numbers = Mapping[str, Any]
"""Of a robot, constants and design, by name."""


def exchanged(numbers: Numbers) -> dict[str, Any]:
    """Its links as the robot hangs from its other hook: the arms change places; the inverse of itself."""
    arm, m1, c1, i1, m2, c2, i2 = (numbers[name] for name in ARMS)
    arms = dict(zip(ARMS, (arm, m2, arm - c2, i2, m1, arm - c1, i1), strict=True))
    return arms | {name: numbers[name] for name in BODY if name in numbers}


def arms_of(joints: int) -> Float[np.ndarray, "2 joints"]:
    """From the joints to the angles of both arms from hanging."""
    return np.array([[1.0, *[0.0] * (joints - 1)], [1.0] * joints])


def hook(numbers: Numbers, x: Float[Array, "n *batch"]) -> Float[Array, "2 *batch"]:
    """Where the free hook is, from the bar that the robot hangs from, forward and up [m], elementwise."""
    arm, support, swing = numbers["arm_length"], x[0], jnp.sum(x[: len(x) // 2], 0)
    return jnp.stack([arm * (sin(support) + sin(swing)), -arm * (cos(support) + cos(swing))])


def catch(numbers: Numbers, x: Float[Array, "n *batch"]) -> Float[Array, "n *batch"]:
    """x+ of the `exchanged` robot after the catch at x, elementwise; positions [rad], velocities [rad/s]."""
    joints = len(x) // 2
    arm, *links = (jnp.asarray(numbers[name]) for name in FIELDS[joints])
    support, swing, *body = jnp.stack(links).reshape(joints, 3)  # mass, center and inertia of each
    masses, centers, inertias = jnp.stack([support, *body, swing], 1)
    arms = np.array([1.0, *[0.0] * len(body), 1.0])
    hung = np.zeros((joints, joints))
    hung[1:, 0] = 1  # all but the support arm are moved by its end
    before = jnp.diag(centers) + arm * hung
    after = jnp.diag(centers - arm * arms) - arm * hung[::-1, ::-1]

    every = (..., *[None] * (x.ndim - 1))  # a number of the robot, beside the batch
    angles, rates = jnp.cumsum(x[:joints], 0), jnp.cumsum(x[joints:], 0)
    along, turning = cos(angles[:, None] - angles[None]), jnp.diag(inertias)[every]

    def momentum(moved: Float[Array, "k k"]) -> Float[Array, "k k *batch"]:
        return (after.T @ (masses[:, None] * moved))[every] * along + turning

    kept, _ = spd_solve(momentum(after), mv(momentum(before), rates)[:, None], 0.0)
    from_the_new_bar = (angles - np.pi * arms[every])[::-1], kept[::-1, 0]
    return jnp.concatenate([jnp.diff(chain, axis=0, prepend=jnp.zeros_like(chain[:1])) for chain in from_the_new_bar])
