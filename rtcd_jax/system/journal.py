"""The finished steps of a long task on disk, so that a killed one goes on."""

import contextlib
import itertools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, final

from rtcd_jax.system.files import replace, writing


@final
class Journal:
    """One JSON line a step; the first line, the head, says of which task.

    Lines of another task are dropped, and what follows a torn one.
    """

    def __init__(self, path: Path, head: Mapping[str, Any]):
        self.path = path
        lines = list(_whole(path)) if path.is_file() else []
        self.lines = lines[1:] if lines and lines[0] == head else []
        replace(path, "".join(f"{json.dumps(line)}\n" for line in (head, *self.lines)).encode())

    def append(self, line: Mapping[str, Any]) -> None:
        self.lines.append(dict(line))
        with writing(self.path), self.path.open("ab") as file:
            file.write(f"{json.dumps(line)}\n".encode())

    def close(self) -> None:
        """The task is finished, and its file is gone."""
        self.path.unlink()


def _whole(path: Path) -> Iterator[dict[str, Any]]:
    """A journal's lines up to the first one that is torn or damaged."""
    with path.open("rb") as file, contextlib.suppress(TypeError, ValueError):
        for line in itertools.takewhile(lambda line: line.endswith(b"\n"), file):
            yield dict(json.loads(line))
