"""x, u -> x' of a robot that is not the nominal one: by what V grows fastest, or as drawn for a held-out sample.

Within the half widths of `uncertainty` the robot's numbers, the motor's limit, a disturbance w on the motor's axis, the
error of the measured state, and its age are anyone's choice. All that acts through the motor is one interval of inputs
[low, high] about u = clip(u*(t) - K(t) (x - x*(t))):

    measured a seconds ago:  u + [0, a] K (x' - x*')          (first order: hold, delay, or both together)
    read falsely:            u -+ sum_i |K_i| noise_i
    another limit F -+ dF:   clip to both
    disturbance:             u -+ w

`Worst` takes, at every Runge-Kutta stage, that end of the interval and that corner of the parameters which raise
V = e'S(t)e fastest: the signs of dV'/du and of dV'/dp. One reverse sweep of x' finds them, through the few numbers that
it needs of a robot (`Plant.lumped`); these are computed at the corners once, and a state picks among them. This is
greedy, and of first order in the parameters: the held-out samples are those of `Drawn` robots, which are what epsilon
is about.

Where the parameters are constant in time (`uncertainty.center: moving`), V is about the robot's own motion instead of
x*(t), its numbers are given, and the adversary has all the rest.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar, cast, final

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from rtcd_jax.numerics.entries import dependent
from rtcd_jax.numerics.integrate import split
from rtcd_jax.plants.base import Plant
from rtcd_jax.types import Uncertainty

RobotRate = Callable[[Plant, eqx.Module, Array, Array], Array]
"""plant, design, x [n ...], u [m ...] -> x' [n ...]; the numbers of both are broadcast to the states' trailing axes."""


def closed_form_rate(plant: Plant, design: eqx.Module, x: Array, u: Array) -> Array:
    """The plant's own equations."""
    return plant.dynamics(design, x, u)


class Situation(NamedTuple):
    """A state of the closed loop as the controller and V see it; all share the states' trailing axes.

    `asked` is u* - K e before it is clipped, `nominal_rate` [n ...] the rate of x*(t), `cost` [n n ...] is S(t); these
    two are None where nobody asks. V is about x*(t), or by `shift` [n ...] beside it.
    """

    x: tuple[Array, ...]
    error: list[Array]
    asked: Float[Array, "m *batch"]
    gain: Float[Array, "m n *#batch"]
    cost: Any
    nominal_rate: Any
    bounds: Float[Array, "m *#batch"]
    shift: Any = None

    def late(self, plant: Plant, design: eqx.Module, scales: "Scales") -> Float[Array, "m *batch"]:
        """By how much the scaled robot's input rises for each second of the measurement's age."""
        clipped = jnp.clip(self.asked, -self.bounds, self.bounds)
        rates = plant.rates(scaled_numbers(plant, design, scales), self.x, clipped)
        return _times(self.gain, [a - b for a, b in zip(rates, self.nominal_rate, strict=True)])


Scales = Mapping[str, Float[Array, "*#batch"]]
"""Factors of design fields and constants of the robot, by their names."""


@final
class Constant(NamedTuple):
    """The robot whose numbers are scaled, and nothing else that is uncertain."""

    plant: Plant
    scales: Scales

    def rate(self, design: eqx.Module, at: Situation) -> tuple[Array, ...]:
        """The components of x'."""
        u = jnp.clip(at.asked, -at.bounds, at.bounds)
        return split(scaled_rate(self.plant, design, self.scales, jnp.stack(at.x), u))


