"""Progress of long work: a live line on a terminal, plain lines elsewhere. Takes plain numbers."""

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol, Self, TextIO

from rich.console import Console as Terminal
from rich.progress import BarColumn, TextColumn
from rich.progress import Progress as Bar


class Countable(Protocol):
    """How far some work is: `done` of `total` parts, and `str` says the rest."""

    @property
    def done(self) -> int: ...

    @property
    def total(self) -> int: ...


@dataclass(frozen=True)
class Progress:
    """One generation. Volumes are of the `sampled` rung, in the product of the states' units.

    `best` is the best so far, `median` this generation's among the feasible; NaN where there is none.
    `feasible` is a share in [0, 1], `rate` in candidates a second, `elapsed` and `left` in seconds; `rate` and `left`
    are NaN for a generation that compiled.
    `failures` counts this generation's candidates without a funnel by the name of their status.
    """

    generation: int
    generations: int
    best: float
    median: float
    feasible: float
    rate: float
    elapsed: float
    left: float
    failures: Mapping[str, int] = field(default_factory=dict)

    @property
    def done(self) -> int:
        return self.generation

    @property
    def total(self) -> int:
        return self.generations

    def __str__(self) -> str:
        parts = [
            f"generation {self.generation:{len(str(self.generations))}d}/{self.generations}",
            f"best {_volume(self.best)} (sampled)",
            f"median {_volume(self.median)}",
            f"feasible {self.feasible:4.0%}",
            "compiled" if math.isnan(self.rate) else f"{self.rate:.3g} candidates/s",
            f"elapsed {_duration(self.elapsed)}",
            f"left {_duration(self.left)}",
        ]
        failed = ", ".join(f"{count} {name.lower()}" for name, count in self.failures.items() if count)
        return "  ".join([*parts, f"failed: {failed}"] if failed else parts)


class Console:
    """Where a run speaks: stdout, a stream or a rich terminal. A context manager: leaving it ends the live line."""

    def __init__(self, stream: TextIO | None = None, terminal: Terminal | None = None):
        self._terminal = terminal or Terminal(file=stream or sys.stdout)
        self._bar: Bar | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def message(self, text: str) -> None:
        """A line that stays; on a terminal above the live one."""
        self._terminal.print(text, soft_wrap=True, highlight=False, markup=False, emoji=False)
        self._terminal.file.flush()

    def progress(self, now: Countable) -> None:
        """Redraws the live line on a terminal; prints a line elsewhere."""
        if not self._terminal.is_terminal:
            self.message(str(now))
            return
        if self._bar is None:
            columns = BarColumn(bar_width=16), TextColumn("{task.description}", markup=False)
            self._bar = Bar(*columns, console=self._terminal, auto_refresh=False)
            self._bar.add_task("", total=now.total)
            self._bar.start()
        self._bar.update(self._bar.task_ids[0], completed=now.done, description=str(now), refresh=True)


def silent() -> Console:
    """One that says nothing: for processes beside the first."""
    return Console(terminal=Terminal(quiet=True))


def _volume(value: float) -> str:
    return "none" if math.isnan(value) else f"{value:.5g}"


def _duration(seconds: float) -> str:
    if not math.isfinite(seconds):
        return "unknown"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
