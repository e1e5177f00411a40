"""`rtcd falsify`: does any of a great many simulated motions break what a certificate says?

A proof that is right is not falsified; a prover, a checker and a model that share a mistake would be.
"""

import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, final

import numpy as np

from rtcd_jax.certificate.motions import REPEATED, Motions, Seen
from rtcd_jax.console import Console

CHUNK = 16384
"""Motions simulated together: their states stay in the processor's cache."""
PILOT = 512
FEWEST, MOST = 4, 128
"""Steps an interval, doubled until the integrator's error is small."""
TOLERANCE = 1e-5
"""In |y|, of the pilot's motions."""
ROUNDING = 1e-12


class Found(NamedTuple):
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


@final
@dataclass(frozen=True)
class Progress:
    """`done` of `total` motions."""

    done: int
    total: int
    level: float
    elapsed: float

    def __str__(self) -> str:
        left = self.elapsed * (self.total / self.done - 1)
        return (
            f"{self.done}/{self.total} motions  largest |y| {self.level:.9f}"
            f"  elapsed {self.elapsed:.0f} s  left {left:.0f} s"
        )


def falsify_file(path: Path, rollouts: int, seed: int, workers: int, console: Console) -> bool:
    """Simulates `rollouts` motions of a certificate; True if none broke it. The workers' number changes nothing.

    Raises:
        UserError: no certificate.
    """
    motions = Motions.of(path)
    steps = enough_steps(motions, seed)
    began, seen, done = time.monotonic(), [], 0
    for each in _chunks(path, rollouts, seed, steps, workers):
        seen.append(each)
        done += len(each.level)
        level = max(float(one.level.max()) for one in seen)
        console.progress(Progress(done, rollouts, level, time.monotonic() - began))
    found = summed(seen, steps)
    console.message(sentence(motions, found))
    return found.broken == 0


def enough_steps(motions: Motions, seed: int) -> int:
    """Steps an interval with which halved steps change a few hundred motions' |y| by `TOLERANCE` at most."""
    steps = FEWEST
    while steps < MOST and motions.follow(PILOT, steps, np.random.default_rng(seed)).error > TOLERANCE:
        steps *= 2
    return steps


def _chunks(path: Path, rollouts: int, seed: int, steps: int, workers: int) -> Iterator[Seen]:
    sizes = [min(CHUNK, rollouts - start) for start in range(0, rollouts, CHUNK)]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(sizes)), context, _remember, (path,)) as pool:
        try:
            yield from pool.map(_work, sizes, [(seed, i) for i in range(len(sizes))], [steps] * len(sizes))
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


_motions: Motions


def _remember(path: Path) -> None:
    """In a worker: the certificate."""
    global _motions
    _motions = Motions.of(path)


def _work(count: int, seed: tuple[int, int], steps: int) -> Seen:
    return _motions.follow(count, steps, np.random.default_rng(seed))


def summed(seen: list[Seen], steps: int) -> Found:
    """All chunks together."""
    error = max(each.error for each in seen)
    allowance = 2 * error + ROUNDING
    level, share, growth, arrived = (np.concatenate(each) for each in zip(*(s[:4] for s in seen), strict=True))
    return Found(
        rollouts=len(level),
        steps=steps,
        left_funnel=int(np.sum(~(level <= 1 + allowance))),
        left_limits=int(np.sum(~(share <= 1 + allowance))),
        moved_away=int(np.sum(~(growth <= allowance))),
        not_arrived=int(np.sum(~arrived)),
        level=float(level.max()),
        share_of_limit=float(share.max()),
        error=error,
        allowance=allowance,
    )


def sentence(motions: Motions, found: Found) -> str:
    """What was seen, in plain words."""
    nearest = f"closest {found.share_of_limit:.6f} of it" if found.share_of_limit else "there is none"
    return (
        f"{found.rollouts} simulated motions of the {motions.plant} from instants all over [{motions.start:.6g} s, "
        f"{motions.end:.6g} s], half of them from the funnel's boundary: {found.left_funnel} left the funnel (largest "
        f"|y| after the start {found.level:.9f}), {found.left_limits} exceeded a limit on the states "
        f"({nearest}), {found.moved_away} moved away from the goal in the goal region, "
        f"{found.not_arrived} did not arrive. Integrator: {found.steps} classical Runge-Kutta steps an interval; "
        f"halved steps change |y| of every {REPEATED}th motion by {found.error:.2g} at most; beyond 1 counts from "
        f"{found.allowance:.2g} on."
    )