@final
class Worst(NamedTuple):
    """The adversary: V grows as fast as `uncertainty` allows, for the robot whose numbers are scaled."""

    plant: Plant
    uncertainty: Uncertainty
    scales: Scales = MappingProxyType({})

    def of_robot(self, scales: Scales) -> "Worst":
        """The adversary of one robot of the box, whose numbers are constant."""
        others = eqx.tree_at(lambda may: may.parameters, self.uncertainty, {})
        return self._replace(uncertainty=others, scales=scales)

    def rate(self, design: eqx.Module, at: Situation) -> tuple[Array, ...]:
        """The components of x'."""
        may, low, high = self.uncertainty, at.asked, at.asked
        if may.age is not None:
            late = may.age * at.late(self.plant, design, self.scales)
            low, high = low + jnp.minimum(late, 0), high + jnp.maximum(late, 0)
        if may.noise is not None:
            spread = _times(jnp.abs(at.gain), may.noise)
            low, high = low - spread, high + spread
        weak, strong = at.bounds * (1 - may.input_limit), at.bounds * (1 + may.input_limit)
        low, high = jnp.clip(low, -strong, weak) - may.input, jnp.clip(high, -weak, strong) + may.input
        error = at.error if at.shift is None else [e - s for e, s in zip(at.error, at.shift, strict=True)]
        slope_of_v = [sum(each * e for each, e in zip(row, error, strict=True)) for row in at.cost]

        def numbers(factors: Sequence) -> PyTree:
            scales = dict(zip(may.parameters, factors, strict=True))
            return scaled_numbers(self.plant, design, {**self.scales, **scales})

        def power(values, u):
            rates = self.plant.rates(jax.tree.unflatten(structure, values), at.x, u)
            return jnp.sum(sum(slope * rate for slope, rate in zip(slope_of_v, rates, strict=True)))

        nominal, structure = jax.tree.flatten(numbers([1.0] * len(may.parameters)))
        everywhere = [jnp.broadcast_to(value, at.x[0].shape) for value in nominal]
        slopes, push = jax.grad(power, argnums=(0, 1))(everywhere, (low + high) / 2)
        worst = _corner(lambda factors: jax.tree.leaves(numbers(factors)), list(may.parameters.values()), slopes)
        return self.plant.rates(jax.tree.unflatten(structure, worst), at.x, jnp.where(push > 0, high, low))


@final
class Drawn(NamedTuple):
    """Robots and disturbances of held-out samples [S], in half widths: within [-1, 1], `age` in [0, 1].

    Half of the robots sit at a corner of the box, the others are uniform in it. `steady` keeps w and the noise of the
    measurement for the whole motion; the others' jump at every knot.
    """

    plant: Plant
    uncertainty: Uncertainty
    parameters: dict[str, Float[Array, " S"]]
    input_limit: Float[Array, " S"]
    age: Float[Array, " S"]
    input: Float[Array, "m S"]
    noise: Float[Array, "n S"]
    steady: Float[Array, " S"]
    key: PRNGKeyArray
    motion: RobotRate = closed_form_rate
    """Whose equations of motion."""

    @classmethod
    def of(cls, plant: Plant, uncertainty: Uncertainty, key: PRNGKeyArray, samples: int) -> "Drawn":
        corner, steady, *keys = jax.random.split(key, 8)
        at_corner = jax.random.bernoulli(corner, 0.5, (samples,))

        def within(key, *shape):
            inside = jax.random.uniform(key, (*shape, samples), minval=-1.0)
            return jnp.where(at_corner, jnp.sign(inside), inside)

        parameters = within(keys[0], len(uncertainty.parameters))
        return cls(
            plant,
            uncertainty,
            dict(zip(uncertainty.parameters, parameters, strict=True)),
            input_limit=within(keys[1]),
            age=jnp.abs(within(keys[2])),
            input=within(keys[3], plant.m),
            noise=within(keys[4], plant.n),
            steady=jax.random.bernoulli(steady, 0.5, (samples,)),
            key=keys[5],
        )

    def at_knot(self, k: Int[Array, ""]) -> "Drawn":
        """With the signs of w and of the noise that hold from knot k on."""
        m, n = self.plant.m, self.plant.n
        signs = jax.random.rademacher(jax.random.fold_in(self.key, k), (m + n, self.steady.shape[0]), self.age.dtype)
        signs = jnp.where(self.steady, 1, signs)
        return self._replace(input=self.input * signs[:m], noise=self.noise * signs[m:])

    def rate(self, design: eqx.Module, at: Situation) -> tuple[Array, ...]:
        """The components of x'."""
        may, x, asked = self.uncertainty, jnp.stack(at.x), at.asked
        if may.age is not None:
            asked = asked + may.age * self.age * at.late(self.plant, design, self.scales if may.moving else {})
        if may.noise is not None:
            asked = asked - _times(at.gain, may.noise[:, None] * self.noise)
        bounds = at.bounds * (1 + may.input_limit * self.input_limit)
        u = jnp.clip(asked, -bounds, bounds) + may.input * self.input.reshape(-1, *(1,) * (x.ndim - 2), x.shape[-1])
        return split(scaled_rate(self.plant, design, self.scales, x, u, self.motion))

    @property
    def scales(self) -> dict[str, Float[Array, " S"]]:
        """Of every robot's numbers."""
        return {name: 1 + width * self.parameters[name] for name, width in self.uncertainty.parameters.items()}


