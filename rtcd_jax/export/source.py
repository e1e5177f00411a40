"""The C controller's numbers as headers, and the text of the folder's README."""

from collections.abc import Mapping
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np

from rtcd_jax.export.bundle import Bundle

TEMPLATES = files("rtcd_jax.export") / "templates"
PREFIX = "rtcd_"
"""Of the templates' files and symbols; the export's own name takes its place: two exports live in one program."""
_COPIED = (
    "controller.py", "controller.h", "controller.c", "controller_test.c", "demo.py", "drake.py", "ros2.py",
)  # fmt: skip
NOT_TRIED = (
    "Nothing was tried: `rtcd disturb` on the run simulates wrong models, friction, noise, delay and pushes; export "
    "again afterwards, and what it finds stands here."
)
HELD = "afterwards the goal's LQR holds"
HAND_OVER_HELD = (
    "Hand over at the goal after {duration} s, while `inside`, to whatever holds the robot there; until then the "
    "goal's LQR holds it."
)
CAUGHT = (
    "it ends in a catch set, the last ellipsoid: at the end `monitor(duration, x).inside` says whether x is in it, and "
    "afterwards the input is zero and the monitor advises to stop, whatever the state"
)
HAND_OVER_CAUGHT = (
    "Hand over after {duration} s to what comes next (a grasp, the controller of the next motion), if "
    "`monitor(duration, x).inside`; of the time after it nothing is promised."
)
_CLAIMS = {"controller.py": 'CLAIM = ""', "controller.c": 'claim[] = ""'}


def sources(bundle: Bundle) -> dict[str, str]:
    """The controller's files by name: what is the same for every robot but for names, and the numbers' headers."""
    texts = {PREFIX + name: _with_claim(name, bundle) for name in _COPIED}
    texts |= {f"{PREFIX}controller_size.h": _size_header(bundle), f"{PREFIX}controller_data.h": _data_header(bundle)}
    return {named(name, bundle): named(text, bundle) for name, text in texts.items()}


def named(text: str, bundle: Bundle) -> str:
    """`text` with the export's name in the place of the templates'."""
    return text.replace(PREFIX, f"{bundle.label}_").replace(PREFIX.upper(), f"{bundle.label}_".upper())


def _with_claim(name: str, bundle: Bundle) -> str:
    text = template(name)
    if bundle.proof and name in _CLAIMS:
        empty = _CLAIMS[name]
        text = text.replace(empty, empty[:-1] + bundle.standing.claim + '"')
    return text


def template(name: str) -> str:
    """The text of a template, by its name without `PREFIX`."""
    path = TEMPLATES / (name if name == "README.md" else PREFIX + name)
    return path.read_text(encoding="utf-8")


def _size_header(bundle: Bundle) -> str:
    """How many states, inputs and intervals there are, and the inputs' limits."""
    elite = bundle.elite
    return _header(
        bundle,
        "RTCD_CONTROLLER_SIZE_H",
        [
            f"#define RTCD_STATES {elite.x_goal.size}",
            f"#define RTCD_INPUTS {elite.u_max.size}",
            f"#define RTCD_INTERVALS {len(elite.u)}",
            f"#define RTCD_INPUT_LIMITS {_initializer(elite.u_max)}",
        ],
    )


def _data_header(bundle: Bundle) -> str:
    """Every number that the controller and the monitor look up."""
    elite, proof = bundle.elite, bundle.proof
    arrays = {
        "X": elite.x,
        "X_RATES": bundle.rates,
        "U": elite.u,
        "K": elite.K,
        "S": elite.S,
        "S_RATES": bundle.funnel.value_rates,
        "LOG_RHO": np.log(elite.rho),
        "K_GOAL": elite.K_goal,
        "X_GOAL": elite.x_goal,
        "U_MAX": elite.u_max,
        "STATE_LIMITS": elite.state_limits,
    }
    if proof:
        arrays |= {"PROOF_BEGINS": proof.begins, "PROOF_AXES": proof.axes}
    scalars = [
        f"#define RTCD_DT {_number(elite.time[1])}",
        f"#define RTCD_DURATION {_number(elite.time[-1])}",
        f"#define RTCD_PIECES {proof.begins.size if proof else 0}",
        f"#define RTCD_CAUGHT {int(elite.caught)}",
    ]
    definitions = []
    for name, array in arrays.items():
        sizes = "".join(f"[{size}]" for size in array.shape)
        definitions.append(f"static const double RTCD_{name}{sizes} = {_initializer(array)};")
    angles = ", ".join(str(int(angle)) for angle in bundle.angles)
    flags = f"static const int RTCD_ANGLES[{bundle.angles.size}] = {{{angles}}};"
    return _header(bundle, "RTCD_CONTROLLER_DATA_H", [*scalars, flags, *definitions])


