"""The force-limited cart-pole: x = (cart, theta, cart_dot, theta_dot), theta = 0 upright, pi hanging.

The pole's center of mass is at (cart - lp sin theta, lp cos theta), so that a positive force on the cart turns an
upright pole to positive theta. With J = I + Mp lp^2 about the pivot, Lagrange's equations are

    (Mc + Mp) cart_ddot - Mp lp (cos theta theta_ddot - sin theta theta_dot^2) = u - Beq cart_dot
    J theta_ddot - Mp lp cos theta cart_ddot - Mp g lp sin theta               = -Bp theta_dot

The default numbers are those of Quanser's IP02 with its short pole (paper, section III).
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar, Literal, final

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from rtcd_jax.numerics.trigonometry import cos, sin
from rtcd_jax.plants.base import Components, ModelEdits, Plant
from rtcd_jax.system.errors import UserError

MEASURED_INERTIA = 0.004359984
"""I of the manufactured pole [kg m^2], whatever the design's mass and length are."""

_POLE_RADIUS = 0.006  # [m], as drawn in cartpole.xml
_AXIAL_INERTIA = 1e-6  # [kg m^2], as in cartpole.xml; about the pole's own axis, where nothing turns

Inertia = Literal["rod", "measured"]
"""Of the pole: a rod's, or the one that was measured."""


@final
class CartpoleDesign(eqx.Module):
    """pole_length [m] from the pivot to the pole's center of mass, pole_mass [kg]."""

    pole_length: Float[Array, "*batch"]
    pole_mass: Float[Array, "*batch"]


@final
class Cartpole(Plant):
    """cart_mass [kg], cart_damping [N s/m], pivot_damping [N m s/rad], gravity [m/s^2], force_limit [N].

    `inertia` says what I is about the pole's center of mass: Mp lp^2 / 3 of a uniform rod, or the measured constant.
    """

    cart_mass: float = 1.0731266
    cart_damping: float = 5.4
    pivot_damping: float = 0.0024
    gravity: float = 9.81
    force_limit: float = 6.0
    inertia: Inertia = eqx.field(default="rod", static=True)

    state_names: ClassVar = ("cart", "theta", "cart_dot", "theta_dot")
    state_units: ClassVar = ("m", "rad", "m/s", "rad/s")
    input_names: ClassVar = ("force",)
    input_units: ClassVar = ("N",)
    design_units: ClassVar = {"pole_length": "m", "pole_mass": "kg"}
    parameter_units: ClassVar = {
        "Mc": "kg", "Mp": "kg", "lp": "m", "inertia_about_com": "kg m^2", "Beq": "N s/m", "Bp": "N m s/rad",
        "g": "m/s^2", "force_limit": "N",
    }  # fmt: skip
    convention: ClassVar = (
        "cart = 0 is the middle of the rail, positive cart, cart_dot and force point along +x; theta = 0 stands "
        "upright, pi hangs; seen with the x axis to the right and z up, positive theta and theta_dot turn "
        "counterclockwise, a standing pole towards -x. Not wrapped: a full turn adds 2 pi."
    )
    Design: ClassVar = CartpoleDesign
    mjcf: ClassVar = Path(__file__).with_name("cartpole.xml")

    @property
    def input_limit(self) -> tuple[float, ...]:
        return (self.force_limit,)

    def dynamics(
        self, design: CartpoleDesign, x: Float[Array, "4 *batch"] | Components, u: Float[Array, "1 *batch"] | Components
    ) -> Float[Array, "4 *batch"]:
        moment, inertia = self._about_pivot(design)
        lever = moment / inertia
        s, c = sin(x[1]), cos(x[1])
        # Accelerations of the pole about a resting pivot, then of the cart, then of both together: one division.
        pole = lever * self.gravity * s - self.pivot_damping / inertia * x[3]
        force = u[0] - self.cart_damping * x[2] + moment * (c * pole - s * x[3] * x[3])
        cart = force / (self.cart_mass + design.pole_mass - moment * lever * (c * c))
        return jnp.stack([x[2], x[3], cart, pole + lever * (c * cart)])

    def energy(self, design: CartpoleDesign, x: Float[Array, "4 *batch"]) -> Float[Array, "*batch"]:
        moment, inertia = self._about_pivot(design)
        c = cos(x[1])
        translation = 0.5 * (self.cart_mass + design.pole_mass) * x[2] ** 2 - moment * c * x[2] * x[3]
        return translation + 0.5 * inertia * x[3] ** 2 + moment * self.gravity * (1 + c)

    def parameters(self, design: CartpoleDesign) -> dict[str, float]:
        return {
            "Mc": self.cart_mass,
            "Mp": float(design.pole_mass),
            "lp": float(design.pole_length),
            "inertia_about_com": float(self._about_center(design)),
            "Beq": self.cart_damping,
            "Bp": self.pivot_damping,
            "g": self.gravity,
            "force_limit": self.force_limit,
        }

    @classmethod
    def from_parameters(cls, parameters: Mapping[str, float]) -> tuple["Cartpole", CartpoleDesign]:
        """As the base class; UserError if the inertia is neither the rod's nor the measured one."""
        constants = (parameters[name] for name in ("Mc", "Beq", "Bp", "g", "force_limit"))
        length, mass, inertia = (parameters[name] for name in ("lp", "Mp", "inertia_about_com"))
        known: dict[Inertia, float] = {"measured": MEASURED_INERTIA, "rod": mass * length**2 / 3}
        kinds: list[Inertia] = [kind for kind, value in known.items() if math.isclose(inertia, value, rel_tol=1e-6)]
        if not kinds:
            raise UserError(f"inertia_about_com = {inertia:g}: must be one of {known} [kg m^2]")
        return cls(*constants, inertia=kinds[0]), CartpoleDesign(jnp.asarray(length), jnp.asarray(mass))

    def edit_model(self, design: CartpoleDesign) -> ModelEdits:
        center = _upward(design.pole_length)
        about_center = self._about_center(design)
        along = jnp.full_like(about_center, _AXIAL_INERTIA)
        radius = jnp.full_like(design.pole_length, _POLE_RADIUS)
        return {
            "opt.gravity": _upward(jnp.asarray(-self.gravity)),
            "body_mass": {"cart": jnp.asarray(self.cart_mass), "pole": design.pole_mass},
            "body_ipos": {"pole": center},
            "body_inertia": {"pole": jnp.stack([about_center, about_center, along])},
            "dof_damping": {"cart": jnp.asarray(self.cart_damping), "theta": jnp.asarray(self.pivot_damping)},
            "geom_pos": {"pole": center},
            "geom_size": {"pole": jnp.stack([radius, design.pole_length, 0 * radius])},
        }

    def _about_center(self, design: CartpoleDesign) -> Float[Array, "*batch"]:
        """I [kg m^2]."""
        if self.inertia == "measured":
            return jnp.full_like(design.pole_length, MEASURED_INERTIA)
        return design.pole_mass * design.pole_length**2 / 3

    def _about_pivot(self, design: CartpoleDesign) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
        """First moment Mp lp [kg m] and inertia I + Mp lp^2 [kg m^2] of the pole."""
        moment = design.pole_mass * design.pole_length
        return moment, self._about_center(design) + moment * design.pole_length


def _upward(height: Float[Array, "*batch"]) -> Float[Array, "3 *batch"]:
    return jnp.stack([jnp.zeros_like(height), jnp.zeros_like(height), height])