Opponent = Worst | Drawn | Constant

Part = TypeVar("Part", bound=eqx.Module)


def scaled_rate(
    plant: Plant,
    design: eqx.Module,
    scales: Scales,
    x: Float[Array, "n *batch"],
    u: Float[Array, "m *batch"],
    motion: RobotRate = closed_form_rate,
) -> Float[Array, "n *batch"]:
    """x' of the robot whose design fields and constants of these names are scaled."""
    return motion(*_scaled_robot(plant, design, scales), x, u)


def scaled_numbers(plant: Plant, design: eqx.Module, scales: Scales) -> PyTree:
    """What `plant.rates` needs of the robot whose design fields and constants of these names are scaled."""
    plant, design = _scaled_robot(plant, design, scales)
    return plant.lumped(design)


def _scaled_robot(plant: Plant, design: eqx.Module, scales: Scales) -> tuple[Plant, eqx.Module]:
    in_design = {name: scale for name, scale in scales.items() if hasattr(design, name)}
    in_plant = {name: scale for name, scale in scales.items() if name not in in_design}
    return _scaled(plant, in_plant), _scaled(design, in_design)


def _scaled(part: Part, scales: dict[str, Any]) -> Part:
    if not scales:
        return part
    values = [getattr(part, name) * scale for name, scale in scales.items()]
    return eqx.tree_at(lambda part: [getattr(part, name) for name in scales], part, values)


def _corner(numbers: Callable[[Sequence], list], widths: Sequence[Array], slopes: Sequence[Array]) -> list[Array]:
    """The numbers at that corner of the box of factors 1 -+ widths where slopes . numbers is largest, to first order.

    `numbers(factors)` are scalars, the slopes are of many states. A number is computed once at every corner of the
    factors on which it depends, and picked for each state.
    """
    one, count = jnp.ones(()), len(widths)

    def along(i: int, factor: Array) -> list:
        return numbers([factor if i == j else 1.0 for j in range(count)])

    depends = [dependent(partial(along, i), one) for i in range(count)]
    raised = []
    for i in range(count):
        _, rates = jax.jvp(partial(along, i), (one,), (one,))
        terms = zip(slopes, rates, depends[i], strict=True)
        raised.append(sum(slope * rate for slope, rate, present in terms if present) > 0)

    @cache
    def at(*signs: int) -> list:
        return numbers([1 + sign * width for sign, width in zip(signs, widths, strict=True)])

    def picked(k: int, *signs: int) -> Array:
        """The k-th number, the signs of the first parameters being these."""
        i = len(signs)
        if i == count:
            return at(*signs)[k]
        if not depends[i][k]:
            return picked(k, *signs, 0)
        return jnp.where(raised[i], picked(k, *signs, 1), picked(k, *signs, -1))

    return [picked(k) for k in range(len(slopes))]


def _times(matrix, vector) -> Array:
    """Product elementwise over all axes behind the first two."""
    return cast(Array, sum(matrix[:, i] * component for i, component in enumerate(vector)))
