"""The finished steps of a long task on disk, so that a killed one goes on."""

import itertools
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

from rtcd_jax.system.files import reading, replace, writing


@final
class Journal:
    """One JSON line a step, in `lines`: those of former calls, followed by those of this one.

    With a `head`, the file is of one task: its first line is the head, lines of another task are dropped, and so is
    what follows a damaged line. Without one it collects the lines of many tasks, and only damaged lines are dropped.
    """

    def __init__(self, path: Path, head: Mapping[str, Any] | None = None):
        self.path = path
        content = b""
        if path.is_file():
            with reading(path, "remove it"):
                content = path.read_bytes()
        stored = [_parsed(line) for line in content.splitlines(keepends=True)]
        if head is not None:
            former = itertools.takewhile(lambda line: line is not None, stored[1:])
            stored = [head, *former] if stored[:1] == [head] else [head]
        whole = [line for line in stored if line is not None]
        self.lines = whole if head is None else whole[1:]
        if (cleaned := b"".join(map(_written, whole))) != content:
            replace(path, cleaned)

    def append(self, line: Mapping[str, Any]) -> None:
        self.lines.append(dict(line))
        with writing(self.path), self.path.open("ab") as file:
            file.write(_written(line))

    def close(self) -> None:
        """The task is finished, and its file is gone."""
        self.path.unlink(missing_ok=True)


def _written(line: Mapping[str, Any]) -> bytes:
    return f"{json.dumps(line)}\n".encode()


def _parsed(line: bytes) -> dict[str, Any] | None:
    """None for a line that is torn or damaged."""
    try:
        return dict(json.loads(line)) if line.endswith(b"\n") else None
    except (TypeError, ValueError, RecursionError):
        return None
