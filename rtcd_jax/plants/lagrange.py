"""Lagrange's equations of a tree of hinges and slides, in closed form, from its compiled MjModel.

    M(q) v' = motor u - damping v - stiffness (q - q_spring) - dU/dq - c(q, v),
    c_i = sum_jk (dM_ij/dq_k - 1/2 dM_jk/dq_i) v_j v_k

M and the potential U are Laurent polynomials in e^(iq), the slides' positions and one symbol for each edited number of
the model; all derivatives are exact. The terms of every body follow from its center's and its axes' motion
(Featherstone, Rigid Body Dynamics Algorithms, 2008, chapter 6, written in world coordinates).
"""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from rtcd_jax.plants.laurent import Coefficient, Laurent
from rtcd_jax.system.errors import UserError

MOST_TERMS = 600
"""Of one entry of M: beyond, compilers and users wait for minutes."""

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)

Vector = list[Laurent]
Rotation = list[Vector]


class Entry(NamedTuple):
    """One number of an MjModel: an attribute's row and, where a row is several numbers, component."""

    attribute: str
    row: int
    component: int | None = None

    def read(self, model: mujoco.MjModel) -> float:
        if self.attribute == "gravity":
            return float(model.opt.gravity[self.row])
        value = np.asarray(getattr(model, self.attribute)[self.row])
        return float(value.flat[self.component or 0])


@dataclass(frozen=True)
class Equations:
    """The equations of motion. Lists are by degree of freedom; `christoffel[i]` has the factor of v_j v_k at (j, k),
    j <= k; `springs` are stiffness and rest position. Exponents are those of all positions, then of all symbols.
    """

    angles: tuple[bool, ...]
    mass: list[list[Laurent]]
    potential: Laurent
    christoffel: list[dict[tuple[int, int], Laurent]]
    slopes: list[Laurent]
    damping: list[Laurent]
    springs: list[tuple[Laurent, float]]
    motors: list[list[Laurent]]

    @property
    def terms(self) -> int:
        """Size of the equations."""
        factors = (factor for row in self.christoffel for factor in row.values())
        return sum(len(p.terms) for row in (*self.mass, self.slopes, factors) for p in row)


def derive(model: mujoco.MjModel, symbols: Mapping[Entry, int] | None = None) -> Equations:
    """The equations of `model`, in which the numbers `symbols` are left open; equal ones are one symbol.

    Raises:
        UserError: the model is no tree of hinges and slides with smooth dynamics, or its closed form is too large.
    """
    if faults := list(unsupported(model)):
        raise UserError("; ".join(faults))
    ring = _Ring(model, symbols or {})
    nv, angles = model.nv, ring.angles
    bodies = {0: _Frame([ring.zero] * 3, [[ring.number(float(i == j)) for j in range(3)] for i in range(3)], {})}
    mass = [[ring.zero] * (i + 1) for i in range(nv)]
    potential = ring.zero
    gravity = [ring.entry("gravity", i) for i in range(3)]
    for body in range(1, model.nbody):
        frame = bodies[body] = _moved(ring, model, body, bodies[int(model.body_parentid[body])])
        weight = ring.entry("body_mass", body)
        center = _sum(frame.origin, _apply(frame.axes, ring.vector("body_ipos", body)))
        potential = potential - weight * _dot(gravity, center)
        principal = _compose(frame.axes, ring.rotation(model.body_iquat[body]))
        moments = ring.vector("body_inertia", body)
        velocity = {i: [ring.slope(c, i) for c in center] for i in frame.joints}
        spin = {
            i: [_dot([row[a] for row in principal], axis) for a in range(3)]
            for i, axis in frame.joints.items()
            if axis is not None
        }
        for i in velocity:
            for j in velocity:
                if j > i:
                    continue
                mass[i][j] = mass[i][j] + weight * _dot(velocity[i], velocity[j])
                if i in spin and j in spin:
                    turning = [moments[a] * (spin[i][a] * spin[j][a]) for a in range(3)]
                    mass[i][j] = mass[i][j] + turning[0] + turning[1] + turning[2]
                if len(mass[i][j].terms) > MOST_TERMS:
                    raise UserError(
                        f"its closed form has more than {MOST_TERMS} terms in one entry of the mass matrix: it grows "
                        "with every hinge that is not parallel to those before it, and some five are the most"
                    )
    for i in range(nv):
        mass[i][i] = mass[i][i] + ring.entry("dof_armature", i)
        if not mass[i][i].terms:
            raise UserError(f"joint {_name(model, mujoco.mjtObj.mjOBJ_JOINT, int(model.dof_jntid[i]))} moves no mass")
    joints = range(model.njnt)
    motors = [[ring.zero] * model.nu for _ in range(nv)]
    for motor, joint in enumerate(model.actuator_trnid[:, 0].tolist()):
        motors[int(model.jnt_dofadr[joint])][motor] = ring.entry("actuator_gear", motor, 0)
    return Equations(
        angles=angles,
        mass=mass,
        potential=potential,
        christoffel=[_christoffel(ring, mass, i) for i in range(nv)],
        slopes=[ring.slope(potential, i) for i in range(nv)],
        damping=[ring.entry("dof_damping", i) for i in range(nv)],
        springs=[(ring.entry("jnt_stiffness", j), float(model.qpos_spring[j])) for j in joints],
        motors=motors,
    )


