"""A file's text: JSON in ASCII, its numbers exact. Whatever is none is refused with its place."""

import hashlib
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.exact import MAX_BYTES, Damaged, Q, Refused, Undecided, rational, require

LONGEST_NAME = 40
_DOUBLE = re.compile(r"-?0x[01](\.[0-9a-f]{1,13})?p[+-][0-9]{1,4}")


class Node(NamedTuple):
    """A value of the file and where it stands."""

    place: str
    value: Any

    def keys(self, *names: str) -> "list[Node]":
        """The entries of an object that must have these keys and the digests of their values."""
        self.require(isinstance(self.value, dict), "must be an object")
        wrong = sorted({*names, "sha256"} ^ self.value.keys())
        self.require(not wrong, f"has unknown keys or lacks some: {', '.join(wrong)[:80]}")
        digests = self.value["sha256"]
        Node(f"{self.place}.sha256", digests).require(
            isinstance(digests, dict) and digests.keys() == set(names), f"must be digests of {', '.join(names)}"
        )
        return [Node(f"{self.place}.{name}", self.value[name]) for name in names]

    def require_digests(self) -> None:
        """Refuses values that do not have the stored digests."""
        for name, stored in self.value["sha256"].items():
            if stored != digest(self.value[name]):
                raise Damaged(f"{self.place}.{name}", "was changed: its digest is another")

    def require(self, holds: bool, reason: str) -> None:
        require(holds, self.place, reason)

    def items(self, count: int | None = None, at_least: int = 0) -> "list[Node]":
        self.require(isinstance(self.value, list), "must be a list")
        entries = len(self.value)
        self.require(count is None or entries == count, f"has {entries} entries, must have {count}")
        self.require(entries >= at_least, f"has {entries} entries, must have at least {at_least}")
        return [Node(f"{self.place}[{i}]", v) for i, v in enumerate(self.value)]

    def number(self):
        self.require(
            isinstance(self.value, str) and bool(_DOUBLE.fullmatch(self.value)), "must be a double in hexadecimal"
        )
        try:
            return rational(float.fromhex(self.value))
        except OverflowError:
            raise Refused(self.place, "is too large for a double") from None

    def integer(self, low: int, high: int) -> int:
        holds = type(self.value) is int and low <= self.value <= high
        self.require(holds, f"must be an integer from {low} to {high}")
        return self.value

    def array(self, *shape: int) -> Any:
        """Nested lists of numbers."""
        return [node.array(*shape[1:]) for node in self.items(shape[0])] if shape else self.number()

    def text(self) -> str:
        self.require(isinstance(self.value, str) and len(self.value) <= LONGEST_NAME, "must be a short text")
        return self.value

    def texts(self, count: int | None = None, at_least: int = 0) -> tuple[str, ...]:
        return tuple(node.text() for node in self.items(count, at_least))

    def named(self) -> "list[tuple[str, Node]]":
        """The entries of an object whose keys are names."""
        self.require(isinstance(self.value, dict), "must be an object")
        return [
            (Node(self.place, name).text(), Node(f"{self.place}.{name}", value)) for name, value in self.value.items()
        ]

    def symmetric(self, rows: int) -> list[list]:
        """A symmetric matrix, of which the file has the upper triangle row by row."""
        c = iter(node.number() for node in self.items(rows * (rows + 1) // 2))
        full = [[Q(0)] * rows for _ in range(rows)]
        for i in range(rows):
            for j in range(i, rows):
                full[i][j] = full[j][i] = next(c)
        return full


def digest(value: Any) -> str:
    """The digest of a value of a file."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _unique(pairs: list[tuple[str, Any]]) -> dict:
    entries = dict(pairs)
    if len(entries) != len(pairs):
        raise Damaged("certificate", "has the same key twice")
    return entries


def _no_constant(name: str) -> Any:
    raise Damaged("certificate", f"holds {name}")


def read_bytes(path: Path) -> bytes:
    """A file's content; Undecided if it is too large, OSError if it cannot be read."""
    with path.open("rb") as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise Undecided(f"has more than {MAX_BYTES} bytes: undecided")
    return content


def parse(content: bytes) -> Any:
    """The JSON of a file in ASCII; refused if it is none."""
    try:
        return json.loads(content.decode("ascii"), object_pairs_hook=_unique, parse_constant=_no_constant)
    except Refused:
        raise
    except UnicodeDecodeError:
        raise Damaged("certificate", "is no ASCII text") from None
    except MemoryError:
        raise Undecided("needs more memory than there is: undecided") from None
    except RecursionError:
        raise Damaged("certificate", "is nested too deeply") from None
    except ValueError as error:
        raise Damaged("certificate", f"is no JSON: {error}") from None
