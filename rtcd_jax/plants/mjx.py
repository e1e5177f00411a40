"""MuJoCo at the border: a plant's MJCF as a compiled model, as an MJX step in pure JAX, as C accelerations.

Nothing else in the package imports mujoco. The models have no contacts, joint limits, friction losses or
equalities, so that M(q) a = tau(q, v, u) is all there is to solve, and a design may replace a handful of the
model's leaves instead of being compiled anew. What would break this is refused by name.
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
from mujoco.batch import Batch

from rtcd_jax.numerics.integrate import rk4_step
from rtcd_jax.plants import plant_class
from rtcd_jax.plants.base import ModelEdits, Plant

with contextlib.redirect_stdout(io.StringIO()):  # a missing warp announces itself on stdout
    from mujoco import mjx

_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
}

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
        ValueError: the MJCF is no smooth robot of this plant's sizes, or an edit names what it lacks.
    """
    model = edited_model(plant, design)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def edited_model(plant: Plant, design: eqx.Module) -> mujoco.MjModel:
    """The compiled MJCF with nothing but the design's edits in it: what MJX computes with.

    Raises:
        ValueError: as `compile_model`.
    """
    model = copy.copy(_host_model(type(plant)))
    with jax.enable_x64(True):
        edits = jax.tree.map(np.asarray, plant.edit_model(design))
    for attribute, edit in edits.items():
        leaf = operator.attrgetter(attribute)(model)
        if isinstance(edit, Mapping):
            for name, row in edit.items():
                leaf[_row(model, attribute, name)] = row
        else:
            leaf[:] = edit
    return model


def model_of(name: str, parameters: Mapping[str, float]) -> mujoco.MjModel:
    """The MuJoCo model of the plant called `name` with these physical numbers, whatever JAX's precision is.

    Raises:
        ValueError: no plant has this name.
        KeyError: a parameter is missing.
    """
    with jax.enable_x64(True):
        return compile_model(*plant_class(name).from_parameters(parameters))


class MjxStepper(eqx.Module):
    """The plant's motion by MJX, for one design and one state; vmap it over both.

    States and results have the dtype of `x`; strict dtype and rank promotion are suspended inside.

    Raises:
        ValueError: as `compile_model`.
    """

    plant: Plant

    def __check_init__(self):
        _template(type(self.plant), jnp.result_type(float))

    def dynamics(self, design: eqx.Module, x: Float[Array, " n"], u: Float[Array, " m"]) -> Float[Array, " n"]:
        """State derivative (qvel, qacc): MJX in the place of `Plant.dynamics`."""
        template, at_rest = _template(type(self.plant), jnp.result_type(float))
        qpos, qvel = jnp.split(x, 2)
        with _promotion():
            model = _edited(_cast(template, x.dtype), self.plant.edit_model(design))
            data = _cast(at_rest, x.dtype).replace(qpos=qpos, qvel=qvel, ctrl=u)
            return jnp.concatenate([qvel, mjx.forward(model, data).qacc.astype(x.dtype)])

    def step(
        self, design: eqx.Module, x: Float[Array, " n"], u: Float[Array, " m"], dt: Float[Array, ""] | float
    ) -> Float[Array, " n"]:
        """State after one step of MuJoCo's RK4 integrator, of `dt` [s], `u` held throughout."""
        return rk4_step(lambda x, u: self.dynamics(design, x, u), x, u, jnp.asarray(dt, x.dtype))


class CpuDynamics:
    """State derivatives of many states of one model by C MuJoCo, in one thread.

    It knows nothing of JAX: an independent simulator for the closed form and MJX.
    """

    def __init__(self, model: mujoco.MjModel, capacity: int):
        self._batch = Batch(model, nsim=capacity, nthread=1)
        self._fields = tuple(self._batch.bind(name) for name in ("qpos", "qvel", "ctrl", "qacc"))

    def __call__(
        self, x: Float[np.ndarray, "states n"], u: Float[np.ndarray, "states m"]
    ) -> Float[np.ndarray, "states n"]:
        """(qvel, qacc) for at most `capacity` states."""
        states = len(x)
        qpos, qvel, ctrl, qacc = (field[:states] for field in self._fields)
        qpos[:], qvel[:] = np.split(x, 2, axis=1)
        ctrl[:] = u
        self._batch.forward(np.arange(states))
        return np.concatenate([qvel, qacc], axis=1)


@functools.cache
def _host_model(robot: type[Plant]) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_path(str(robot.mjcf))
    faults = [*_size_faults(robot, model), *_physics_faults(model)]
    if faults:
        raise ValueError(f"{robot.mjcf.name} is no smooth model of {robot.__name__}: {'; '.join(faults)}")
    return model


