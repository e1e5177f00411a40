"""A shell completes rtcd's verbs, their options and the options' values by the script that it prints."""

import shutil
import subprocess

import pytest

from rtcd_jax.cli.main import VERBS, main

TRY = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(( $# - 1 )); COMP_LINE="$*"; COMP_POINT=${#COMP_LINE}
_tyro_rtcd
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    """The script for bash, as it is printed."""
    from contextlib import redirect_stdout

    path = tmp_path_factory.mktemp("completion") / "rtcd"
    with path.open("w") as file, redirect_stdout(file):
        assert main(["completion", "bash"]) == 0
    return path


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    ("words", "completed"),
    [
        (["op"], {"optimize"}),
        ([""], {"-h", "--help", *VERBS}),
        (["report", "--ta"], {"--table"}),
        (["report", "--table", ""], {"latex", "csv", "md", "None"}),
        (["optimize", "pendulum_rtcd", "--search.pop"], {"--search.population"}),
        (["export", "checkpoints/pendulum_rtcd", "--na"], {"--name"}),
    ],
)
def test_bash_completes(script, words, completed):
    done = subprocess.run(["bash", "-c", TRY, "bash", script, "rtcd", *words], capture_output=True, text=True)
    assert set(done.stdout.split()) == completed, done.stderr


def test_words_that_are_no_option_are_completed_as_files(script):
    assert "complete -o default -F _tyro_rtcd rtcd" in script.read_text()


def test_zsh_gets_its_own_and_others_a_line(capsys):
    assert main(["completion", "zsh"]) == 0
    assert capsys.readouterr().out.startswith("#compdef rtcd")
    assert main(["completion", "fish"]) == 2
