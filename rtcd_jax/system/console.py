"""What a verb says: messages that stay, the progress of long work as a live line on a terminal, and tables."""

import contextlib
import io
import math
import sys
import time
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass
from threading import Event, Thread
from typing import Self, TextIO, final

from rich.box import SIMPLE
from rich.console import Console as Terminal
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar
from rich.table import Table

from rtcd_jax.system.errors import printable, printable_lines

WIDTH = 150
"""Characters of a table's row at most; longer cells are wrapped."""

WAITING = 10.0
"""Seconds between two lines about work that cannot say how far it is."""


@final
@dataclass(frozen=True)
class Progress:
    """`done` of `total` parts of some work, in any unit, and the line that says so."""

    done: float
    total: float
    text: str


@final
class Clock:
    """Wall time of some work that begins now, of which `before` parts were done by an earlier call."""

    def __init__(self, before: float = 0):
        self._begun, self._before = time.monotonic(), before

    @property
    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return time.monotonic() - self._begun

    def times(self, done: float, total: float) -> str:
        """Elapsed time, and what is left if all parts take as long as those since the beginning."""
        elapsed, fresh = self.elapsed, done - self._before
        return times(elapsed, elapsed * (total - done) / fresh if fresh > 0 else math.nan)


def times(elapsed: float, left: float) -> str:
    """Both [s] as every line of progress shows them; `left` is NaN where it is not known."""
    return f"elapsed {duration(elapsed)}  left {duration(left)}"


def duration(seconds: float) -> str:
    """Hours, minutes and seconds, as 1:02:05 or 0:12."""
    if not math.isfinite(seconds):
        return "unknown"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


@final
class Console:
    """Where a verb speaks: stdout, a stream or a rich terminal. A context manager: leaving it ends the live line."""

    def __init__(self, stream: TextIO | None = None, terminal: Terminal | None = None):
        stream = stream or sys.stdout
        # Whatever FORCE_COLOR says, as in a notebook's shell: a live line in a pipe is unreadable.
        self._terminal = terminal or Terminal(file=stream, force_terminal=_is_terminal(stream))
        self._bar: Bar | None = None
        self.spoken = time.monotonic()
        """When it said something last."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def message(self, text: str) -> None:
        """Lines that stay; on a terminal above the live one. They only show what they quote: no terminal obeys it."""
        self.spoken = time.monotonic()
        self._terminal.print(printable_lines(text), soft_wrap=True, highlight=False, markup=False, emoji=False)
        self._terminal.file.flush()

    def progress(self, now: Progress) -> None:
        """Redraws the live line on a terminal; prints a line elsewhere."""
        if not self._terminal.is_terminal:
            self.message(now.text)
            return
        self.spoken = time.monotonic()
        if self._bar is None:
            columns = BarColumn(bar_width=16), TextColumn("{task.description}", markup=False)
            self._bar = Bar(*columns, console=self._terminal, auto_refresh=False)
            self._bar.add_task("")
            self._bar.start()
        task = self._bar.task_ids[0]
        text = printable(now.text)
        self._bar.update(task, completed=now.done, total=now.total, description=text, refresh=True)

    @contextlib.contextmanager
    def waiting(self, text: str, every: float = WAITING) -> Iterator[None]:
        """Around what takes long and cannot say how far it is, compilation: `text` with the elapsed time, again and
        again until it is over."""
        over, clock = Event(), Clock()

        def tell() -> None:
            while not over.wait(every):
                self.message(f"{text}  elapsed {duration(clock.elapsed)}")

        teller = Thread(target=tell, daemon=True)
        teller.start()
        try:
            yield
        finally:
            over.set()
            teller.join()


def _is_terminal(stream: TextIO | None) -> bool:
    try:
        return stream is not None and stream.isatty()
    except ValueError:  # it is closed
        return False


def each_second(console: Console) -> Callable[[int, int, str], None]:
    """`show(done, total, what)` for steps too short to be shown one by one: once a second at most."""
    clock, shown = Clock(), 0.0

    def show(done: int, total: int, what: str) -> None:
        nonlocal shown
        if clock.elapsed - shown >= 1:
            shown = clock.elapsed
            console.progress(Progress(done, total, f"{what}  {done}/{total}"))

    return show


def silent() -> Console:
    """One that says nothing: for processes beside the first."""
    return Console(terminal=Terminal(quiet=True))


def table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None, left: Container[str] = ()
) -> str:
    """A table as text; columns are aligned to the right but for those in `left`. A short row leaves cells empty."""
    drawn = Table(box=SIMPLE, title=title)
    for heading in headings:
        drawn.add_column(heading, justify="left" if heading in left else "right")
    for row in rows:
        drawn.add_row(*row)
    text = io.StringIO()
    plain = Terminal(file=text, width=WIDTH, force_terminal=False, color_system=None, markup=False, emoji=False)
    plain.print(drawn)
    return text.getvalue().rstrip()