@functools.cache
def _template(robot: type[Plant], dtype: np.dtype) -> tuple[mjx.Model, mjx.Data]:
    """The MJX model and data as host arrays of `dtype`, so that they belong to no device and to no trace."""
    model = copy.copy(_host_model(robot))
    model.opt.disableflags |= _UNUSED
    # L'DL written out elementwise: a batched dense Cholesky calls LAPACK once a lane on the CPU.
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
    with jax.ensure_compile_time_eval(), _promotion():
        here = jax.local_devices()[0]  # by default MJX takes the first one of all processes
        pair = mjx.put_model(model, here, impl="jax"), mjx.make_data(model, here, impl="jax")
        return jax.tree.map(lambda leaf: _as_float(np.asarray(leaf), dtype), pair)


def _size_faults(robot: type[Plant], model: mujoco.MjModel) -> Iterator[str]:
    n, m = len(robot.state_names), len(robot.input_names)
    free = [_name(model, mujoco.mjtObj.mjOBJ_JOINT, i) for i in range(model.njnt) if model.jnt_type[i] < 2]
    if free:
        yield f"joint {', '.join(free)}: quaternions are no coordinates of a linear policy, use hinges and slides"
    elif model.nq + model.nv != n:
        yield f"it has {model.nq} positions and {model.nv} velocities, the plant {n} states"
    if model.nu != m:
        yield f"it has {model.nu} actuators, the plant {m} inputs"
    if model.na:
        yield f"it has {model.na} actuator states, and a plant none: use stateless motors"


def _physics_faults(model: mujoco.MjModel) -> Iterator[str]:
    objects = mujoco.mjtObj
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_RK4:
        yield 'its integrator must be <option integrator="RK4"/>'
    own_limits = "a funnel checks the limits on its states itself"
    own_clip = "the policy clips its inputs itself"
    for fault, kind, present in (
        (
            "contacts are on (set contype and conaffinity to 0)",
            objects.mjOBJ_GEOM,
            (model.geom_contype != 0) | (model.geom_conaffinity != 0),
        ),
        ("contact pairs", objects.mjOBJ_PAIR, np.ones(model.npair)),
        (f"joint limits are on ({own_limits})", objects.mjOBJ_JOINT, model.jnt_limited),
        (f"tendon limits are on ({own_limits})", objects.mjOBJ_TENDON, model.tendon_limited),
        ("friction loss, which is not smooth", objects.mjOBJ_JOINT, _of_joints(model, model.dof_frictionloss)),
        ("friction loss, which is not smooth", objects.mjOBJ_TENDON, model.tendon_frictionloss),
        ("equality constraints", objects.mjOBJ_EQUALITY, np.ones(model.neq)),
        (f"control limits are on ({own_clip})", objects.mjOBJ_ACTUATOR, model.actuator_ctrllimited),
        (f"force limits are on ({own_clip})", objects.mjOBJ_ACTUATOR, model.actuator_forcelimited),
        (f"force limits are on ({own_clip})", objects.mjOBJ_JOINT, model.jnt_actfrclimited),
    ):
        names = [_name(model, kind, int(i)) for i in np.flatnonzero(present)]
        if names:
            yield f"{fault}: {_kind(kind)} {', '.join(names)}"


def _of_joints(model: mujoco.MjModel, of_dofs: np.ndarray) -> np.ndarray:
    return np.bincount(model.dof_jntid, weights=of_dofs != 0, minlength=model.njnt)


def _kind(kind: mujoco.mjtObj) -> str:
    return mujoco.mju_type2Str(kind)


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return mujoco.mj_id2name(model, kind, index) or f"number {index}"


def _edited(model: mjx.Model, edits: ModelEdits) -> mjx.Model:
    leaves = {}
    for attribute, edit in edits.items():
        leaf = operator.attrgetter(attribute)(model)
        if isinstance(edit, Mapping):
            for name, row in edit.items():
                leaf = leaf.at[_row(model, attribute, name)].set(row.astype(leaf.dtype))
        else:
            leaf = edit.astype(leaf.dtype)
        leaves[attribute] = leaf
    return cast(mjx.Model, model.tree_replace(leaves))


def _row(model: mujoco.MjModel | mjx.Model, attribute: str, name: str) -> int:
    """Index in `attribute` of the body, joint or geom called `name`."""
    kind = _OBJECTS[attribute.split("_")[0]]
    index = mjx.name2id(model, kind, name)
    if index < 0:
        raise ValueError(f"{attribute} is edited at {name!r}, but the model has no {_kind(kind)} of that name")
    return int(model.jnt_dofadr[index]) if attribute.startswith("dof_") else index


def _as_float(leaf, dtype: DTypeLike):
    return leaf.astype(dtype) if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf


def _cast(tree, dtype: DTypeLike):
    return jax.tree.map(lambda leaf: _as_float(jnp.asarray(leaf), dtype), tree)


@contextlib.contextmanager
def _promotion() -> Iterator[None]:
    """Inside, ranks and dtypes promote as MJX expects, also for callers who forbid it."""
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        yield