def unsupported(model: mujoco.MjModel) -> Iterator[str]:
    """What of a model has no equations here, by name; what is left is found by comparing accelerations."""
    objects, joint_motor = mujoco.mjtObj, int(mujoco.mjtTrn.mjTRN_JOINT)
    plain_gain = (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED)) & (model.actuator_gainprm[:, 0] == 1)
    plain = plain_gain & (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE))
    for fault, kind, present in (
        (
            "quaternions are no coordinates of a linear policy, use hinges and slides",
            objects.mjOBJ_JOINT,
            ~np.isin(model.jnt_type, (HINGE, SLIDE)),
        ),
        ("tendons", objects.mjOBJ_TENDON, np.ones(model.ntendon)),
        ("equality constraints", objects.mjOBJ_EQUALITY, np.ones(model.neq)),
        ("gravity compensation", objects.mjOBJ_BODY, model.body_gravcomp),
        ("an actuator on something else than a joint", objects.mjOBJ_ACTUATOR, model.actuator_trntype != joint_motor),
        ("an actuator with a state", objects.mjOBJ_ACTUATOR, model.actuator_dyntype),
        ("an actuator that is no motor (<motor>)", objects.mjOBJ_ACTUATOR, ~plain),
    ):
        names = [_name(model, kind, int(i)) for i in np.flatnonzero(present)]
        if names:
            yield f"{fault}: {mujoco.mju_type2Str(kind)} {', '.join(names)}"
    for name in ("density", "viscosity"):
        if value := getattr(model.opt, name):
            yield f"a fluid: option {name} = {value:g}"


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    return mujoco.mj_id2name(model, kind, index) or f"number {index}"


class _Frame(NamedTuple):
    """Where a body is in the world: its origin, its axes in the columns of a matrix, and the joints that move it, each
    with its axis in the world if it is a hinge."""

    origin: Vector
    axes: Rotation
    joints: dict[int, Vector | None]


