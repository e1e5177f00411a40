"""C MuJoCo's models of robots: compiled from their MJCF's text, edited, or edited as a specification and compiled anew.

The models have no contacts, joint limits, friction losses or equalities, so that M(q) a = tau(q, v, u) is all there is
to solve. What would break this is refused by name. A motor's ctrlrange and the integrator are no part of the dynamics:
the policy clips its inputs itself.
"""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

import copy
from collections.abc import Iterator, Mapping
from functools import cache

import mujoco
import numpy as np
from jaxtyping import Float
from mujoco.batch import Batch

from rtcd_jax.config.robot import OPTION, Robot, value_of
from rtcd_jax.plants.drawing import view_of
from rtcd_jax.system.errors import UserError

CAMERA = "front"
"""What `animate` looks through. A model without it is given one that sees its motion."""
LEAST_INERTIA = 1e-14
"""What MuJoCo wants of a point mass, with a margin [kg m^2]; a palm-sized robot has 1e-5."""

_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
}


@cache
def compiled(xml: str) -> mujoco.MjModel:
    """The model of an MJCF as it stands; not to be written to.

    Raises:
        UserError: MuJoCo does not compile it, or its dynamics are not smooth.
    """
    try:
        model = mujoco.MjModel.from_xml_string(xml)
    except ValueError as error:
        raise UserError(f"MuJoCo: {' '.join(str(error).split())}") from None
    faults = list(_faults(model))
    if faults:
        raise UserError(f"is no smooth model: {'; '.join(faults)}")
    return _as_simulated(model)


def with_numbers(robot: Robot) -> mujoco.MjModel:
    """The compiled model with the numbers that `set` says in it, and what it says in arithmetic as it was."""
    model = copy.copy(compiled(robot.xml))
    for edit in robot.edits:
        row = _leaf(model, edit.kind, edit.attribute, edit.object)
        for i, value in enumerate(edit.values):
            if not isinstance(value, str):
                row[i] = value
    return model


def recompiled(robot: Robot, values: Mapping[str, float]) -> mujoco.MjModel:
    """The model of the MJCF edited as a specification and compiled anew; `values` are complete.

    Raises:
        UserError: MuJoCo does not compile it.
    """
    base, spec = compiled(robot.xml), mujoco.MjSpec.from_string(robot.xml)
    spec.compiler.inertiafromgeom = 0
    for body in spec.bodies[1:]:  # what MuJoCo took from the geoms stays, whatever they become
        index = base.body(body.name).id if body.name else body.id
        body.explicitinertial = True
        body.fullinertia[0] = np.nan
        body.mass, body.ipos, body.iquat = base.body_mass[index], base.body_ipos[index], base.body_iquat[index]
        body.inertia = base.body_inertia[index]
    for name in {edit.object for edit in robot.edits if edit.kind == "geom"}:  # not by its ends: by place and size
        index, geom = base.geom(name).id, spec.geom(name)
        geom.fromto = np.full(6, np.nan)
        geom.pos, geom.quat, geom.size = base.geom_pos[index], base.geom_quat[index], base.geom_size[index]
    for edit in robot.edits:
        numbers = np.array([float(value_of(value, values)) for value in edit.values])
        if edit.kind == OPTION:
            spec.option.gravity = numbers
            continue
        element = getattr(spec, "actuator" if edit.kind == "motor" else edit.kind)(edit.object)
        if edit.field == "mass":
            element.mass = numbers[0]
        elif edit.field in ("damping", "stiffness", "gear"):
            getattr(element, edit.field)[0] = numbers[0]
        elif edit.field == "armature":
            element.armature = numbers[0]
        else:
            setattr(element, edit.field, np.maximum(numbers, LEAST_INERTIA) if edit.field == "inertia" else numbers)
    if not any(camera.name == CAMERA for camera in spec.cameras):
        view, quat = view_of(base), np.empty(4)
        mujoco.mju_mat2Quat(quat, view.T.ravel())  # a camera's columns: right, up, back
        spec.worldbody.add_camera(name=CAMERA, pos=3 * view[2], quat=quat)
        spec.worldbody.add_light(pos=2 * (view[2] + view[1]), dir=-view[2] - view[1])
    try:
        return _as_simulated(spec.compile())
    except ValueError as error:
        raise UserError(f"{robot.name}: MuJoCo: {' '.join(str(error).split())}") from None


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


def row_of(model: mujoco.MjModel, attribute: str, name: str) -> int:
    """Index in `attribute` of the body, joint, actuator or geom called `name`.

    Raises:
        ValueError: there is none.
    """
    kind = _OBJECTS[attribute.split("_")[0]]
    index = mujoco.mj_name2id(model, kind, name)
    if index < 0:
        raise ValueError(
            f"{attribute} is edited at {name!r}, but the model has no {mujoco.mju_type2Str(kind)} of that name"
        )
    return int(model.jnt_dofadr[index]) if attribute.startswith("dof_") else index


def _leaf(model: mujoco.MjModel, kind: str, attribute: str, name: str) -> np.ndarray:
    """The numbers of one object, to be written to."""
    if kind == OPTION:
        return model.opt.gravity
    whole = getattr(model, attribute)
    return whole.reshape(len(whole), -1)[row_of(model, attribute, name)]


def _as_simulated(model: mujoco.MjModel) -> mujoco.MjModel:
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.actuator_ctrllimited[:] = 0
    return model


def _faults(model: mujoco.MjModel) -> Iterator[str]:
    objects = mujoco.mjtObj
    own_limits = "task.state_limits are the limits on the states"
    own_clip = "the policy clips its inputs itself"
    if model.na:
        yield f"it has {model.na} actuator states, and a plant none: use stateless motors"
    for fault, kind, present in (
        (
            "quaternions are no coordinates of a linear policy, use hinges and slides",
            objects.mjOBJ_JOINT,
            model.jnt_type < 2,
        ),
        (
            "contacts are on (set contype and conaffinity to 0)",
            objects.mjOBJ_GEOM,
            (model.geom_contype != 0) | (model.geom_conaffinity != 0),
        ),
        ("contact pairs", objects.mjOBJ_PAIR, np.ones(model.npair)),
        (f"joint limits are on ({own_limits})", objects.mjOBJ_JOINT, model.jnt_limited),
        (f"tendon limits are on ({own_limits})", objects.mjOBJ_TENDON, model.tendon_limited),
        (
            "friction loss, which is not smooth",
            objects.mjOBJ_JOINT,
            np.bincount(model.dof_jntid, weights=model.dof_frictionloss != 0, minlength=model.njnt),
        ),
        ("friction loss, which is not smooth", objects.mjOBJ_TENDON, model.tendon_frictionloss),
        ("equality constraints", objects.mjOBJ_EQUALITY, np.ones(model.neq)),
        (f"force limits are on ({own_clip})", objects.mjOBJ_ACTUATOR, model.actuator_forcelimited),
        (f"force limits are on ({own_clip})", objects.mjOBJ_JOINT, model.jnt_actfrclimited),
    ):
        names = [mujoco.mj_id2name(model, kind, int(i)) or f"number {i}" for i in np.flatnonzero(present)]
        if names:
            yield f"{fault}: {mujoco.mju_type2Str(kind)} {', '.join(names)}"
