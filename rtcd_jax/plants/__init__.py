"""Robots by name. A new one is a file, an MJCF beside it, and a line here."""

import difflib

from rtcd_jax.plants.base import Plant
from rtcd_jax.plants.cartpole import Cartpole
from rtcd_jax.plants.pendulum import Pendulum

PLANTS: dict[str, type[Plant]] = {"pendulum": Pendulum, "cartpole": Cartpole}


def plant_class(name: str) -> type[Plant]:
    """The robot called `name`.

    Raises:
        ValueError: no robot has this name.
    """
    if name in PLANTS:
        return PLANTS[name]
    close = difflib.get_close_matches(name, PLANTS, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    raise ValueError(f"no plant is called {name!r}; there are {', '.join(sorted(PLANTS))}{hint}")
