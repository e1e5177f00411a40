"""A cycle of tasks, closed by proof: the reset at the end of each leads into the first proved ellipsoid of the next."""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Catch, Claim, Node, Refused
from rtcd_jax.certificate.prove.catch import catch_proof, largest_level
from rtcd_jax.certificate.prove.certify import COARSER, catch_end_record, unproved, write_certificate
from rtcd_jax.certificate.prove.closed_loop import Loop, catch_record, on_grid, with_digests
from rtcd_jax.certificate.prove.levels import last_level, leveled, unit_directions
from rtcd_jax.certificate.prove.reset import reset_of, reset_record
from rtcd_jax.certificate.standing import certificate_path
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import task_folders
from rtcd_jax.system.console import Console, Progress
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import read_json

_ADVICE = "remove it, and certify the run again"
LIKELY = 0.95
"""Level after a reset below which a cycle is likely to be closed by proof."""
HALVINGS = 6
"""Of the share, among which one is looked for."""


class Motion(NamedTuple):
    """A task's certificate: its file and what it holds, its elite, its claim, and the axes of its ends."""

    path: Path
    content: dict[str, Any]
    elite: Elite
    claim: Claim
    first: list
    last: list

    @classmethod
    def of(cls, folder: Path, name: str) -> "Motion":
        """Raises UserError if there is none, or one that cannot be read."""
        path = certificate_path(folder, name)
        content = read_json(path, _ADVICE)
        try:
            claim = check.read_claim(Node("claim", content["claim"]))
            first, last = (check.read_interval(Node("funnel", content["funnel"][i]), claim) for i in (0, -1))
        except (Refused, KeyError, TypeError, IndexError) as error:
            raise UserError(f"{path} is no certificate ({error}): {_ADVICE}") from None
        return cls(path, content, Elite.read(folder, name), claim, first.first, last.last)


def foresee(run: Path, names: Sequence[str], share: float, uncertainty: Path | None, console: Console) -> None:
    """Says which elites' cycles will hardly close at this share of the sampled levels, and at which one they may: by
    levels that nothing proves yet. Of elites that are proved on every task nothing is said.
    """
    folders = task_folders(run)
    for name in names:
        if all(certificate_path(folder, name).is_file() for folder in folders):
            continue
        elites = [Elite.read(folder, name) for folder in folders]
        claims = [unproved(elite, uncertainty) for elite in elites]
        level = _foreseen(claims, elites, share)
        if level < LIKELY:
            continue
        smaller = (share / 2**halvings for halvings in range(1, HALVINGS + 1))
        closes = next((each for each in smaller if _foreseen(claims, elites, each) < LIKELY), None)
        hint = "no smaller --share seems to close it" if closes is None else f"--share {closes:.2g} may close it"
        console.message(
            f"elite {name}: the cycle will hardly close: after a reset V may be {level:.3g} of the next funnel's first "
            f"level (sampled), must be below 1; {hint}"
        )


def _foreseen(claims: Sequence[Claim], elites: Sequence[Elite], share: float) -> float:
    """The largest level in the next first ellipsoid after any of the resets; infinite where there is no funnel."""
    directions, ends = unit_directions(claims[0].n)[:, ::COARSER], []
    try:
        for claim, elite in zip(claims, elites, strict=True):
            loop = Loop(claim, elite, share=share)
            ends.append(
                (leveled(loop, directions).axes(0, 0.0, 1.0, 0.0)[0], loop.outlet_axes(last_level(loop, directions)))
            )
        levels = []
        for i, (claim, (_, outlet)) in enumerate(zip(claims, ends, strict=True)):
            ahead = (i + 1) % len(claims)
            led = Catch(claims[ahead].x[0], on_grid(ends[ahead][0]), reset_of(elites[i], elites[ahead]))
            levels.append(largest_level(claim._replace(catch=led), outlet))
    except Refused:
        return np.inf
    return max(levels)


def close_cycle(run: Path, names: Sequence[str], guarantee: str, solver: str, console: Console) -> bool:
    """Closes the cycles of a run's elites, and says which; True if all of them are.

    Every task's certificate is written anew with what the reset makes of its last ellipsoid. Those whose funnels are
    not there from t = 0 on stay as they are.

    Raises:
        UserError: certificates that cannot be read, or a robot whose reset no claim knows.
    """
    closed = [_closed(run, name, guarantee, solver, console) for name in names]
    return all(closed)


def _closed(run: Path, name: str, guarantee: str, solver: str, console: Console) -> bool:
    folders = task_folders(run)
    there = [folder for folder in folders if certificate_path(folder, name).is_file()]
    motions = [Motion.of(folder, name) for folder in there]
    begun = [folder.name for folder, motion in zip(there, motions, strict=True) if motion.claim.start == (0, 0)]
    if missing := [folder.name for folder in folders if folder.name not in begun]:
        console.message(f"elite {name}: no cycle, since the funnel of {missing[0]} is not shown from t = 0 on")
        return False
    followed = list(zip(folders, motions, [*motions[1:], motions[0]], strict=True))
    written, closed = [], True
    for folder, motion, ahead in followed:
        content, level = _led(motion, ahead, guarantee, solver)
        written.append(content)
        if content is None:
            closed = False
            console.message(
                f"elite {name}: no cycle, the reset after {folder.name} is not shown to lead into the next funnel: V "
                f"is up to {level:.3g} of its first level, must be below 1; it is smaller with a smaller --share"
            )
    if not closed:
        return False

    def checking(done: int, of: int) -> None:
        console.progress(Progress(done, of, f"elite {name}  checking the file, interval {done}/{of}"))

    for motion, content in zip(motions, written, strict=True):
        if content != motion.content:
            write_certificate(motion.path, content, guarantee, checking)
    motions = [Motion.of(folder, name) for folder in folders]
    check.require_cycle([(motion.claim, motion.first) for motion in motions])
    files = " ".join(str(motion.path) for motion in motions)
    console.message(f"elite {name}: the cycle is closed ({guarantee}); `rtcd check --cycle {files}` checks it")
    return True


def _led(motion: Motion, ahead: Motion, guarantee: str, solver: str) -> tuple[dict[str, Any] | None, float]:
    """A motion's certificate with its reset into the first ellipsoid of the motion that is ahead, None where that is
    not shown; and the largest level there of a state that is led.
    """
    content = copy.copy(motion.content)
    center, axes = ahead.content["claim"]["x"][0], ahead.content["funnel"][0]["first"]
    about = {key: value for key, value in content["claim"].items() if key != "sha256"}
    about["catch"] = catch_record(center, axes, reset=reset_record(reset_of(motion.elite, ahead.elite)))
    if with_digests(about) == content["claim"]:
        return content, 0.0
    claim = check.read_claim(Node("claim", with_digests(about)))
    try:
        cases = catch_proof(claim, motion.last, guarantee == "proved", solver)
    except Refused:
        cases = None
    if cases is None:
        return None, largest_level(claim, motion.last)
    content |= {"claim": with_digests(about), "catch": catch_end_record(*cases)}
    return with_digests({key: value for key, value in content.items() if key != "sha256"}), 0.0
