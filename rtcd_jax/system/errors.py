"""Errors that teach: the thing, its value, and what would have been right."""

import difflib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Self

NO_VALUE = object()
"""Stands for a value where there is none to show."""
_LONGEST_VALUE = 60
_LONGEST_KEY = 120
_MOST_PROBLEMS = 20


class Problem(NamedTuple):
    """What is wrong at one key, and the value that stands there."""

    path: tuple[str | int, ...]
    text: str
    value: Any = NO_VALUE

    def __str__(self) -> str:
        key = printable(".".join(map(str, self.path)), _LONGEST_KEY) or "the configuration"
        if self.value is NO_VALUE:
            return f"{key}: {self.text}"
        return f"{key} = {printable(repr(self.value), _LONGEST_VALUE)}: {self.text}"


class UserError(ValueError):
    """Something the user can mend: the command line shows its text alone, without a traceback."""


class ConfigError(UserError):
    """Everything that is wrong with a configuration or options: a line, or one each under a heading, twenty at most.

    `source` is the file that it stands in; empty for the command line.
    """

    def __init__(self, problems: Iterable[Problem], source: str = "configuration"):
        self.problems = tuple(problems)
        self.source = source
        first, *others = self.problems
        where = f"{source}: " if source else ""
        lines = [
            f"{where}{len(self.problems)} errors",
            *(f"  {problem}" for problem in self.problems[:_MOST_PROBLEMS]),
        ]
        if len(self.problems) > _MOST_PROBLEMS:
            lines.append(f"  and {len(self.problems) - _MOST_PROBLEMS} more")
        if not others:
            lines = [f"{where}{first if first.path or first.value is not NO_VALUE else first.text}"]
        super().__init__("\n".join(lines))

    def __reduce__(self) -> tuple[type[Self], tuple[tuple[Problem, ...], str]]:
        """What a worker process hands back is made again from its parts."""
        return type(self), (self.problems, self.source)


def closest(word: object, known: Sequence[str]) -> str:
    """A sentence that names the valid words, led by the one that was probably meant."""
    listed = ", ".join(known)
    for match in difflib.get_close_matches(str(word).lower(), known, n=1):
        return f"did you mean {match!r}? Valid: {listed}"
    return f"valid: {listed}"


def printable(text: object, longest: int | None = None) -> str:
    """Text from outside (a file's keys, names, notes) on one line that a terminal only shows: never obeys, never hides.

    Escape codes, line breaks, marks that turn the direction of writing and half characters become Python's escapes;
    everything else stays. What is longer than `longest` characters ends in "…".
    """
    shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text)[:longest])
    if longest is not None and len(shown) + (len(str(text)) > longest) > longest:
        shown = shown[: longest - 1] + "…"
    return shown


def printable_lines(text: str) -> str:
    """The same for text of several lines, which stay lines."""
    return "\n".join(printable(line) for line in text.split("\n"))
