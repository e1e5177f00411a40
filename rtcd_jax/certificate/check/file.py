"""A file's text into exact numbers. Whatever is not as docs/certificates.md says is refused with its place."""

import hashlib
import json
import math
import re
from pathlib import Path
from typing import Any, NamedTuple

from rtcd_jax.certificate.check.claim import PLANTS, Claim
from rtcd_jax.certificate.check.exact import (
    MAX_BYTES,
    MAX_ORDER,
    MAX_TERMS,
    Damaged,
    Q,
    Refused,
    Undecided,
    require,
    rounded,
)
from rtcd_jax.certificate.check.funnel import Interval
from rtcd_jax.certificate.check.goal import Shell
from rtcd_jax.certificate.check.squares import GramCertificate, monomials

MAX_NOTES = 20
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
            return Q(*float.fromhex(self.value).as_integer_ratio())
        except OverflowError:
            raise Refused(self.place, "is too large for a double") from None

    def integer(self, low: int, high: int) -> int:
        holds = type(self.value) is int and low <= self.value <= high
        self.require(holds, f"must be an integer from {low} to {high}")
        return self.value

    def array(self, *shape: int) -> Any:
        """Nested lists of numbers."""
        return [node.array(*shape[1:]) for node in self.items(shape[0])] if shape else self.number()

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


def read_claim(node: Node) -> Claim:
    names = ("plant", "parameters", "state_limits", "dt", "x", "rates", "u", "K", "x_goal", "K_goal", "start")
    entries = dict(zip(names, node.keys(*names), strict=True))
    node.require_digests()
    entries["plant"].require(entries["plant"].value in tuple(PLANTS), f"must be one of {', '.join(PLANTS)}")
    plant = PLANTS[entries["plant"].value]
    n = len(plant.states)
    given = entries["parameters"]
    given.require(isinstance(given.value, dict) and given.value.keys() == set(plant.parameters), "must be the plant's")
    parameters = {name: Node(f"{given.place}.{name}", given.value[name]).number() for name in plant.parameters}
    for name, value in parameters.items():
        must = ">= 0" if name in ("b", "Beq", "Bp") else "> 0"
        holds = value >= 0 if must == ">= 0" else value > 0
        require(holds, f"{given.place}.{name}", f"= {rounded(value):g}: must be {must}")
    limits = entries["state_limits"].items(n)
    bounds = [None if limit.value is None else limit.number() for limit in limits]
    dt = entries["dt"].number()
    entries["dt"].require(dt > 0, "must be > 0")
    knots = len(entries["x"].items(at_least=2))
    start = entries["start"].items(2)
    return Claim(
        plant, parameters, parameters[plant.limit], bounds, dt,
        entries["x"].array(knots, n), entries["rates"].array(knots - 1, 2, n), entries["u"].array(knots - 1),
        entries["K"].array(knots, n), entries["x_goal"].array(n), entries["K_goal"].array(n),
        (start[0].integer(0, knots - 1), start[1].number()),
    )  # fmt: skip


def read_cases(node: Node, n: int) -> dict[str, GramCertificate]:
    node.require(isinstance(node.value, dict) and node.value.keys() <= {"free", "high", "low"}, "must be cases")
    cases = {}
    for case, value in node.value.items():
        here = Node(f"{node.place}.{case}", value)
        holds = isinstance(value, dict) and value.keys() == {"degree", "gram", "multipliers"}
        here.require(holds, "must have the keys degree, gram, multipliers")
        degree = Node(f"{here.place}.degree", value["degree"]).integer(1, MAX_ORDER // 2)
        rows, sides = len(monomials(n, degree)), len(monomials(n, degree - 1))
        grams = Node(f"{here.place}.gram", value["gram"]).items(at_least=1)
        grams[0].require(len(grams) <= 2 * MAX_ORDER, f"must have at most {2 * MAX_ORDER} matrices")
        multipliers = Node(f"{here.place}.multipliers", value["multipliers"]).items()
        cases[case] = GramCertificate(
            degree,
            [gram.symmetric(rows) for gram in grams],
            [[matrix.symmetric(sides) for matrix in each.items(at_least=1)] for each in multipliers],
        )
    return cases


def require_few_terms(node: Node, n: int, s_order: int, y_order: int) -> None:
    """A polynomial of these orders in s and y must be small enough to be multiplied in seconds."""
    terms = (s_order + 1) * math.comb(y_order + n, n)
    node.require(terms <= MAX_TERMS, f"asks for polynomials of {terms} terms, must be at most {MAX_TERMS}")


def read_interval(node: Node, claim: Claim) -> Interval:
    knot, start, end, first, last, bend, orders, cases = node.keys(
        "knot", "start", "end", "first", "last", "bend", "orders", "cases"
    )
    node.require_digests()
    n = claim.n
    pair = [order.integer(1, MAX_ORDER - 1) for order in orders.items(2)]
    require_few_terms(orders, n, *pair)
    interval = Interval(
        knot.integer(0, len(claim.u) - 1), start.number(), end.number(), first.array(n, n), last.array(n, n),
        bend.array(2, n, n), (pair[0], pair[1]), read_cases(cases, n),
    )  # fmt: skip
    node.require(
        0 <= interval.start < interval.end <= 1, "must start before it ends, at fractions of its interval in [0, 1]"
    )
    return interval


def _read_shell(node: Node, n: int) -> Shell:
    start, end, cases = node.keys("start", "end", "cases")
    node.require_digests()
    shell = Shell(start.number(), end.number(), read_cases(cases, n))
    node.require(0 <= shell.start < shell.end <= 1, "must have levels that rise within [0, 1]")
    return shell


def read_goal(node: Node, claim: Claim) -> tuple[list, int, Any, list[Shell]]:
    """Axes, order of the Taylor models, weight of the S-lemma, and the shells. These cover the levels [0, 1]."""
    axes, order, weight, items = node.keys("axes", "order", "weight", "shells")
    shells, reached = [_read_shell(item, claim.n) for item in items.items(at_least=1)], Q(0)
    node.require_digests()
    for i, shell in enumerate(shells):
        place = f"{items.place}[{i}]"
        require(
            shell.start == reached, place, f"starts at {rounded(shell.start):g}, must start at {rounded(reached):g}"
        )
        reached = shell.end
    items.require(reached == 1, f"ends at {rounded(reached):g}, must end at 1")
    require_few_terms(order, claim.n, MAX_ORDER, order.integer(2, MAX_ORDER - 2))
    return axes.array(claim.n, claim.n), order.value, weight.number(), shells


def read_notes(node: Node) -> dict[str, str]:
    node.require(isinstance(node.value, dict), "must be an object")
    node.require(len(node.value) <= MAX_NOTES, f"has {len(node.value)} entries, must have at most {MAX_NOTES}")
    node.require(all(isinstance(note, str) for note in node.value.values()), "must hold texts")
    return node.value


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