class _Ring:
    """The model's numbers as polynomials."""

    def __init__(self, model: mujoco.MjModel, symbols: Mapping[Entry, int]):
        self.model, self.width = model, model.nv + len(set(symbols.values()))
        self.angles = tuple(int(kind) == HINGE for kind in model.jnt_type)
        self.place = {entry: model.nv + symbol for entry, symbol in symbols.items()}
        self.zero = Laurent({})

    def monomial(self, i: int, power: int = 1, factor: Coefficient = 1.0) -> Laurent:
        return Laurent({tuple(power if j == i else 0 for j in range(self.width)): factor})

    def number(self, value: float) -> Laurent:
        return Laurent({(0,) * self.width: value})

    def entry(self, attribute: str, row: int, component: int | None = None) -> Laurent:
        entry = Entry(attribute, row, component)
        return self.monomial(self.place[entry]) if entry in self.place else self.number(entry.read(self.model))

    def vector(self, attribute: str, row: int) -> Vector:
        return [self.entry(attribute, row, i) for i in range(3)]

    def rotation(self, quaternion: np.ndarray) -> Rotation:
        table = np.zeros(9)
        mujoco.mju_quat2Mat(table, quaternion)
        return [[self.number(_snapped(x)) for x in row] for row in table.reshape(3, 3)]

    def slope(self, p: Laurent, i: int) -> Laurent:
        """dp/dq_i."""
        return p.by_angle(i) if self.angles[i] else p.by_position(i)

    def turn(self, i: int, axis: np.ndarray, zero: float) -> Rotation:
        """c I + (1 - c) a a' + s [a]x of the angle q_i - zero about the unit vector a (Rodrigues)."""
        phase = complex(np.cos(zero), -np.sin(zero))
        up, down = self.monomial(i, 1, 0.5 * phase), self.monomial(i, -1, 0.5 * phase.conjugate())
        cosine, sine = up + down, -1j * (up - down)
        x, y, z = axis
        cross, along = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.outer(axis, axis)
        return [
            [
                float(i == j) * cosine + self.number(along[i, j]) - along[i, j] * cosine + cross[i, j] * sine
                for j in range(3)
            ]
            for i in range(3)
        ]


def _moved(ring: _Ring, model: mujoco.MjModel, body: int, parent: _Frame) -> _Frame:
    """The frame of a body behind its own joints, which move it one after the other."""
    joints = dict(parent.joints)
    origin = _sum(parent.origin, _apply(parent.axes, ring.vector("body_pos", body)))
    axes = _compose(parent.axes, ring.rotation(model.body_quat[body]))
    first = int(model.body_jntadr[body])
    for joint in range(first, first + int(model.body_jntnum[body])):
        i, zero = int(model.jnt_dofadr[joint]), float(model.qpos0[joint])
        axis = np.array([_snapped(a) for a in model.jnt_axis[joint]])
        world_axis = _apply(axes, [ring.number(a) for a in axis])
        if ring.angles[joint]:
            arm = ring.vector("jnt_pos", joint)
            anchor = _sum(origin, _apply(axes, arm))
            axes = _compose(axes, ring.turn(i, axis, zero))
            origin = _sum(anchor, [-p for p in _apply(axes, arm)])
            joints[i] = world_axis
        else:
            travel = ring.monomial(i) - ring.number(zero)
            origin = _sum(origin, [a * travel for a in world_axis])
            joints[i] = None
    return _Frame(origin, axes, joints)


def _christoffel(ring: _Ring, mass: list[list[Laurent]], i: int) -> dict[tuple[int, int], Laurent]:
    """Factors of v_j v_k, j <= k, in c_i."""
    factors = {}
    for k in range(len(mass)):
        for j in range(k + 1):
            m_ij, m_ik, m_jk = (mass[max(pair)][min(pair)] for pair in ((i, j), (i, k), (j, k)))
            both = ring.slope(m_ij, k) + ring.slope(m_ik, j) - ring.slope(m_jk, i)
            factor = 0.5 * both if j == k else both
            if factor.terms:
                factors[j, k] = factor
    return factors


def _snapped(value: float) -> float:
    """Multiples of one half where rounding of unit vectors and rotations missed them."""
    nearest = round(2 * float(value)) / 2
    return nearest if abs(nearest - value) < 1e-14 else float(value)


def _dot(a: Sequence[Laurent], b: Sequence[Laurent]) -> Laurent:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _sum(a: Vector, b: Vector) -> Vector:
    return [x + y for x, y in zip(a, b, strict=True)]


def _apply(rotation: Rotation, vector: Vector) -> Vector:
    return [_dot(row, vector) for row in rotation]


def _compose(a: Rotation, b: Rotation) -> Rotation:
    columns = list(zip(*b, strict=True))
    return [[_dot(row, column) for column in columns] for row in a]
