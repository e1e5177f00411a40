"""What a certificate is about: robots of a box, their closed loop, and all that acts on it, in exact numbers."""

from typing import Any, NamedTuple

from rtcd_jax.certificate.check.exact import Q
from rtcd_jax.certificate.check.keep_out import Ellipsoid
from rtcd_jax.certificate.check.robot import Equations, Function, Robot
from rtcd_jax.certificate.check.taylor import Space


class Shift(NamedTuple):
    """A part of c_p - x*: a product of powers of p, by the claim's `uncertain` numbers, times the cubics with values
    `x` [N+1 n] at the knots and `rates` [N 2 n] at both ends of their intervals. p goes from -1 to 1 as its number does
    from its least to its largest value.
    """

    powers: tuple[int, ...]
    x: list
    rates: list


class Reset(NamedTuple):
    """What happens at t_N: q+ = `positions` q + pi `turns`, and M+(q+) v+ = `momentum`(q) v.

    M+ is the mass matrix of the same robot with other `numbers`, each by the name of the one whose value it takes, or
    an exact one.
    """

    positions: list[list[int]]
    turns: list[int]
    numbers: dict[str, Any]
    momentum: tuple[tuple[Function, ...], ...]


class Catch(NamedTuple):
    """Where the motion ends, at t_N: the states are in {center + axes y : |y| <= 1}, or are led there by the reset."""

    center: list
    axes: list
    reset: Reset | None


class Claim(NamedTuple):
    """The closed loops that the proof is about.

    `parameters` has the least and the largest value of each of the robot's numbers, `limits` of the motor's.
    `disturbance` bounds |w(t)|, `noise` [n] the errors of the measured state, `age` [s] how old a measurement that acts
    is, `speed` [input/s] how fast the feedback changes. Where old measurements count to first order (delay.py), `jerk`
    [input/s^2], `reaction` [1/s] and, by knot, `jumps` [input/s] bound how that changes; else `jerk` is None. A motion
    on x* survives an impulse of |J| <= `push` [input s] on the motor. No motion enters the sets of `keep_out`. With
    `shifts` the robot's numbers are constant, and each robot p has its funnel about c_p instead of x*. A motion that
    ends in a `catch` has no goal to be held at: `x_goal` and `K_goal` are empty.
    """

    equations: Equations
    parameters: dict[str, tuple[Any, Any]]
    limits: tuple[Any, Any]
    disturbance: Any
    noise: list
    age: Any
    speed: Any
    jerk: Any
    reaction: Any
    jumps: list
    bounds: list
    dt: Any
    x: list
    rates: list
    u: list
    K: list
    x_goal: list
    K_goal: list
    start: tuple[int, Any]
    push: Any
    keep_out: list = []  # noqa: RUF012 (of a tuple's field)
    shifts: tuple[Shift, ...] = ()
    catch: Catch | None = None

    @property
    def robot(self) -> Robot:
        return self.equations.robot

    @property
    def n(self) -> int:
        return len(self.robot.states)

    @property
    def ellipsoids(self) -> list[Ellipsoid]:
        """Those of the sets to keep out of."""
        return [each for each in self.keep_out if isinstance(each, Ellipsoid)]

    @property
    def uncertain(self) -> list[str]:
        """The names of the robot's uncertain numbers."""
        return sorted(name for name, (low, high) in self.parameters.items() if low < high)

    @property
    def moves_the_goal(self) -> bool:
        """Whether something acts at the goal that keeps motions from coming to rest there."""
        return self.disturbance != 0 or self.age != 0 or any(noise != 0 for noise in self.noise)

    @property
    def first_order(self) -> bool:
        """Whether old measurements count to first order."""
        return self.jerk is not None

    @property
    def constant(self) -> bool:
        """Whether the robot's numbers do not vary in time."""
        return self.first_order or bool(self.shifts)

    @property
    def cube(self) -> dict[int, tuple[Any, Any]]:
        """All instants of an interval and all robots, by the places of their variables."""
        return {i: (Q(-1), Q(1)) for i in (0, *range(self.n + 1, self.n + 1 + len(self.uncertain)))}

    def space(self, s_order: int, y_order: int, stride: int = 0) -> Space:
        return Space(self.n, s_order, y_order, len(self.uncertain), stride)

    @property
    def ranges_after(self) -> dict[str, tuple[Any, Any]]:
        """The least and the largest value of each of the robot's numbers after the reset."""
        assert self.catch is not None
        assert self.catch.reset is not None
        after = self.catch.reset.numbers
        return {name: self.parameters[a] if isinstance(a, str) else (a, a) for name, a in after.items()}

    def numbers(self, space: Space) -> dict[str, Any]:
        """The robot's numbers by name: an exact one, or all between its bounds."""
        among = {name: i for i, name in enumerate(self.uncertain)}
        return {
            name: space.between(low, high, among[name]) if name in among else low
            for name, (low, high) in self.parameters.items()
        }
