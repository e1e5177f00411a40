"""Annotations are complete, and hold wherever the tests run the algorithm."""

import ast
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from jaxtyping import TypeCheckError

from rtcd_jax.config import load as configuration
from rtcd_jax.genome import decode
from rtcd_jax.problem import make_problem
from rtcd_jax.types import Policy, Trajectory
from tests.plants.robots import packaged

PACKAGE = Path(__file__).parent.parent / "rtcd_jax"
ANNOTATED = sorted([*PACKAGE.glob("*.py"), *PACKAGE.glob("plants/**/*.py"), *PACKAGE.glob("numerics/**/*.py")])


def _public(body: list[ast.stmt]):
    """The functions of a module or class that others may call, and a class's own `__init__` and `__call__`."""
    for node in body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from _public(node.body)
        elif isinstance(node, ast.FunctionDef) and (not node.name.startswith("_") or node.name in CALLED):
            yield node


CALLED = ("__init__", "__call__")


@pytest.mark.parametrize("path", ANNOTATED, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_public_functions_say_what_they_take_and_give(path):
    for function in _public(ast.parse(path.read_text()).body):
        arguments = function.args
        bare = [
            argument.arg
            for argument in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg)
            if argument is not None and argument.annotation is None and argument.arg not in ("self", "cls")
        ]
        if function.returns is None and function.name != "__init__":
            bare.append("return")
        assert not bare, f"{path.name}:{function.lineno} {function.name}"


def _trajectory(*batch: int, intervals=4, knots=5) -> Trajectory:
    number, count = jnp.zeros(batch), jnp.zeros(batch, jnp.int32)
    us, xs = jnp.zeros((*batch, intervals, 1)), jnp.zeros((*batch, knots, 2))
    return Trajectory(us, xs, dt=number, cost=number, defect=number, iterations=count, status=count)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_one_candidate_and_a_population_have_the_same_shapes(batch):
    assert _trajectory(*batch).xs.shape == (*batch, 5, 2)


def test_a_trajectory_has_one_knot_more_than_intervals():
    with pytest.raises(TypeCheckError, match="xs"):
        _trajectory(intervals=4, knots=4)


def test_axes_of_one_name_have_one_length():
    motion = _trajectory()
    with pytest.raises(TypeCheckError, match="values"):
        Policy(motion, gains=jnp.zeros((5, 1, 2)), values=jnp.zeros((5, 3, 3)), status=motion.status)
    with pytest.raises(TypeCheckError, match="status"):
        dataclasses.replace(motion, status=jnp.zeros(3, jnp.int32))


def test_functions_are_checked_inside_jit_and_vmap():
    design = packaged("pendulum").Design(jnp.asarray(0.7), jnp.asarray(0.4))
    assert packaged("pendulum").dynamics(design, jnp.zeros((2, 5)), jnp.zeros((1, 5))).shape == (2, 5)
    with pytest.raises(TypeCheckError, match="u"):
        jax.jit(packaged("pendulum").dynamics)(design, jnp.zeros((2, 5)), jnp.zeros((1, 4)))
    problem = make_problem(configuration.parse_yaml(configuration.EXAMPLE))
    genomes = jnp.full((3, len(problem.free)), 0.5)
    assert jax.vmap(lambda genome: decode(problem, genome))(genomes).q.shape == (3, 2)
    with pytest.raises(TypeCheckError, match="genome"):
        decode(problem, genomes)
