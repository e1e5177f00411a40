"""Loops as the device wants them.

A CPU calls a loop's compiled body again and again, and wants it small. On a GPU every operation of a body that is not
fused is a launch, and a loop whose body is launches alone goes whole into one CUDA graph: there, short loops are
unrolled, and the loops over knots carry, read and write one array each. The mathematics is the same, and so are a CPU's
bits.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import jax
import jax.numpy as jnp

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


def short_scan(f: Callable, init, xs=None, length: int | None = None):
    """`jax.lax.scan` over a few steps: a loop on a CPU, written out on a GPU."""
    return jax.lax.scan(f, init, xs, length=length, unroll=on_gpu() or 1)


def repeat(times: int, f: Callable, init):
    """f(f(… init)), a few times: a loop on a CPU, written out on a GPU."""
    return short_scan(lambda carry, _: (f(carry), None), init, length=times)[0]


def packed_scan(f: Callable, init, xs, *, reverse: bool = False, unroll: int = 1):
    """`jax.lax.scan` with one array each for the carry [C …], the inputs [N X …] and the outputs [N Y …].

    The leaves of the carry broadcast to one shape, so do those of a step's inputs and of its outputs; they are numbers
    of one floating dtype, or booleans, which are packed as 0 and 1. On a GPU, `unroll` steps stand in the loop's body.
    """
    start, carry_layout = _pack(init, 0)
    inputs, input_layout = _pack(xs, 1)
    output_layout = None

    def step(carry, x):
        nonlocal output_layout
        carry, y = f(_unpack(carry, carry_layout, 0), _unpack(x, input_layout, 0))
        y, output_layout = _pack(y, 0)
        return _pack(carry, 0)[0], y

    carry, ys = jax.lax.scan(step, start, inputs, reverse=reverse, unroll=unroll if on_gpu() else 1)
    return _unpack(carry, carry_layout, 0), _unpack(ys, output_layout, 1)


def _pack(tree, axis: int):
    leaves, structure = jax.tree.flatten(tree)
    leaves = jnp.broadcast_arrays(*leaves)
    dtypes = [leaf.dtype for leaf in leaves]
    number = jnp.result_type(*(dtype for dtype in dtypes if dtype != bool))
    return jnp.stack([leaf.astype(number) for leaf in leaves], axis), (structure, dtypes)


def _unpack(packed, layout, axis: int):
    structure, dtypes = layout
    leaves = (jax.lax.index_in_dim(packed, i, axis, keepdims=False) for i in range(len(dtypes)))
    return structure.unflatten([leaf != 0 if dtype == bool else leaf for leaf, dtype in zip(leaves, dtypes, strict=True)])
