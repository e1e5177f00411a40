"""What a robot must say. All else (linearization, rollouts, volumes) is derived from this."""

import abc
from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float, PyTree

Components = tuple[Float[Array, "*batch"], ...]
"""The rows of a state or an input, not stacked to one array: programs of single numbers keep them apart."""

ModelEdits = Mapping[str, Float[Array, "..."] | Mapping[str, Float[Array, "..."]]]


class Plant(eqx.Module):
    """A robot: its physical constants are the fields, its design is a pytree of its own named fields.

    Subclasses are final. `dynamics` is closed-form and smooth in all arguments: it is differentiated
    twice by the trajectory optimizer and evaluated millions of times by the funnel.
    """

    state_names: ClassVar[tuple[str, ...]]
    state_units: ClassVar[tuple[str, ...]]
    input_names: ClassVar[tuple[str, ...]]
    input_units: ClassVar[tuple[str, ...]]
    design_units: ClassVar[dict[str, str]]
    parameter_units: ClassVar[dict[str, str]]
    convention: ClassVar[str]
    """Where the positions are zero, and which way positions, velocities and inputs point."""
    Design: ClassVar[type[eqx.Module]]
    xml: ClassVar[str]
    """The text of its MJCF."""

    @property
    def n(self) -> int:
        return len(self.state_names)

    @property
    def m(self) -> int:
        return len(self.input_names)

    @abc.abstractmethod
    def input_limits(self, design: eqx.Module) -> tuple[float | Float[Array, "*batch"], ...]:
        """Largest |u_i| of every input, in `input_units`; floats if they do not depend on the design."""

    @abc.abstractmethod
    def dynamics(
        self, design: eqx.Module, x: Float[Array, "n *batch"] | Components, u: Float[Array, "m *batch"] | Components
    ) -> Float[Array, "n *batch"]:
        """State derivative in SI units per second; the design's leaves are broadcast to the states' trailing axes."""

    def lumped(self, design: eqx.Module) -> PyTree:
        """What `rates` needs of this robot: numbers that depend on no state."""
        return self, design

    def rates(
        self, numbers: PyTree, x: Float[Array, "n *batch"] | Components, u: Float[Array, "m *batch"] | Components
    ) -> Components:
        """The components of the state derivative, from `lumped` numbers."""
        plant, design = numbers
        return tuple(plant.dynamics(design, x, u))

    @abc.abstractmethod
    def motor_speeds(self, design: eqx.Module, x: Float[Array, "n *batch"]) -> Float[Array, "m *batch"]:
        """v with which the input u has the power u_i v_i."""

    @abc.abstractmethod
    def parameters(self, design: eqx.Module) -> dict[str, float]:
        """Every physical number of this robot by name, design included, in SI units."""

    @classmethod
    @abc.abstractmethod
    def from_parameters(cls, parameters: Mapping[str, float]) -> tuple["Plant", eqx.Module]:
        """The plant and the design whose `parameters` these are.

        Raises:
            KeyError: a parameter is missing.
        """

    @abc.abstractmethod
    def edit_model(self, design: eqx.Module) -> ModelEdits:
        """What `design` and the constants replace in the MuJoCo model that `xml` compiles to.

        Keyed by the model's attribute. The value is the whole attribute ("opt.gravity"), or its rows by the name of
        the body (`body_*`), joint (`jnt_*`, `dof_*`), motor (`actuator_*`) or geom (`geom_*`) that they belong to.
        With contacts, joint limits and all other constraints off, the edited model must move as the
        recompiled one: then derived attributes (`body_subtreemass`, `dof_invweight0`, ...) play no part.
        """
