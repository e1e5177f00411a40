"""Robots by name. A new one is a file, an MJCF beside it, and a line here."""

from rtcd_jax.plants.base import Plant
from rtcd_jax.plants.cartpole import Cartpole
from rtcd_jax.plants.pendulum import Pendulum
from rtcd_jax.system.errors import UserError, closest

PLANTS: dict[str, type[Plant]] = {"pendulum": Pendulum, "cartpole": Cartpole}


def plant_class(name: str) -> type[Plant]:
    """The robot called `name`.

    Raises:
        UserError: no robot has this name.
    """
    if name not in PLANTS:
        raise UserError(f"no plant is called {name!r}; {closest(name, tuple(PLANTS))}")
    return PLANTS[name]
