"""`rtcd falsify`: simulates many motions and counts those that contradict a certificate.

No motion contradicts a correct proof. A mistake that prover, checker and model share would show.
"""

import hashlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rtcd_jax.certificate.falsify.simulation import REPEATED, MotionResults, Motions
from rtcd_jax.system.console import Clock, Console, Progress
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.journal import Journal
from rtcd_jax.system.processes import processes

CHUNK = 16384
"""Motions simulated together: their states stay in the processor's cache."""
PILOT = 512
FEWEST, MOST = 4, 128
"""Steps an interval, doubled until the integrator's error is small."""
TOLERANCE = 1e-5
"""In |y|, of the pilot's motions."""
ROUNDING = 1e-12


class Summary(NamedTuple):
    """Counts of motions, by what they broke, and the extremes of all.

    `allowance` is what |y| may exceed 1 by: twice the largest difference that halved steps made, and rounding.
    """

    rollouts: int
    steps: int
    left_funnel: int
    left_limits: int
    moved_away: int
    not_arrived: int
    level: float
    share_of_limit: float
    error: float
    allowance: float

    @property
    def broken(self) -> int:
        """How often the certificate was broken."""
        return self.left_funnel + self.left_limits + self.moved_away + self.not_arrived


class Part(NamedTuple):
    """Of some motions: how many, the extremes, and what is beyond 1 or, in the goal region, grows."""

    rollouts: int
    level: float
    share_of_limit: float
    error: float
    levels: list[float]
    shares: list[float]
    growths: list[float]
    not_arrived: int

    @classmethod
    def of(cls, results: MotionResults) -> "Part":
        level, share, growth = results.level, results.share_of_limit, results.growth
        levels, shares, growths = level[~(level <= 1)], share[~(share <= 1)], growth[~(growth <= 0)]
        return cls(
            len(level), float(level.max()), float(share.max()), float(results.error),
            levels.tolist(), shares.tolist(), growths.tolist(), int(np.sum(~results.arrived)),
        )  # fmt: skip


def falsify_file(path: Path, rollouts: int, seed: int, workers: int, console: Console, beyond: float = 1.0) -> bool:
    """Simulates `rollouts` motions of a certificate; True if none broke it. The workers' number changes nothing.

    What the certificate leaves uncertain is drawn, its half widths `beyond` times as large; beyond 1 nothing is proved.
    A journal beside the certificate keeps finished parts: after a kill the same command goes on.

    Raises:
        UserError: no certificate, one that cannot be simulated, or a folder that cannot be written.
    """
    motions = Motions.of(path, beyond)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    head = {"certificate": digest, "rollouts": rollouts, "seed": seed, "chunk": CHUNK, "beyond": beyond}
    journal = Journal(path.with_name(f".{path.stem}.falsify.jsonl"), head)
    steps = enough_steps(motions, seed)
    finished = len(journal.lines)
    parts = [Part(**line) for line in journal.lines]
    clock = Clock(before=sum(part.rollouts for part in parts))
    for part in _parts((path, beyond), rollouts, seed, steps, workers, finished):
        journal.append(part._asdict())
        parts.append(part)
        done, level = sum(each.rollouts for each in parts), max(each.level for each in parts)
        text = f"{done}/{rollouts} motions  largest |y| {level:.9f}  {clock.times(done, rollouts)}"
        console.progress(Progress(done, rollouts, text))
    journal.close()
    summary = summed(parts, steps)
    console.message(sentence(motions, summary))
    return summary.broken == 0


def enough_steps(motions: Motions, seed: int) -> int:
    """Steps an interval with which halved steps change a few hundred motions' |y| by `TOLERANCE` at most.

    It is relative to the largest |y| where that is beyond 1: the motions that went so far refute the certificate.

    Raises:
        UserError: with the most steps, too, the states are no numbers any more.
    """
    steps = FEWEST
    while True:
        pilot = motions.follow(PILOT, steps, np.random.default_rng(seed))
        if pilot.error <= TOLERANCE * max(1.0, pilot.level.max()):
            return steps
        finite = np.isfinite([pilot.error, *pilot.level, *pilot.growth]).all()
        if steps == MOST:
            break
        steps = 2 * steps if finite else MOST
    if not finite:
        raise UserError(
            f"the motions of this certificate cannot be simulated: with {steps} steps an interval they leave the range "
            "of doubles; `rtcd check` says whether it proves anything"
        )
    return steps


def _parts(
    what: tuple[Path, float], rollouts: int, seed: int, steps: int, workers: int, finished: int
) -> Iterator[Part]:
    """The parts in their order, from the first unfinished one."""
    sizes = [min(CHUNK, rollouts - start) for start in range(0, rollouts, CHUNK)][finished:]
    if not sizes:
        return
    with processes(min(workers, len(sizes)), _remember, what) as pool:
        seeds = [(seed, finished + i) for i in range(len(sizes))]
        yield from pool.map(_work, sizes, seeds, [steps] * len(sizes))


_motions: Motions


def _remember(what: tuple[Path, float]) -> None:
    """In a worker: the certificate, and how much more is uncertain."""
    global _motions
    _motions = Motions.of(*what)


def _work(count: int, seed: tuple[int, int], steps: int) -> Part:
    return Part.of(_motions.follow(count, steps, np.random.default_rng(seed)))


def summed(parts: list[Part], steps: int) -> Summary:
    """All parts together."""
    error = max(each.error for each in parts)
    allowance = 2 * error + ROUNDING

    def beyond(values: Iterable[list[float]], bound: float) -> int:
        return sum(not value <= bound + allowance for each in values for value in each)

    return Summary(
        rollouts=sum(each.rollouts for each in parts),
        steps=steps,
        left_funnel=beyond((each.levels for each in parts), 1),
        left_limits=beyond((each.shares for each in parts), 1),
        moved_away=beyond((each.growths for each in parts), 0),
        not_arrived=sum(each.not_arrived for each in parts),
        level=max(each.level for each in parts),
        share_of_limit=max(each.share_of_limit for each in parts),
        error=error,
        allowance=allowance,
    )


def sentence(motions: Motions, summary: Summary) -> str:
    """The summary in plain words."""
    nearest = f"closest {summary.share_of_limit:.6f} of it" if summary.share_of_limit else "there is none"
    times = f", all that is uncertain {motions.beyond:g} times as large as certified" if motions.beyond != 1 else ""
    catch = motions.claim.catch
    end = (
        f"{summary.moved_away} moved away from the goal in the goal region, {summary.not_arrived} did not arrive"
        if catch is None
        else f"{summary.not_arrived} {'were not led into' if catch.reset else 'did not end in'} the catch set"
    )
    return (
        f"{summary.rollouts} simulated motions of the {motions.plant} from instants all over [{motions.start:.6g} s, "
        f"{motions.end:.6g} s], half of them from the funnel's boundary{times}: {summary.left_funnel} left the funnel "
        f"(largest |y| after the start {summary.level:.9f}), {summary.left_limits} exceeded a limit on the states "
        f"({nearest}), {end}. Integrator: {summary.steps} classical Runge-Kutta steps an interval; "
        f"halved steps change |y| of every {REPEATED}th motion by {summary.error:.2g} at most; beyond 1 counts from "
        f"{summary.allowance:.2g} on."
    )
