"""The experiments that come with the package, by name."""

from collections.abc import Iterator
from pathlib import Path

from rtcd_jax.system.errors import ConfigError, Problem, closest

_PACKAGE = Path(__file__).parents[1]
FOLDER = next((path for path in (_PACKAGE / "configs", _PACKAGE.parent / "configs") if path.is_dir()), _PACKAGE)
"""A wheel has it in the package; the sources have it beside the package."""


def packaged() -> dict[str, Path]:
    """The packaged configurations by name, in alphabetical order."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.yaml"))}


def config_path(given: Path) -> Path:
    """The file that `given` names: a path, or the name of a packaged configuration where no such file is there.

    Raises:
        ConfigError: `given` is a single word, and neither; a path is left to its reader.
    """
    if given.exists() or given.suffix or len(given.parts) != 1:
        return given
    known = packaged()
    if given.name not in known:
        reason = f"no such file or packaged configuration; {closest(given.name, tuple(known))}"
        raise ConfigError([Problem((), reason)], str(given))
    return known[given.name]


def listing() -> Iterator[tuple[str, str]]:
    """Every packaged configuration's name and what the first line of its file says about it."""
    for name, path in packaged().items():
        with path.open(encoding="utf-8") as file:
            yield name, file.readline().lstrip("# ").rstrip()
