"""`rtcd check FILE`, and with `--second` the checker in C++ beside it: both must come to the same verdict."""

import hashlib
import io
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from rtcd_jax.certificate.check import command as first
from rtcd_jax.system.errors import UserError, printable
from rtcd_jax.system.files import make_folder, user_cache, writing

SOURCE = Path(__file__).with_name("check.cpp")
COMPILER, OPTIONS, LIBRARIES = "g++", ("-O1", "-std=c++17"), ("-lgmpxx", "-lgmp")
NEEDS = "it needs g++ and GMP with its header for C++ (Debian, Ubuntu: apt install g++ libgmp-dev)"
SECOND = "--second"
USAGE = f"""\
  {SECOND}          also by the checker in C++, which shares no line with this one: both must come to the same
                    verdict; it is built once, by g++ with GMP, and kept in the user's cache"""


def main(arguments: Sequence[str]) -> int:
    """The exit code of `rtcd check`; with `--second` 1 where the two checkers differ, 2 where one does not decide.

    Raises:
        UserError: the second checker cannot be built.
    """
    if "-h" in arguments or "--help" in arguments:
        usage, example = first.USAGE.split("\n\nExample")
        print(f"{usage.replace('[--seconds', f'[{SECOND}] [--seconds')}\n{USAGE}\n\nExample{example}")
        return 0
    words = [word for word in arguments if word != SECOND]
    if len(words) == len(arguments):
        return first.main(words)
    said, errors = io.StringIO(), io.StringIO()
    with redirect_stdout(said), redirect_stderr(errors):
        code = first.main(words)
    sys.stdout.write(said.getvalue())
    sys.stderr.write(errors.getvalue())
    if code == 2:
        return code
    files, seconds, _, cycle = first.options_of(words)
    asked = [*files, "--seconds", repr(seconds), *(("--cycle",) if cycle else ())]
    return code if _agrees(built(), asked, _proved(said.getvalue())) else 1


def _proved(output: str) -> list[str]:
    """The sentences of an output; none where a file is refused."""
    return [exact(line) for line in output.splitlines() if line.startswith("PROVED ")]


def _agrees(program: Path, asked: Sequence[str], proved: list[str]) -> bool:
    """Whether the second checker comes to the same; says so. Raises UserError where it does not decide."""
    done = subprocess.run([program, *asked], capture_output=True, text=True)
    if done.returncode not in (0, 1):
        reason = done.stderr.strip() or f"ended with {done.returncode}"
        raise UserError(f"the second checker does not decide: {printable(reason)}")
    theirs = (done.stdout.splitlines() or done.stderr.splitlines()[1:])[0]
    if done.returncode == 0 and proved and _proved(done.stdout) == proved:
        print("The second checker, in C++, proves the same.")
        return True
    if done.returncode == 1 and not proved:
        print(f"The second checker, in C++, refuses it, too: {theirs}", file=sys.stderr)
        return True
    print(f"THE TWO CHECKERS DIFFER. The second one, in C++: {theirs}", file=sys.stderr)
    return False


def exact(sentence: str) -> str:
    """A sentence without the one number that is the checkers' own rounding, how close to the goal motions come."""
    return re.sub(r"converges to within \S+ of the goal", "converges to the goal", sentence)


def built() -> Path:
    """The second checker, in the user's cache; built unless it is there.

    Raises:
        UserError: no g++, no GMP, or a cache that cannot be written.
    """
    mark = hashlib.sha256(SOURCE.read_bytes())
    mark.update(" ".join((COMPILER, *OPTIONS, *LIBRARIES, platform.platform())).encode())
    program = user_cache() / "checkers" / mark.hexdigest()
    if program.is_file():
        return program
    if shutil.which(COMPILER) is None:
        raise UserError(f"cannot build the second checker: there is no {COMPILER}; {NEEDS}")
    make_folder(program.parent)
    print("building the second checker by g++, once: some 15 s", file=sys.stderr)
    with writing(program.parent), tempfile.TemporaryDirectory(dir=program.parent) as folder:
        new = Path(folder) / "check"
        command = [COMPILER, *OPTIONS, str(SOURCE), *LIBRARIES, "-o", str(new)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            errors = [line for line in done.stderr.splitlines() if "error" in line or "cannot find" in line]
            reason = printable((errors or ["no reason"])[0], 200)
            raise UserError(f"cannot build the second checker: {reason}; {NEEDS}")
        new.replace(program)
    return program
