"""A population over the devices of a cluster, chunk by chunk.

Every device evaluates chunks of one size by one program, whatever their number: where a candidate was evaluated, and
beside how many others, does not show in its result, down to the last bit on devices of one kind.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, cast, final

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key

from rtcd_jax.evaluation import Evaluate
from rtcd_jax.search.archive import Records, where
from rtcd_jax.system.cluster import Cluster
from rtcd_jax.types import Volumes

POLL = 0.01
"""Seconds between two looks at whether a chunk is done."""


class TaskOutcomes(NamedTuple):
    """Statuses and volumes, but for those of the knots, on every one of several tasks."""

    status: Int[Array | np.ndarray, "P T"]
    volumes: Volumes


@final
@dataclass(frozen=True)
class Sharded:
    """A population's evaluation. The numbers that a search needs are on the host, volumes but for those of the knots;
    whole records stay on the devices until they are taken."""

    genome: Float[np.ndarray, "P d"]
    status: Int[np.ndarray, " P"]
    volumes: Volumes
    borne: Float[np.ndarray, " P"] | None
    tasks: TaskOutcomes | None
    _parts: tuple[Records, ...]
    _fetch: Callable[[Records, np.ndarray], Records]

    def take(self, rows: Int[np.ndarray, " E"]) -> Records:
        """The whole records [E] of these candidates, in numpy."""
        size = self._parts[0].status.shape[0]
        first, *others = np.unique(rows // size)
        records = self._fetch(self._parts[first], rows % size)
        for index in others:
            part = self._fetch(self._parts[index], rows % size)
            records = jax.tree.map(partial(where, rows // size == index), part, records)
        return records


@final
class ShardedEvaluate:
    """`evaluate` for populations of any size, `chunk` candidates on every device of the cluster at a time.

    The genomes are process 0's. The last chunks are filled up with copies of the last genome. Between chunks the
    cluster checks whether it was asked to stop, and raises Preempted.
    """

    def __init__(self, evaluate: Evaluate, cluster: Cluster, chunk: int):
        self._cluster, self._size = cluster, chunk * len(cluster.devices)
        self._on_devices = cluster.shared(lambda genomes, key: evaluate(genomes, jax.random.wrap_key_data(key)))
        self._fetch = partial(_fetch, cluster, cluster.shared(partial(_rows, chunk)), chunk)

    def example(self, dims: int) -> Records:
        """The shapes of what all devices evaluate at a time, of genomes [P d] with d = `dims`. The program is traced,
        which the first call then does not.
        """
        return self._on_devices.trace(*self._arguments(np.zeros((self._size, dims)), jax.random.key(0))).out_info

    def __call__(self, genomes: Float[Array | np.ndarray, "P d"], key: Key[Array, ""]) -> Sharded:
        genomes = self._cluster.agreed(np.asarray(genomes))
        count = len(genomes)
        padded = np.concatenate([genomes, np.repeat(genomes[-1:], -count % self._size, 0)])
        chunks = np.split(padded, len(padded) // self._size)
        parts = [self._on_devices(*self._arguments(part, key)) for part in chunks]
        summaries = [_summary(self._cluster, part) for part in parts]
        status, volumes, borne, tasks = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *summaries)
        return Sharded(genomes, status, volumes, borne, tasks, tuple(parts), self._fetch)

    def _arguments(self, genomes: Float[np.ndarray, "P d"], key: Key[Array, ""]) -> tuple[Array, Array]:
        return self._cluster.split(genomes), self._cluster.replicated(jax.random.key_data(key))


def _summary(cluster: Cluster, part: Records) -> tuple[np.ndarray, Volumes, np.ndarray | None, TaskOutcomes | None]:
    """Statuses, volumes but those of the knots, what is borne, outcomes on several tasks: on the host as soon as the
    chunk is done.
    """
    done = cast(Any, part.status).is_ready
    while not done():
        time.sleep(POLL)
    cluster.raise_if_preempted()
    each = part.tasks
    tasks = None if each is None else TaskOutcomes(each.status, _of_the_whole(each.volumes))
    return cluster.gathered((part.status, _of_the_whole(part.volumes), part.borne, tasks))


def _of_the_whole(volumes: Volumes) -> Volumes:
    return replace(volumes, per_knot=volumes.per_knot[..., :0])


def _rows(chunk: int, part: Records, wanted: Int[Array, " E"]) -> Records:
    """On one device: its own candidates among the wanted ones, anything for the others."""
    inside = jnp.clip(wanted - chunk * jax.lax.axis_index("candidates"), 0, chunk - 1)
    return jax.tree.map(lambda leaf: leaf[inside], part)


def _fetch(cluster: Cluster, rows: Callable, chunk: int, part: Records, wanted: Int[np.ndarray, " E"]) -> Records:
    """The wanted records of a part, whose device is known by their place."""
    records = cluster.gathered(rows(part, cluster.replicated(wanted)))
    devices, count = len(cluster.devices), len(wanted)
    return jax.tree.map(
        lambda leaf: leaf.reshape(devices, count, *leaf.shape[1:])[wanted // chunk, np.arange(count)], records
    )
