"""The second checker in tests: built once in a session, asked about contents."""

import json
import shutil
import subprocess

import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Refused, Undecided
from rtcd_jax.certificate.check_cpp.command import COMPILER, LIBRARIES, built, exact

SECONDS = 60


def program():
    """The second checker; skips where there is no compiler, or no GMP for C++."""
    if shutil.which(COMPILER) is None:
        pytest.skip(f"the second checker is not built here: there is no {COMPILER}")
    header = subprocess.run(
        [COMPILER, "-x", "c++", "-std=c++17", "-", *LIBRARIES, "-o", "/dev/null"],
        input="#include <gmpxx.h>\nint main() { return mpz_class(0).get_si(); }",
        text=True,
        capture_output=True,
    )
    if header.returncode:
        pytest.skip("the second checker is not built here: there is no GMP with its header gmpxx.h")
    return built()


class Verdict:
    """What a checker says of a file: its exit code, and the sentence or the place and reason."""

    def __init__(self, code, words):
        self.code, self.words = code, exact(words)

    @property
    def place(self):
        return self.words.partition(": ")[0]

    def __eq__(self, other):
        return (self.code, self.words) == (other.code, other.words)

    def __repr__(self):
        return f"{self.code} {self.words}"


def first_verdict(content):
    """The Python checker's."""
    try:
        with check.within(SECONDS):
            return Verdict(0, check.sentence(check.check(content)))
    except Refused as refused:
        return Verdict(1, str(refused))
    except Undecided as undecided:
        return Verdict(2, str(undecided))


def second_verdict(second, path, content):
    """The one in C++, of a content that it reads from `path`."""
    path.write_text(json.dumps(content))
    done = subprocess.run([second, path, "--seconds", str(SECONDS)], capture_output=True, text=True)
    lines = done.stdout.splitlines() or done.stderr.splitlines()[done.returncode == 1 :]
    assert done.returncode in (0, 1, 2), done
    return Verdict(done.returncode, lines[0])
