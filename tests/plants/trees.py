"""MJCFs of trees of hinges and slides, the usual ones and random ones."""

import numpy as np

HEAD = """<mujoco>
<compiler angle="radian" autolimits="false" inertiafromgeom="false"/>
<option integrator="RK4" timestep="0.002" gravity="{gravity}"/>
<worldbody>"""
TAIL = "</worldbody><actuator>{motors}</actuator></mujoco>"


def mjcf(bodies: str, *motors: str, gravity: str = "0 0 -9.81") -> str:
    """`motors` are attributes of each, such as `joint="elbow" gear="2"`."""
    return HEAD.format(gravity=gravity) + bodies + TAIL.format(motors="".join(f"<motor {m}/>" for m in motors))


def link(name: str, joint: str, inner: str = "", place: str = "0 0 0", center: str = "0 0 -0.2", mass: float = 0.5):
    """A body with one joint of its name."""
    inertia = f'<inertial mass="{mass}" pos="{center}" diaginertia="0.006 0.005 0.002"/>'
    return f'<body name="{name}" pos="{place}">{inertia}<joint name="{name}" {joint}/>{inner}</body>'


SWING = 'type="hinge" axis="0 -1 0" damping="0.01"'
_LOWER = link("elbow", SWING, place="0 0 -0.3", center="0 0 -0.25", mass=0.6)
_DOUBLE = link("shoulder", SWING, _LOWER)
_THIRD = link("third", SWING, place="0 0 -0.25")
_TRIPLE = link("first", SWING, link("second", SWING, _THIRD, place="0 0 -0.2"))

NAMED = {
    "acrobot": mjcf(_DOUBLE, 'name="torque" joint="elbow"'),
    "pendubot": mjcf(_DOUBLE, 'name="torque" joint="shoulder"'),
    "furuta": mjcf(
        link(
            "arm",
            'type="hinge" axis="0 0 1" armature="4e-4"',
            link("rod", 'type="hinge" axis="1 0 0" damping="0.001"', place="0.1 0 0"),
            center="0.05 0 0",
        ),
        'joint="arm"',
    ),
    "triple pendulum on a cart": mjcf(
        link("cart", 'type="slide" axis="1 0 0" damping="1.5"', _TRIPLE, center="0 0 0"), 'joint="cart"'
    ),
}


def random_tree(seed: int, joints: int = 4) -> str:
    """Bodies on random parents, hinges and slides about any axis, springs, gears, armatures, references, offsets."""
    random = np.random.default_rng(seed)

    def numbers(low, high, size):
        return " ".join(f"{x:.6g}" for x in random.uniform(low, high, size))

    parents = [None, *(int(random.integers(0, i)) for i in range(1, joints))]
    axes = ["1 0 0", "0 1 0", "0 0 1", "1 1 0", numbers(-1, 1, 3)]

    def body(i: int) -> str:
        kind = "hinge" if i == 0 or random.random() < 0.7 else "slide"
        joint = (
            f'<joint name="j{i}" type="{kind}" axis="{axes[random.integers(0, 5)]}" pos="{numbers(-0.05, 0.05, 3)}" '
            f'damping="{random.uniform(0, 0.2):.4g}" armature="{random.uniform(0, 0.01):.4g}" '
            f'stiffness="{random.choice([0, 3.0])}" springref="{random.uniform(-0.5, 0.5):.4g}" '
            f'ref="{random.choice([0, 0.4])}"/>'
        )
        inertia = (
            f'<inertial mass="{random.uniform(0.2, 1):.4g}" pos="{numbers(-0.2, 0.2, 3)}" '
            f'diaginertia="0.012 0.01 0.004" euler="{numbers(-1, 1, 3)}"/>'
        )
        inner = "".join(body(child) for child in range(joints) if parents[child] == i)
        return f'<body pos="{numbers(-0.3, 0.3, 3)}" euler="{numbers(-1, 1, 3)}">{inertia}{joint}{inner}</body>'

    driven = random.choice(joints, 2, replace=False)
    return mjcf(body(0), *(f'joint="j{j}" gear="{random.choice([2, -3])}"' for j in driven), gravity="0.3 -0.2 -9.81")
