"""The reference of the configuration is up to date and lacks no key that a configuration can have."""

import re

import pytest

from rtcd_jax.cli.config_page import reference
from rtcd_jax.config.load import load, resolved
from rtcd_jax.config.plants import PLANTS
from tests.paths import ROOT

ROW = re.compile(r"\| `(\S+)` \| (.*?) \| (.*?) \| (.*?) \| (.+) \|$", re.MULTILINE)


def rows():
    """Unit, default, range and meaning by key; those of all robots together."""
    return {key: cells for key, *cells in ROW.findall(reference())}


def test_the_page_is_up_to_date():
    page = ROOT / "docs" / "config.md"
    assert page.read_text() == reference(), "write it again: python -m rtcd_jax.cli.config_page docs/config.md"


# One with a sweep is several configurations.
CONFIGS = [path for path in sorted((ROOT / "configs").glob("*.yaml")) if "\nsweep:" not in path.read_text()]


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_key_of_every_configuration_is_there(path):
    def leaves(tree, prefix=""):
        for name, branch in tree.items():
            variable = isinstance(branch, dict) and "initial" in branch
            if isinstance(branch, dict) and not variable:
                yield from leaves(branch, f"{prefix}{name}.")
            else:
                yield f"{prefix}{name}"

    def row(key):
        """Numbers by the names of a robot's parameters share a row, and so do all tasks."""
        key = re.sub(r"^tasks\.\w+\.(\w+).*", r"tasks.NAME.\1", key)
        parent = key.rpartition(".")[0]
        return parent if parent in ("uncertainty.design", "uncertainty.plant", "search.at_least") else key

    assert set(map(row, leaves(resolved(load(path))))) <= rows().keys()


ROBOTS_OWN = {f"plant.{key}" for key in ("name", "mjcf", "xml", "python", "constants", "inputs", "set")}
"""Texts, and mappings of a robot of one's own."""


def test_numbers_have_units_and_names_have_their_choices():
    for key, (unit, default, limits, meaning) in rows().items():
        named = default in ("true", "false") or "," in limits
        assert named or unit or key in ROBOTS_OWN, key
        assert meaning
    told = rows()
    assert told["search.objective"][2] == r"sum, integral, inlet, geometric\_mean, push, goal, dirtrel"
    assert told["search.population"][:3] == ["-", "128", ">= 4 and <= 1048576"]
    assert told["policy.authority"][:3] == ["-", "1.0", ">= 1e-06 and <= 1"]
    assert "or a variable" in told["policy.authority"][3]
    assert told["plant.force_limit"][:1] == ["N"]


def test_every_robot_has_its_tables():
    page = reference()
    for name, model in PLANTS.items():
        assert page.count(f"### {name}\n") == 2
        assert all(f"`design.{key}` | {unit} |" in page for key, unit in model().design.items())
