"""MJX: a plant's motion in pure JAX, for whole batches of designs.

A model without contacts and limits needs no derived constants, so that a design replaces a handful of the compiled
model's leaves.
"""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

import contextlib
import copy
import functools
import io
import operator
from collections.abc import Iterator, Mapping
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, DTypeLike, Float

from rtcd_jax.numerics.integrate import rk4_step
from rtcd_jax.plants.base import ModelEdits, Plant
from rtcd_jax.plants.model import compiled, row_of

with contextlib.redirect_stdout(io.StringIO()):  # a missing warp announces itself on stdout
    from mujoco import mjx

_UNUSED = (  # of the smooth dynamics; SPRING stays on, because MJX drops the dampers with it
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    | mujoco.mjtDisableBit.mjDSBL_CONTACT
    | mujoco.mjtDisableBit.mjDSBL_WARMSTART
    | mujoco.mjtDisableBit.mjDSBL_SENSOR
    | mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
)


def compile_model(plant: Plant, design: eqx.Module) -> mujoco.MjModel:
    """The MuJoCo model of one concrete design, derived constants included: to simulate, export or render.

    Raises:
        ValueError: the MJCF is no smooth robot, or an edit names what it lacks.
    """
    model = edited_model(plant, design)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def edited_model(plant: Plant, design: eqx.Module) -> mujoco.MjModel:
    """The compiled MJCF with nothing but the design's edits in it: what MJX computes with.

    Raises:
        ValueError: as `compile_model`.
    """
    model = copy.copy(compiled(plant.xml))
    with jax.enable_x64(True):
        edits = jax.tree.map(np.asarray, plant.edit_model(design))
    for attribute, edit in edits.items():
        leaf = operator.attrgetter(attribute)(model)
        if isinstance(edit, Mapping):
            for name, row in edit.items():
                leaf[row_of(model, attribute, name)] = row
        else:
            leaf[:] = edit
    return model


class MjxStepper(eqx.Module):
    """The plant's motion by MJX, for one design and one state; vmap it over both.

    States and results have the dtype of `x`; strict dtype and rank promotion are suspended inside.

    Raises:
        ValueError: as `compile_model`.
    """

    plant: Plant

    def __check_init__(self):
        _template(self.plant.xml, jnp.result_type(float))

    def dynamics(self, design: eqx.Module, x: Float[Array, " n"], u: Float[Array, " m"]) -> Float[Array, " n"]:
        """State derivative (qvel, qacc): MJX in the place of `Plant.dynamics`."""
        template, at_rest = _template(self.plant.xml, jnp.result_type(float))
        qpos, qvel = jnp.split(x, 2)
        with _promotion():
            model = _edited(_cast(template, x.dtype), compiled(self.plant.xml), self.plant.edit_model(design))
            data = _cast(at_rest, x.dtype).replace(qpos=qpos, qvel=qvel, ctrl=u)
            return jnp.concatenate([qvel, mjx.forward(model, data).qacc.astype(x.dtype)])

    def step(
        self, design: eqx.Module, x: Float[Array, " n"], u: Float[Array, " m"], dt: Float[Array, ""] | float
    ) -> Float[Array, " n"]:
        """State after one step of MuJoCo's RK4 integrator, of `dt` [s], `u` held throughout."""
        return rk4_step(lambda x, u: self.dynamics(design, x, u), x, u, jnp.asarray(dt, x.dtype))


@functools.cache
def _template(xml: str, dtype: np.dtype) -> tuple[mjx.Model, mjx.Data]:
    """The MJX model and data as host arrays of `dtype`, so that they belong to no device and to no trace."""
    model = copy.copy(compiled(xml))
    model.opt.disableflags |= _UNUSED
    # L'DL written out elementwise: a batched dense Cholesky calls LAPACK once a lane on the CPU.
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    with jax.ensure_compile_time_eval(), _promotion():
        here = jax.local_devices()[0]  # by default MJX takes the first one of all processes
        pair = mjx.put_model(model, here, impl="jax"), mjx.make_data(model, here, impl="jax")
        return jax.tree.map(lambda leaf: _as_float(np.asarray(leaf), dtype), pair)


def _edited(model: mjx.Model, host: mujoco.MjModel, edits: ModelEdits) -> mjx.Model:
    leaves = {}
    for attribute, edit in edits.items():
        leaf = operator.attrgetter(attribute)(model)
        if isinstance(edit, Mapping):
            for name, row in edit.items():
                leaf = leaf.at[row_of(host, attribute, name)].set(row.astype(leaf.dtype))
        else:
            leaf = edit.astype(leaf.dtype)
        leaves[attribute] = leaf
    return cast(mjx.Model, model.tree_replace(leaves))


def _as_float(leaf, dtype: DTypeLike):
    return leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def _cast(tree, dtype: DTypeLike):
    return jax.tree.map(lambda leaf: _as_float(jnp.asarray(leaf), dtype), tree)


@contextlib.contextmanager
def _promotion() -> Iterator[None]:
    """Inside, ranks and dtypes promote as MJX expects, also for callers who forbid it."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield
