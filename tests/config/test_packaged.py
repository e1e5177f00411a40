"""A packaged configuration's name stands for its file, and only where no such file is there."""

from pathlib import Path

import pytest

from rtcd_jax.config.load import load
from rtcd_jax.config.packaged import config_path, listing, packaged
from rtcd_jax.system.errors import ConfigError
from tests.paths import CONFIGS


def test_every_configuration_has_a_name_and_says_what_it_is():
    assert list(packaged().values()) == sorted(CONFIGS.glob("*.yaml"))
    for name, line in listing():
        assert line.endswith("."), f"the first line of {name}.yaml is no sentence"


def test_a_file_of_ones_own_comes_first(tmp_path, monkeypatch):
    assert load(config_path(Path("smoke"))) == load(CONFIGS / "smoke.yaml")
    monkeypatch.chdir(tmp_path)
    Path("smoke").write_text("")
    assert config_path(Path("smoke")) == Path("smoke")


@pytest.mark.parametrize("path", ["missing.yaml", "a/smoke", "./x/missing"])
def test_paths_are_no_names(path):
    assert config_path(Path(path)) == Path(path)


def test_a_misspelt_name_is_told_the_one_that_was_meant():
    with pytest.raises(ConfigError, match=r"^smok: no such file .*; did you mean 'smoke'\? Valid: acrobot, "):
        config_path(Path("smok"))
