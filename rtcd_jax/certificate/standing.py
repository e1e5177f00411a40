"""Whether a stored certificate proves a stored elite: the one answer that reports and exports give.

It does if the checker accepts the very file, and if the closed loop that the file claims is the elite's: robot,
parameters, limits, dt, x, u, K, x_goal and K_goal bit by bit, and the rates, a reset and a catch set to within their
rounding.

Checking takes seconds. Verdicts are therefore cached in the user's own cache, by the digests of the file and of the
checker's source. No verdict is read from a run folder, which may come from anybody.
"""

import hashlib
import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, final

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Claim, Damaged, Node, Refused, Report, Undecided
from rtcd_jax.certificate.prove.closed_loop import claim_of
from rtcd_jax.certificate.prove.robot import ClaimedRobot, claimed_robot
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import task_folders
from rtcd_jax.system.errors import UserError, printable
from rtcd_jax.system.files import replace_json, user_cache

RATE_ROUNDING = 1e-12
"""Share of the largest rate by which another machine's sine may change one."""

FUNCTION_ROUNDING = 1e-12
"""Share of the largest coefficient by which another derivation may round a function of the robot."""

SET_ROUNDING = 1e-6
"""Share of the elite's last level by which a catch set's may be larger."""

ROBOTS = 8
"""Of a box, by which functions of its numbers are told apart: two that differ are equal almost nowhere."""

Verdict = Literal["proved", "missing", "damaged", "of another elite", "refused", "undecided"]


@final
@dataclass(frozen=True)
class Standing:
    """What an elite's certificate is worth. Only where `proved` are the numbers below more than their defaults.

    `reason` says what is missing to a proof. `claim` is the SHA-256 of the claim as `rtcd check` prints it, `sha256`
    that of the file; from `start` [s] on, in so many intervals, the `volumes` are proved by name.
    """

    verdict: Verdict
    reason: str = ""
    claim: str = ""
    sha256: str = ""
    start: float = 0.0
    intervals: int = 0
    volumes: Mapping[str, float] = field(default_factory=dict)

    @property
    def proved(self) -> bool:
        return self.verdict == "proved"


def certificate_path(run: Path, name: str) -> Path:
    """Where a run folder keeps the certificate of an elite."""
    return run / "certificates" / f"{name}.json"


def standing(run: Path, name: str, progress: Callable[[int, int], None] = lambda done, of: None) -> Standing:
    """What `certificates/NAME.json` of a run folder is worth for the folder's elite NAME.

    `progress(done, of)` gets the number of intervals while the checker runs.

    Raises:
        UserError: the elite cannot be read.
    """
    if not certificate_path(run, name).is_file():
        return Standing("missing", f"{certificate_path(run, name)} is not there")
    return standing_of(certificate_path(run, name), Elite.read(run, name), progress)


