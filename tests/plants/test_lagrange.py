"""Lagrange's equations of any tree of hinges and slides are those of C MuJoCo."""
# pyright: reportAttributeAccessIssue=false
# (mujoco ships no types for its native module.)

import mujoco
import numpy as np
import pytest

from rtcd_jax.plants.emit import emit
from rtcd_jax.plants.lagrange import Entry, derive
from rtcd_jax.plants.laurent import Laurent
from rtcd_jax.system.errors import UserError
from tests.plants.trees import NAMED, SWING, link, mjcf, random_tree

STATES = 100
TREES = {**NAMED, **{f"random tree {seed}": random_tree(seed) for seed in range(4)}}


def accelerations(model, values=(), symbols=(), seed=0):
    """Those of the closed form, with `values` for its `symbols`, and where."""
    random = np.random.default_rng(seed)
    q, v, u = (random.uniform(-4, 4, (size, STATES)) for size in (model.nv, model.nv, model.nu))
    program = emit(derive(model, {entry: i for i, entry in enumerate(symbols)}), len(symbols))
    found = program.accelerations(program.lump(list(values)), list(q), list(v), list(u), np.sin, np.cos)
    return np.stack([a + 0 * q[0] for a in found]), (q, v, u)


def by_mujoco(model, q, v, u):
    data, found = mujoco.MjData(model), []
    for state in zip(q.T, v.T, u.T, strict=True):
        data.qpos, data.qvel, data.ctrl = state
        mujoco.mj_forward(model, data)
        found.append(data.qacc.copy())
    return np.array(found).T


def assert_equal(found, expected):
    np.testing.assert_array_less(np.abs(found - expected) / (1 + np.abs(expected).max(0)), 1e-10)


@pytest.mark.parametrize("text", TREES.values(), ids=TREES)
def test_accelerations_are_those_of_c_mujoco(text):
    model = mujoco.MjModel.from_xml_string(text)
    found, states = accelerations(model)
    assert_equal(found, by_mujoco(model, *states))


@pytest.mark.parametrize("seed", [4, 5])
def test_numbers_that_are_left_open_may_be_given_later(seed):
    model = mujoco.MjModel.from_xml_string(random_tree(seed))
    symbols = [
        Entry("body_mass", 2),
        *(Entry("body_pos", 2, i) for i in range(3)),
        *(Entry("body_ipos", 3, i) for i in range(3)),
        *(Entry("body_inertia", 1, i) for i in range(3)),
        Entry("jnt_pos", 1, 2),
        Entry("jnt_stiffness", 2),
        Entry("dof_damping", 0),
        Entry("dof_armature", 3),
        Entry("actuator_gear", 1, 0),
        Entry("gravity", 2),
    ]
    values = np.random.default_rng(seed).uniform(0.1, 0.2, len(symbols))
    found, states = accelerations(model, values, symbols)
    for (attribute, row, component), value in zip(symbols, values, strict=True):
        leaf = model.opt.gravity if attribute == "gravity" else getattr(model, attribute)
        leaf[row if component is None else (row, component)] = value
    assert_equal(found, by_mujoco(model, *states))


def test_what_the_design_alone_decides_is_computed_once():
    """For a cart-pole, the arithmetic at a state is that of equations written by hand: twenty operations."""
    pole = link("pole", SWING, center="0 0 0.2")
    model = mujoco.MjModel.from_xml_string(
        mjcf(link("cart", 'type="slide" axis="1 0 0" damping="5"', pole), 'joint="cart"')
    )
    symbols = Entry("body_mass", 2), Entry("body_ipos", 2, 2)
    program = emit(derive(model, {entry: i for i, entry in enumerate(symbols)}), 2)
    assert len(program.motion) <= 20
    assert {i.operation for i in program.motion} == {"+", "-", "*", "/", "sin", "cos"}


def test_sines_and_cosines_cancel_exactly():
    c, s = Laurent({(1,): 0.5, (-1,): 0.5}), Laurent({(1,): -0.5j, (-1,): 0.5j})
    assert (c * c + s * s).terms == {(0,): 1.0}
    assert (s.by_angle(0) - c).terms == {}


def of(*bodies, extra="", motor='<motor joint="a"/>'):
    """A pendulum on hinge "a" with something more."""
    return mjcf("".join(bodies)).replace("<actuator></actuator>", f"<actuator>{motor}</actuator>{extra}")


HANGING = link("a", SWING)
TENDON = '<tendon><fixed name="t"><joint joint="a" coef="1"/></fixed></tendon>'


FREE = HANGING.replace(f'<joint name="a" {SWING}/>', '<freejoint name="f"/>')
TO_TENDON = '<motor name="m" tendon="t"/>'
INTEGRATOR = '<general name="g" joint="a" dyntype="integrator"/>'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (of(link("a", 'type="ball"'), motor=""), r"^quaternions are no coordinates .*: joint a$"),
        (of(FREE, motor=""), r"quaternions .*: joint f$"),
        (of(HANGING, extra=TENDON), r"^tendons: tendon t$"),
        (of(HANGING, extra='<equality><joint name="e" joint1="a"/></equality>'), r"^equality constraints: equality e$"),
        (of(HANGING.replace('name="a" pos', 'name="a" gravcomp="1" pos')), r"^gravity compensation: body a$"),
        (of(HANGING, motor='<position name="p" joint="a" kp="2"/>'), r"^an actuator that is no motor .*: actuator p$"),
        (of(HANGING, motor=INTEGRATOR), r"^an actuator with a state: actuator g"),
        (of(HANGING, motor=TO_TENDON, extra=TENDON), r"an actuator on something else than a joint: actuator m"),
        (of(HANGING).replace("<option", '<option viscosity="0.1"'), r"^a fluid: option viscosity = 0.1$"),
    ],
)
def test_what_has_no_equations_is_refused_by_name(text, words):
    model = mujoco.MjModel.from_xml_string(text)
    with pytest.raises(UserError, match=words):
        derive(model)


def test_closed_forms_that_grow_beyond_use_are_refused():
    arm, axes = "", ("1 0 0", "0 1 0", "0 0 1")
    for i in range(9):
        arm = link(f"j{i}", f'type="hinge" axis="{axes[i % 3]}"', arm, place="0.1 0.2 0.3", center="0.1 0.1 0.1")
    with pytest.raises(UserError, match=r"more than 600 terms .*some five are the most$"):
        derive(mujoco.MjModel.from_xml_string(mjcf(arm)))
