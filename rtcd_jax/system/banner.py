"""Standard input -> standard output, without XLA's banner about slow compilation.

XLA logs it as an error whenever a program compiles for more than two minutes, and no option turns that off. This file
runs as a process of its own, which imports nothing of the package: what a process writes before it crashes is shown.
"""

import os
import re
import select
import signal
from collections.abc import Iterable, Iterator

LONGEST = 10
"""Lines of a banner at most; what goes on for longer is something else."""
PAUSE = 0.2
"""Seconds after which the beginning of a line is shown, too."""
_HEAD = re.compile(rb"E\d{4} [\d:.]+ +\d+ slow_operation_alarm\.cc:\d+\] (The operation took \S+)?\n")
_STARS = b"*" * 32 + b"\n"


def without_banners(lines: Iterable[bytes]) -> Iterator[bytes]:
    """The same lines but for those of the banner: its head, and what stands between two rows of stars behind it."""
    held: list[bytes] = []
    for line in lines:
        if not held and not _HEAD.fullmatch(line):
            yield line
            continue
        held.append(line)
        stars = held.count(_STARS)
        if stars == 2:
            held = []
        elif (not stars and len(held) > 1 and line != b"\n") or len(held) > LONGEST:
            yield from held
            held = []
    yield from held


def _lines(source: int) -> Iterator[bytes]:
    """A file descriptor's lines as they come; of one that stays incomplete, its parts."""
    rest = b""
    while True:
        if rest and not select.select([source], [], [], PAUSE)[0]:
            yield rest
            rest = b""
        part = os.read(source, 1 << 16)
        *complete, rest = (rest + part).split(b"\n")
        yield from (line + b"\n" for line in complete)
        if not part:
            break
    if rest:
        yield rest


def _pass_on() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGTTOU):
        signal.signal(number, signal.SIG_IGN)  # it ends when nobody writes any more
    for line in without_banners(_lines(0)):
        while line:
            line = line[os.write(1, line) :]


if __name__ == "__main__":
    _pass_on()
