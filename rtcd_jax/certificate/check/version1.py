"""The two robots that a file of version 1 names, in the words of version 2."""

from typing import NamedTuple

from rtcd_jax.certificate.check.exact import Q
from rtcd_jax.certificate.check.robot import HINGE, SLIDE, Function, Robot, Term


class Plant(NamedTuple):
    """A robot and its numbers, of which `limit` is the input's; the others' signs are those of `at_least_zero`."""

    robot: Robot
    parameters: tuple[str, ...]
    limit: str
    at_least_zero: tuple[str, ...]


def _term(joints: tuple[int, ...], powers: str, cosine: int = 1) -> Term:
    """A cosine's term; `powers` names a number as often as its power."""
    names = powers.split()
    return Term(joints, tuple((name, names.count(name)) for name in dict.fromkeys(names)), Q(cosine), Q(0))


def _number(joints: int, powers: str) -> Function:
    return (_term((0,) * joints, powers),)


_NONE: Function = ()

PENDULUM = Robot(
    name="pendulum",
    states=("theta", "theta_dot"),
    units=("rad", "rad/s"),
    input_unit="N m",
    joints=(HINGE,),
    mass=((_number(1, "m l l"),),),
    potential=(_term((1,), "m g l", -1),),
    damping=(_number(1, "b"),),
    motor=(_number(1, ""),),
)
"""Hanging at 0."""

CARTPOLE = Robot(
    name="cartpole",
    states=("cart", "theta", "cart_dot", "theta_dot"),
    units=("m", "rad", "m/s", "rad/s"),
    input_unit="N",
    joints=(SLIDE, HINGE),
    mass=(
        (_number(2, "Mc") + _number(2, "Mp"),),
        ((_term((0, 1), "Mp lp", -1),), _number(2, "inertia_about_com") + _number(2, "Mp lp lp")),
    ),
    potential=(_term((0, 1), "Mp lp g"),),
    damping=(_number(2, "Beq"), _number(2, "Bp")),
    motor=(_number(2, ""), _NONE),
)
"""Upright at 0."""

PLANTS = {
    "pendulum": Plant(PENDULUM, ("m", "l", "b", "g", "torque_limit"), "torque_limit", ("b",)),
    "cartpole": Plant(
        CARTPOLE, ("Mc", "Mp", "lp", "inertia_about_com", "Beq", "Bp", "g", "force_limit"), "force_limit", ("Beq", "Bp")
    ),
}
