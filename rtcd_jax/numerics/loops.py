"""Loops as the device wants them.

A CPU calls a loop's compiled body again and again, and wants it small. On a GPU every operation of a body that is not
fused is a launch, and a loop whose body is launches alone goes whole into one CUDA graph: there, short loops are
unrolled, and the loops over knots carry, read and write one array each. The mathematics is the same, and so are a CPU's
bits.
"""

import itertools
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

_TARGET: ContextVar[str | None] = ContextVar("target", default=None)


@contextmanager
def compiled_for(platform: str) -> Iterator[None]:
    """Programs that are traced inside are made for `platform`, "cpu" or "cuda", whatever devices are here."""
    token = _TARGET.set(platform)
    try:
        yield
    finally:
        _TARGET.reset(token)


def on_gpu() -> bool:
    """Whether the program that is being traced is made for a GPU: JAX's default device, or as `compiled_for` says."""
    return (_TARGET.get() or jax.default_backend()) in ("gpu", "cuda", "rocm")


def short_scan(f: Callable, init: PyTree, xs: PyTree = None, length: int | None = None) -> tuple[PyTree, PyTree]:
    """`jax.lax.scan` over a few steps: a loop on a CPU, written out on a GPU."""
    return jax.lax.scan(f, init, xs, length=length, unroll=on_gpu() or 1)


def repeat(times: int, f: Callable, init: PyTree) -> PyTree:
    """f(f(… init)), a few times: a loop on a CPU, written out on a GPU."""
    return short_scan(lambda carry, _: (f(carry), None), init, length=times)[0]


def packed_scan(
    f: Callable,
    init: PyTree,
    xs: PyTree,
    *,
    shared: int = 0,
    unroll: int = 1,
    reverse: bool = False,
    carry: bool = True,
) -> tuple[PyTree, PyTree]:
    """`jax.lax.scan`; on a GPU with one array each for a step's inputs, its outputs and, if wanted, the carry.

    A scan reads and writes every leaf by an operation of its own, which no CUDA graph takes in. The last `shared` axes
    of every leaf have one shape, and stay; smaller leaves are broadcast to them. Leaves are numbers of one floating
    dtype, booleans and integers below 2^53. `unroll` steps stand in the body of a GPU's loop.
    """
    if not on_gpu():
        return jax.lax.scan(f, init, xs, reverse=reverse)
    inputs, start = _Layout.of(xs, shared, leading=1), _Layout.of(init, shared)
    outputs: list[_Layout] = []

    def step(packed, x):
        state, y = f(start.unpack(packed) if carry else packed, inputs.unpack(x))
        outputs.append(_Layout.of(y, shared))
        return start.pack(state) if carry else state, outputs[-1].pack(y)

    begin = start.pack(init) if carry else init
    end, ys = jax.lax.scan(step, begin, inputs.pack(xs, leading=1), reverse=reverse, unroll=unroll)
    return start.unpack(end) if carry else end, outputs[-1].unpack(ys, leading=1)


class _Layout(NamedTuple):
    """How the leaves of a tree stand in one array [*leading, sum of sizes, *shared]."""

    structure: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]  # without the leading and the shared axes
    dtypes: tuple
    shared: tuple[int, ...]
    number: jnp.dtype

    @classmethod
    def of(cls, tree, shared: int, leading: int = 0) -> "_Layout":
        leaves, structure = jax.tree.flatten(tree)
        leaves = [jnp.asarray(leaf) for leaf in leaves]
        own = tuple(leaf.shape[leading : max(leading, leaf.ndim - shared)] for leaf in leaves)
        common = jnp.broadcast_shapes(*(leaf.shape[leading + len(o) :] for leaf, o in zip(leaves, own, strict=True)))
        floating = [leaf.dtype for leaf in leaves if jnp.issubdtype(leaf.dtype, jnp.floating)]
        number = jnp.result_type(*floating) if floating else jnp.dtype(float)
        return cls(structure, own, tuple(leaf.dtype for leaf in leaves), common, number)

    def pack(self, tree, leading: int = 0):
        """One array of the tree's leaves."""
        if not self.shapes:
            return None
        parts = []
        for leaf, own in zip(self.structure.flatten_up_to(tree), self.shapes, strict=True):
            leaf = jnp.asarray(leaf, self.number)
            front = leaf.shape[:leading]
            leaf = jnp.broadcast_to(leaf, (*front, *own, *self.shared))
            parts.append(leaf.reshape(*front, math.prod(own), *self.shared))
        return jnp.concatenate(parts, leading)

    def unpack(self, packed, leading: int = 0):
        """The tree."""
        sizes = [math.prod(own) for own in self.shapes]
        ends = list(itertools.accumulate(sizes))
        leaves = []
        for own, dtype, size, end in zip(self.shapes, self.dtypes, sizes, ends, strict=True):
            leaf = jax.lax.slice_in_dim(packed, end - size, end, axis=leading)
            leaf = leaf.reshape(*packed.shape[:leading], *own, *self.shared)
            leaves.append(leaf.astype(dtype))
        return self.structure.unflatten(leaves)
