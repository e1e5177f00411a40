"""`rtcd check FILE`: what is proved in plain words, or where the proof fails; `--cycle` of several files together."""

import hashlib
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rtcd_jax.certificate.check.cycle import cycle_sentence, require_cycle
from rtcd_jax.certificate.check.exact import Refused, Undecided, printable
from rtcd_jax.certificate.check.node import parse, read_bytes
from rtcd_jax.certificate.check.sentence import sentence
from rtcd_jax.certificate.check.verdict import Report, check_file

SECONDS = 600.0
"""For a stranger's file; the cart-pole's take 40 with python-flint."""
LONGEST_NOTE = 79
"""Characters of a line that holds a note: it stays one line on a terminal."""
USAGE = f"""\
usage: rtcd check FILE [--seconds N] [--controller LAB]
       rtcd check --cycle FILE FILE [...] [--seconds N]

Check a certificate, certificates/NNN.json of a run folder, by exact arithmetic, without any solver. Exit code 0 only
if all of it holds; 1 if it is refused, with the place and the reason; 2 if it is undecided or there is nothing to read.

  --seconds N       give up after so many seconds of wall clock [s] (> 0, default {SECONDS:g})
  --cycle           also: does each motion end where the next one begins, the last where the first does?
  --controller LAB  also: was this folder of `rtcd export` made from the certificate's claim, and is it as it was made?

Example: rtcd check checkpoints/pendulum_rtcd/certificates/000.json"""


def main(arguments: Sequence[str]) -> int:
    """0 and what is proved; 1 and why nothing is; 2 where that is undecided, or there is nothing to read."""
    if "-h" in arguments or "--help" in arguments:
        print(USAGE)
        return 0
    try:
        files, seconds, lab, cycle = options_of(arguments)
    except ValueError as error:
        print(f"rtcd check: {printable(error)}", file=sys.stderr)
        return 2
    reports: list[Report] = []
    file, compared = files[0], ""
    try:
        with within(seconds):
            for file in files:
                reports.append(check_file(Path(file), _counted))
            if cycle:
                require_cycle([(report.claim, report.inlet) for report in reports])
            if lab is not None:
                compared = compare(Path(lab), reports[0].digest)
    except OSError as error:
        print(f"{printable(error.filename)}: {error.strerror}; a certificate is RUN/certificates/NNN.json"
              + ", a controller the folder of `rtcd export`" * (lab is not None), file=sys.stderr)  # fmt: skip
        return 2
    except Undecided as undecided:
        print(f"{printable(file)}: {undecided}", file=sys.stderr)
        return 2
    except Refused as refused:
        which = " ".join(files) if len(reports) == len(files) else file
        print(f"REFUSED {printable(which)}\n{refused}", file=sys.stderr)
        return 1
    for report in reports:
        print(sentence(report))
        for key, value in report.notes.items():
            print(printable(f"note of the file's author, not proved: {key}: {value}", LONGEST_NOTE))
    if cycle:
        print(cycle_sentence([report.digest for report in reports]))
    if compared:
        print(f"NOT THE CONTROLLER OF THIS CERTIFICATE: {printable(lab)}: {compared}", file=sys.stderr)
        return 1
    if lab is not None:
        print(f"The controller in {printable(lab)} was exported from this claim, and its files are as exported.")
    return 0


def options_of(arguments: Sequence[str]) -> tuple[list[str], float, str | None, bool]:
    """The files, the seconds, the controller's folder, and whether the files are a cycle. Raises ValueError, which says
    what would have been right.
    """
    files: list[str] = []
    given: dict[str, str] = {}
    rest = iter(arguments)
    cycle = False
    for word in rest:
        if word == "--cycle":
            cycle = True
            continue
        name, equals, value = word.partition("=")
        if name in ("--seconds", "--controller"):
            value = value if equals else next(rest, "")
            if not value:
                raise ValueError(f"{name}: must be followed by its value")
            given[name] = value
        elif word.startswith("--"):
            raise ValueError(f"unknown option {name}; valid: --seconds, --controller, --cycle")
        else:
            files.append(word)
    if cycle and (not files or "--controller" in given):
        raise ValueError("--cycle: must be followed by the certificates of all its motions, without --controller")
    if len(files) != 1 and not cycle:
        raise ValueError(f"{len(files)} files: must be one, as in `rtcd check RUN/certificates/000.json`")
    text = given.get("--seconds", SECONDS)
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0 < seconds <= 1e6:
        raise ValueError(f"--seconds {text}: must be a number > 0 and <= 1e6")
    return files, seconds, given.get("--controller"), cycle


@contextmanager
def within(seconds: float) -> Iterator[None]:
    """Raises Undecided in what takes longer. There is no limit outside of the main thread, where no alarm rings."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        yield
        return

    def ring(*_: object) -> None:
        raise Undecided(f"gave up after {seconds:g} s: undecided; --seconds gives it more")

    former = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)  # once more where a callback has swallowed the exception
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, former or signal.SIG_DFL)


def compare(lab: Path, digest: str) -> str:
    """Why the exported folder `lab` is not what was made from the claim of this digest; empty if it is.

    Raises:
        OSError: there is no `export.json` in it.
    """
    try:
        mark = parse(read_bytes(lab / "export.json"))
    except Refused as refused:
        return f"export.json: {refused}"
    if not (isinstance(mark, dict) and isinstance(mark.get("files"), dict)):
        return "export.json is none of `rtcd export`"
    if mark.get("complete") is not True:
        return "its export was not finished"
    if mark.get("claim") != digest:
        theirs = printable(mark["claim"], 64) if isinstance(mark.get("claim"), str) else "none"
        return f"it was exported from another claim: sha256 {theirs} there, {digest} in the certificate"
    for name, stored in mark["files"].items():
        if not name or Path(name).name != name or "\0" in name:
            return f"export.json names {printable(name, 60)}, which is no file in the folder"
        try:
            same = hashlib.sha256(read_bytes(lab / name)).hexdigest() == stored
        except OSError:
            return f"{printable(name, 60)} is missing"
        if not same:
            return f"{printable(name, 60)} is not as it was exported"
    return ""


def _counted(done: int, of: int) -> None:
    """A live line on a terminal."""
    if sys.stderr.isatty():
        print(f"\rinterval {done} of {of}", end="\n" if done == of else "", file=sys.stderr, flush=True)