def readme(bundle: Bundle, described: dict[str, Any]) -> str:
    """The folder's README: what lies where, which way the axes point, what is promised."""
    funnel = described["funnel"]
    quantities, duration = [*described["states"], *described["inputs"]], f"{bundle.elite.time[-1]:.6g}"
    rows = [f"| {item['name']} | {item['unit']} | {_limit(item['limit'])} |" for item in quantities]
    design = ", ".join(
        f"{name} {value:.6g} {bundle.plant.design_units[name]}" for name, value in described["design"].items()
    )
    return Template(named(template("README.md"), bundle)).substitute(
        plant=described["plant"],
        elite=bundle.name,
        config=described["config_hash"],
        design=design,
        convention=bundle.plant.convention,
        quantities="\n".join(rows),
        duration=duration,
        rate=bundle.control_rate.sentence,
        afterwards=CAUGHT if bundle.elite.caught else HELD,
        handover=(HAND_OVER_CAUGHT if bundle.elite.caught else HAND_OVER_HELD).format(duration=duration),
        guarantee=funnel["rung"],
        bears=bundle.robustness or NOT_TRIED,
        promise=_promise(bundle, funnel),
        columns="`time,pos,vel,torque`" if bundle.elite.x_goal.size == 2 else "`time,pos1,…,vel1,…,tau1,…,K11,…`",
    )


def _promise(bundle: Bundle, funnel: Mapping[str, Any]) -> str:
    """What is promised of the funnels, and on what ground."""
    unit, standing = funnel["volume_unit"], bundle.standing
    inlet, at_most = f"{funnel['volumes']['inlet']:.4g} {unit}", f"{funnel['epsilon']:.2g}"
    sampled = f"""\
The funnel of `funnel.csv` is {funnel["rung"]}: in simulation a state drawn uniformly from a knot's ellipsoid (the
first one has {inlet}) failed to arrive with a probability of at most {at_most}, at confidence
{funnel["confidence"]:g} jointly for all knots."""
    if bundle.proof is None:
        return f"{sampled} The monitor evaluates it. Nothing is proved: the certificate is {standing.verdict}."
    proved = f"{standing.volumes['inlet']:.4g} {unit}"
    own = bundle.proof.offsets.any()
    shared, whose = (", what of it all robots share", "its robot's funnel") if own else ("", "it")
    ends = "is in the catch set at the end, or led by the reset" if bundle.elite.caught else "comes to the goal"
    return f"""\
The monitor evaluates the **proved** funnel from {standing.start:.6g} s on{shared}: every motion of the model that is
inside at some time stays in {whose} and {ends}, in continuous time, within the limits. Its first ellipsoid
has {proved}. `certificate.json` is the proof, and `rtcd check certificate.json` checks it. The
SHA-256 of its claim about this controller stands in the controllers, too:
`{standing.claim}`.

{sampled}"""


def _header(bundle: Bundle, guard: str, lines: list[str]) -> str:
    elite = bundle.elite
    source = f"/* {elite.plant}, elite {bundle.name}, configuration {elite.record['config_hash']}. Generated. */"
    return "\n".join([source, f"#ifndef {guard}", f"#define {guard}", "", *lines, "", "#endif", ""])


def _initializer(array: np.ndarray) -> str:
    if array.ndim == 1:
        return "{" + ", ".join(map(_number, array.tolist())) + "}"
    return "{" + ",\n    ".join(map(_initializer, array)) + "}"


def _number(value: float) -> str:
    return repr(float(value)) if np.isfinite(value) else "DBL_MAX"


def _limit(limit: float) -> str:
    return f"± {limit:.6g}" if np.isfinite(limit) else "none"
