"""`rtcd check FILE`: what is proved in plain words, or where the proof fails."""

import sys
from collections.abc import Sequence
from pathlib import Path

from rtcd_jax.certificate.check.claim import PLANTS
from rtcd_jax.certificate.check.exact import Refused
from rtcd_jax.certificate.check.verdict import check_file, sentence

USAGE = """\
usage: rtcd check FILE

Check a certificate, certificates/NNN.json of a run folder, by exact arithmetic, without any solver. Exit code 0 only
if all of it holds; 1 if it is refused, with the place and the reason; 2 if there is nothing to read.

Example: rtcd check checkpoints/pendulum_rtcd/certificates/000.json"""


def main(arguments: Sequence[str]) -> int:
    """0 and what is proved; 1 and why nothing is; 2 where there is nothing to read."""
    if arguments[:1] in (["-h"], ["--help"]):
        print(USAGE)
        return 0
    if len(arguments) != 1:
        print(f"{len(arguments)} files: must be one, as in `rtcd check RUN/certificates/000.json`", file=sys.stderr)
        return 2
    try:
        report = check_file(Path(arguments[0]), _counted)
    except OSError as error:
        print(f"{arguments[0]}: {error.strerror}; a certificate is RUN/certificates/NNN.json", file=sys.stderr)
        return 2
    except Refused as refused:
        print(f"REFUSED {arguments[0]}\n{refused}", file=sys.stderr)
        return 1
    name = next(key for key, plant in PLANTS.items() if plant is report.claim.plant)
    print(sentence(name, report))
    for key, value in report.notes.items():
        print(f"note, not proved: {key}: {value}")
    return 0


def _counted(done: int, of: int) -> None:
    """A live line, where somebody watches."""
    if sys.stderr.isatty():
        print(f"\rinterval {done} of {of}", end="\n" if done == of else "", file=sys.stderr, flush=True)
