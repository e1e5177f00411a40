"""What a robot must say. All else (linearisation, rollouts, volumes) is derived from this."""

import abc
from pathlib import Path
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float


class Plant(eqx.Module):
    """A robot: its physical constants are the fields, its design is a pytree of its own named fields.

    Subclasses are final. `dynamics` is closed-form and smooth in all arguments: it is differentiated
    twice by the trajectory optimiser and evaluated millions of times by the funnel.
    """

    state_names: ClassVar[tuple[str, ...]]
    state_units: ClassVar[tuple[str, ...]]
    input_names: ClassVar[tuple[str, ...]]
    input_units: ClassVar[tuple[str, ...]]
    design_units: ClassVar[dict[str, str]]
    Design: ClassVar[type[eqx.Module]]
    mjcf: ClassVar[Path]

    @property
    def n(self) -> int:
        return len(self.state_names)

    @property
    def m(self) -> int:
        return len(self.input_names)

    @property
    @abc.abstractmethod
    def input_limit(self) -> tuple[float, ...]:
        """Largest |u_i| of every input, in `input_units`."""

    @abc.abstractmethod
    def dynamics(self, design, x: Float[Array, " n"], u: Float[Array, " m"]) -> Float[Array, " n"]:
        """State derivative in SI units per second. `design` may carry any broadcastable leaves."""

    @abc.abstractmethod
    def energy(self, design, x: Float[Array, " n"]) -> Float[Array, ""]:
        """Mechanical energy [J]; for u = 0 its rate is the power lost in the dampers."""

    @abc.abstractmethod
    def parameters(self, design) -> dict[str, float]:
        """Every physical number of this robot by name, design included, in SI units."""

    @abc.abstractmethod
    def edit_model(self, model, design) -> dict[str, Float[Array, " ..."]]:
        """Leaves of the compiled MuJoCo model that `design` and the constants replace, by attribute name.

        `model` (an mjModel or mjx.Model) gives the leaves' current values; only leaves in which a
        recompiled model would differ while contacts and joint limits are off may be named.
        """
