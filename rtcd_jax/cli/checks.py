"""What several commands ask of their options alike."""

from pathlib import Path
from typing import Any

import tyro

from rtcd_jax.system.errors import UserError


def optional(metavar: str, meaning: str, otherwise: str) -> Any:
    """An option that may be left away, and what holds then, in place of tyro's `{None}|KIND (default: None)`."""
    return tyro.conf.arg(metavar=metavar, help=meaning, help_behavior_hint=f"(default: {otherwise})")


def require_at_least(options: Any, **least: int) -> None:
    """Raises `UserError` for the first of the named options that is given and below its bound."""
    for name, bound in least.items():
        value = getattr(options, name)
        if value is not None and value < bound:
            raise UserError(f"--{name} = {value}: must be >= {bound}")


def require_elite(elite: int | str) -> None:
    """Raises `UserError` for a number that no elite can have."""
    if isinstance(elite, int) and elite < 0:
        raise UserError(f"--elite = {elite}: must be >= 0, or initial")


def require_run(folder: Path, usage: str) -> None:
    """Raises `UserError` if there is no such folder; `usage` is the command that makes one."""
    if folder.is_file():
        raise UserError(f"{folder} is a file: must be a run folder, as `{usage}` makes one")
    if not folder.is_dir():
        raise UserError(f"{folder}: no such run folder; `{usage}` makes one")