def standing_of(
    path: Path,
    elite: Elite,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Standing:
    """What the certificate at `path` is worth for an elite."""
    try:
        file = check.read_bytes(path)
        content = check.parse(file)
        claim = check.read_claim(Node("certificate.claim", content["claim"]))
    except OSError as error:
        return Standing("missing", f"{path}: {error.strerror}")
    except Undecided as undecided:
        return Standing("undecided", f"{path}: {undecided}")
    except (Refused, KeyError, TypeError, RecursionError) as error:
        return Standing("damaged", f"{path} is no certificate: {error}")
    try:
        other = difference(content["claim"], claim, elite)
    except UserError as error:
        other = str(error)
    if other:
        return Standing("of another elite", f"{path} is of another elite: {other}")
    digest = hashlib.sha256(file).hexdigest()
    return _remembered(digest) or _checked(content, digest, progress)


def open_cycle(run: Path, name: str) -> str:
    """Why the certificates of a cycle's tasks do not prove it for the elite NAME; empty if they do."""
    motions = []
    for folder in task_folders(run):
        found = standing(folder, name)
        if not found.proved:
            return f"the certificate of {folder.name} is {found.verdict}"
        content = check.parse(check.read_bytes(certificate_path(folder, name)))
        claim = check.read_claim(Node("certificate.claim", content["claim"]))
        motions.append((claim, check.read_interval(Node("funnel[0]", content["funnel"][0]), claim).first))
    try:
        check.require_cycle(motions)
    except Refused as refused:
        return str(refused)
    return ""


def difference(content: Mapping[str, Any], claim: Claim, elite: Elite) -> str:
    """The first number of a claim that is not the stored elite's, with both; empty if there is none.

    `content` is the file's, `claim` what the checker reads in it. Of a number that is uncertain in the claim, the
    elite's own must lie between its bounds. Mass matrix, potential, dampers and motor are compared as functions of the
    positions, of the elite's robot and of others of the claim's box.
    """
    robot = claimed_robot(elite)
    for key in ("name", "states", "units", "input_unit", "joints"):
        theirs, ours = getattr(claim.robot, key), getattr(robot.description, key)
        if theirs != ours:
            return f"robot.{key} is {printable(theirs, 80)} there, {printable(ours, 80)} in the elite"
    if text := _outside("limit", claim.limits, robot.limit):
        return text
    for numbers in _robots(claim, robot, elite):
        for name, ends in claim.parameters.items():
            if name not in numbers:
                return f"parameters.{printable(name)} is no number of the elite"
            if text := _outside(f"parameters.{name}", ends, numbers[name]):
                return text
        if text := _another(claim.robot, robot.description, numbers):
            return text
    stored = claim_of(elite)
    largest = np.max(np.abs([float.fromhex(rate) for rate in np.ravel(stored["rates"])]))
    theirs, ours = (about.get("keep_out", []) for about in (content, stored))
    if check.digest(theirs) != check.digest(ours):
        return f"keep_out has {len(theirs)} sets there, {len(ours)} in the elite, and these are not the same"
    if text := _another_end(claim, elite):
        return text
    for key in (key for key in _OF_THE_LOOP if key in stored):
        text = _difference(key, content[key], stored[key], RATE_ROUNDING * largest if key == "rates" else 0.0)
        if text:
            return text
    return ""


_OF_THE_LOOP = ("state_limits", "dt", "x", "u", "K", "x_goal", "K_goal", "rates")
"""The rates last: they follow from the others."""


def _another_end(claim: Claim, elite: Elite) -> str:
    """Why a claim's motion does not end in the elite's way: held at the goal, in its catch set, or behind its reset."""
    if (claim.catch is not None) != elite.caught:
        return "its motion is held at the goal, and one of them ends in a catch set"
    if claim.catch is None:
        return ""
    catch, cyclic = claim.catch, "reset" in elite.record["catch"]
    if catch.reset is None:
        axes = np.array([[float(c) for c in row] for row in catch.axes])
        inside = np.linalg.eigvalsh(axes.T @ elite.S[-1] @ axes)[-1] <= elite.rho[-1] * (1 + SET_ROUNDING)
        there = all(float(c) == x for c, x in zip(catch.center, elite.x_goal, strict=True))
        return "" if inside and there else "its catch set is not in the elite's"
    if not cyclic:
        return "its motion ends with a reset there"
    from rtcd_jax.certificate.prove.reset import reset_of  # which needs JAX, as few others do here

    ours, theirs = reset_of(elite), catch.reset
    numbers = claimed_robot(elite).numbers
    same = (theirs.positions, theirs.turns) == (ours.positions, ours.turns) and all(
        _same_number(theirs.numbers[name], ours.numbers[name]) for name in ours.numbers
    )
    if not same:
        return "its reset is another one there"
    pair = (_coefficients(each.momentum, numbers) for each in (theirs, ours))
    for a, b in zip(*pair, strict=True):
        if _differ(a, b):
            return "its reset's momentum is another one there"
    return ""


def _same_number(theirs: Any, ours: Any) -> bool:
    """Two names, or two numbers up to their rounding."""
    if isinstance(theirs, str) or isinstance(ours, str):
        return theirs == ours
    return abs(float(theirs) - float(ours)) <= FUNCTION_ROUNDING * abs(float(ours))


def _robots(claim: Claim, robot: ClaimedRobot, elite: Elite) -> Iterator[dict[str, float]]:
    """The numbers of the elite's robot, then of random ones of the claim's box."""
    yield {**elite.parameters, **robot.numbers}
    box = {name: (float(low), float(high)) for name, (low, high) in claim.parameters.items() if low < high}
    box = {name: ends for name, ends in box.items() if name in robot.numbers}
    random = np.random.default_rng(0)
    for _ in range(ROBOTS if box else 0):
        numbers = {**elite.parameters, **robot.numbers}
        numbers |= {name: float(random.uniform(*ends)) for name, ends in box.items()}
        yield numbers | {name: polynomial.at(numbers) for name, polynomial in robot.derived.items()}


def _outside(place: str, ends: tuple[Any, Any], value: float) -> str:
    low, high = map(float, ends)
    if low <= value <= high:
        return ""
    theirs = f"= {low!r}" if low == high else f"in [{low!r}, {high!r}]"
    return f"{place} {theirs} there, {value!r} in the elite"


def _another(theirs: check.Robot, ours: check.Robot, numbers: Mapping[str, float]) -> str:
    """The first function of the positions that is another than the elite's, beyond rounding."""
    for key in ("mass", "potential", "damping", "motor"):
        pair = (_coefficients(getattr(robot, key), numbers) for robot in (theirs, ours))
        for place, a, b in zip(itertools.count(), *pair, strict=False):
            if _differ(a, b, constant=key != "potential"):
                return f"robot.{key}: function {place} is another there"
    return ""


def _differ(theirs: Mapping[tuple[int, ...], Any], ours: Mapping[tuple[int, ...], Any], constant: bool = True) -> bool:
    """Whether coefficients by the term's joints differ beyond rounding; `constant`: that of no joint counts, too."""
    largest = max((np.abs(c).max() for c in ours.values()), default=0.0)
    terms = [k for k in {*theirs, *ours} if constant or any(k)]
    return any(np.abs(theirs.get(k, 0.0) - ours.get(k, 0.0)).max() > FUNCTION_ROUNDING * largest for k in terms)


def _coefficients(functions: Any, numbers: Mapping[str, float]) -> list[dict[tuple[int, ...], Any]]:
    """Of every function, cosine's and sine's coefficient by the term's joints, for one robot."""
    if not functions or isinstance(functions[0], check.Term):
        total: dict[tuple[int, ...], Any] = {}
        for joints, powers, cosine, sine in functions:
            factor = math.prod(numbers[name] ** power for name, power in powers)
            total[joints] = total.get(joints, 0.0) + factor * np.array([float(cosine), float(sine)])
        return [total]
    return [each for function in functions for each in _coefficients(function, numbers)]


def _difference(place: str, claimed: Any, stored: Any, tolerance: float) -> str:
    if isinstance(stored, dict):
        pairs = [(f"{place}.{key}", claimed[key], value) for key, value in stored.items()]
    elif isinstance(stored, list):
        if len(claimed) != len(stored):
            return f"{place} has {len(claimed)} entries there, {len(stored)} in the elite"
        pairs = [(f"{place}[{i}]", *both) for i, both in enumerate(zip(claimed, stored, strict=True))]
    elif claimed == stored:
        return ""
    elif claimed is None or stored is None:
        return f"{place} is {_shown(claimed)} there, {_shown(stored)} in the elite"
    else:
        theirs, ours = float.fromhex(claimed), float.fromhex(stored)
        return "" if abs(theirs - ours) <= tolerance else f"{place} = {theirs!r} there, {ours!r} in the elite"
    return next(filter(None, (_difference(*pair, tolerance) for pair in pairs)), "")


def _shown(value: str | None) -> str:
    return "none" if value is None else repr(float.fromhex(value))


def _checked(content: Any, digest: str, progress: Callable[[int, int], None]) -> Standing:
    """The checker's verdict on a file of this digest."""
    try:
        with check.within(check.SECONDS):
            return remember(digest, accepted(check.check(content, progress), digest))
    except Undecided as undecided:
        return Standing("undecided", str(undecided))
    except Damaged as damaged:
        return remember(digest, Standing("damaged", str(damaged)))
    except Refused as refused:
        return remember(digest, Standing("refused", str(refused)))


def accepted(report: Report, digest: str) -> Standing:
    """A proof: what the checker reports of a file of this digest."""
    return Standing("proved", "", report.digest, digest, report.start, report.intervals, report.volumes)


# The cache ------------------------------------------------------------------------------------------------------------


def remember(digest: str, verdict: Standing) -> Standing:
    """Caches the checker's verdict on a file of this digest, where the user has a cache; returns the same verdict."""
    path = _cached(digest)
    with suppress(UserError, OSError):  # a home that cannot be written only costs time
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        replace_json(path, asdict(verdict))
    return verdict


def _remembered(digest: str) -> Standing | None:
    with suppress(OSError, ValueError, TypeError):
        return Standing(**json.loads(_cached(digest).read_bytes()))
    return None


def _cached(digest: str) -> Path:
    return user_cache() / "verdicts" / f"{digest}-{checker_digest()}.json"


@cache
def checker_digest() -> str:
    """The SHA-256 of the checker's source: the verdicts of another checker do not count."""
    total = hashlib.sha256()
    for source in sorted(Path(check.__file__).parent.glob("*.py")):
        content = source.read_bytes()
        total.update(f"{source.name} {len(content)}\n".encode() + content)
    return total.hexdigest()
