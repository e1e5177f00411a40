"""Arithmetic on the entries of small matrices, some of which are known numbers.

An entry is an array [...] or a float. Zeros and ones that are known while a program is traced cost nothing in it: that
is how the structure of a robot's derivatives, two thirds of which are zero, is used without naming any robot.
"""

from collections.abc import Callable, Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun
from jaxtyping import PyTree

from rtcd_jax.numerics.loops import on_gpu

Entry = jax.Array | float
Row = list[Entry]
Matrix = list[Row]


def times(a: Entry, b: Entry) -> Entry:
    """a b."""
    for one, other in ((a, b), (b, a)):
        if isinstance(one, float) and one in (0.0, 1.0):
            return other if one else 0.0
    return a * b


def plus(*terms: Entry) -> Entry:
    """The sum of the terms."""
    present = [term for term in terms if not (isinstance(term, float) and term == 0)]
    return sum(present[1:], present[0]) if present else 0.0


def dot(a: Iterable[Entry], b: Iterable[Entry]) -> Entry:
    """The sum of the products."""
    return plus(*(times(x, y) for x, y in zip(a, b, strict=True)))


def held(entries: PyTree, one: jax.Array) -> PyTree:
    """The same entries, computed once: the compiler repeats a fused computation wherever its result is used.

    Barriers are gone before a CPU's compiler fuses. What it never repeats is an operation that it counts as expensive:
    there the entries are divided by `one`, an array that is 1 without its knowing.
    """
    arrays, numbers = eqx.partition(entries, eqx.is_array)
    if on_gpu():
        return eqx.combine(jax.lax.optimization_barrier(arrays), numbers)
    return eqx.combine(jax.tree.map(lambda entry: entry / one, arrays), numbers)


def dependent(f: Callable, *args: PyTree) -> list[bool]:
    """For every output of f, whether any operation before it takes an argument."""
    return _traced(f, *args)[1]


def known(f: Callable, *args: PyTree) -> list[float | None]:
    """For every output of f, its value if it does not depend on the arguments, else None.

    `args` are pytrees of scalars or of their shapes. An output depends on what any operation before it depends on.
    """
    jaxpr, touched = _traced(f, *args)
    with jax.ensure_compile_time_eval():
        values = jaxpr_as_fun(jaxpr)(*(jnp.ones(v.aval.shape, v.aval.dtype) for v in jaxpr.jaxpr.invars))
    return [None if depends else float(v) for depends, v in zip(touched, values, strict=True)]


def _traced(f: Callable, *args: PyTree) -> tuple[ClosedJaxpr, list[bool]]:
    """The program of f, and which of its outputs depend on the arguments."""
    jaxpr = jax.make_jaxpr(f)(*args)
    reached = set(jaxpr.jaxpr.invars)
    touched = lambda atom: not isinstance(atom, Literal) and atom in reached  # noqa: E731
    for equation in jaxpr.eqns:
        if any(touched(atom) for atom in equation.invars):
            reached.update(equation.outvars)
    return jaxpr, [touched(atom) for atom in jaxpr.jaxpr.outvars]


def unstacked(f: Callable) -> Callable:
    """The components of f's array as a tuple: those that f stacked last, if it did, before they were stacked."""

    def components(*args):
        jaxpr = jax.make_jaxpr(f)(*args)
        last = jaxpr.eqns[-1]
        if last.primitive.name != "stack" or last.outvars != jaxpr.jaxpr.outvars or last.params["axis"] != 0:
            return tuple(f(*args))
        before = jaxpr.replace(jaxpr=jaxpr.jaxpr.replace(eqns=jaxpr.eqns[:-1], outvars=list(last.invars)))
        return tuple(jaxpr_as_fun(before)(*jax.tree.leaves(args)))

    return components
