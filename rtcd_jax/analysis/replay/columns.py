"""Which columns of a measured file hold the time and the states, in which units: headings read word by word.

"Pole_Angle1 [deg]" is pole, angle, 1, in degrees. A heading stands for a state by its

    kind      pos, position, angle, q … or vel, velocity, speed, dot …   (a position whose joint is named needs none)
    joint     a number from 1 or a name (cart, pole …), which a robot with one joint does not need
    source    meas before none before filt

and whatever else it says (des, tau, acc …) makes it another column. So `time,position,velocity,torque`,
`time,pos1,pos2,vel1,vel2`, `time,cart_pos,pend_pos,cart_vel,pend_vel,force` and `time,pos_meas1,…,pos_filt1,…` are read
alike; the user chooses the columns of all others.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import final

from rtcd_jax.system.delimited import Table, listed, words
from rtcd_jax.system.errors import UserError, closest, printable

TIME = {"time", "t", "timestamp", "stamp"}
POSITION = {"pos", "position", "angle", "angular", "joint", "q"}
VELOCITY = {"vel", "velocity", "speed", "rate", "dot", "omega", "ω", "qd", "dq"}
SOURCES = {"meas": 0, "measured": 0, "mea": 0, "actual": 0, "filt": 2, "filtered": 2}
"""By word; the least is taken. Columns that name no source have 1."""
PLAIN = 1
JOINTS = {
    "theta": {"theta", "θ", "pend", "pendulum", "pole", "angle", "phi"},
    "cart": {"cart", "x", "slider"},
}
"""Other words for the joint of a state; every joint has its own name besides."""
SCALES = {
    "s": {"s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9},
    "rad": {"rad": 1.0, "deg": math.pi / 180, "°": math.pi / 180},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180, "°/s": math.pi / 180, "rpm": math.pi / 30},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
}
"""By a state's unit: the units that a heading may state, and what they are times the state's."""


@final
@dataclass(frozen=True)
class Column:
    """The column of a file that holds the time or a state: its place, its heading and its unit's scale.

    `numbered` columns were chosen by their place, so that headings do not matter.
    """

    place: int
    heading: str
    scale: float = 1.0
    numbered: bool = False

    def __str__(self) -> str:
        return printable(self.heading, 40) + (f" (times {self.scale:.6g})" if self.scale != 1 else "")


def find_columns(table: Table, units: Mapping[str, str], choices: Sequence[str] = ()) -> dict[str, Column]:
    """The columns of the time and the states of `units`: the `choices` NAME=COLUMN, the others by their headings.

    Raises:
        UserError: a choice that names no state or no column, columns that are missing or there twice.
    """
    columns = dict(_chosen(table, units, choice) for choice in choices)
    missing, twice = [], []
    for name in (name for name in units if name not in columns):
        ranked = list(_candidates(table.headings, name, units))
        first = min((rank for rank, _ in ranked), default=None)
        best = [column for rank, column in ranked if rank == first]
        if len(best) == 1:
            columns[name] = best[0]
        elif best:
            twice.append(f"{name} ({' or '.join(f'{column}, number {column.place + 1}' for column in best)})")
        else:
            missing.append(f"{name} [{units[name]}]")
    problems = [f"no column for {', '.join(missing)}"] if missing else []
    problems += [f"more than one column for {', '.join(twice)}"] if twice else []
    if problems:
        raise UserError(
            f"{table.path} has {' and '.join(problems)}; its columns: {listed(table.headings)}; choose them by "
            f"--columns {' '.join(f'{name}=COLUMN' for name in units)}, COLUMN a name or a number from 1"
        )
    return {name: columns[name] for name in units}


def _chosen(table: Table, units: Mapping[str, str], choice: str) -> tuple[str, Column]:
    """What NAME=COLUMN chooses; NAME may be any heading that stands for one state."""
    name, _, column = (part.strip() for part in choice.partition("="))
    meant = [known for known in units if name == known] or [
        known for known in units if any(_candidates([name], known, units))
    ]
    if len(meant) != 1 or not column:
        raise UserError(
            f"--columns {printable(choice, 60)}: must be NAME=COLUMN with a NAME of this robot; "
            f"{closest(printable(name, 40), tuple(units))}"
        )
    places = [place for place, heading in enumerate(table.headings) if heading == column]
    numbered = not places and re.fullmatch(r"[1-9][0-9]{0,5}", column) is not None
    if numbered:
        places = [int(column) - 1]
    if len(places) != 1:
        there = f"{len(places)} columns of that name: choose by number, from 1" if places else "no such column"
        raise UserError(
            f"--columns {printable(choice, 60)}: {table.path} has {there}; its columns: {listed(table.headings)}"
        )
    heading = table.headings[places[0]] if places[0] < len(table.headings) else ""
    _, scale = _words_and_scale(heading, units[meant[0]])
    shown_heading = f"column {column}" if numbered else heading
    return meant[0], Column(places[0], shown_heading, _known(scale, heading, units[meant[0]]), numbered)


def _candidates(headings: Sequence[str], name: str, units: Mapping[str, str]) -> Iterator[tuple[int, Column]]:
    """Every column that can be the time or the state `name`, with the rank of its source."""
    states = [known for known in units if known != "time"]
    for place, heading in enumerate(headings):
        parts, scale = _words_and_scale(heading, units[name])
        rank = _rank(set(parts), name, states)
        if rank is not None:
            yield rank, Column(place, heading, _known(scale, heading, units[name]))


def _words_and_scale(heading: str, unit: str) -> tuple[list[str], float | None]:
    """The heading's words without its unit, and that unit times the state's: "Angle [deg]" or "angle_deg".

    1 where it states none, None where brackets hold another one.
    """
    scales = SCALES.get(unit, {unit: 1.0})
    bracket = re.fullmatch(r"([^\[(]*)[\[(]([^\])]*)[\])]?\s*", heading)
    if bracket and not bracket[2].strip().isdecimal():  # q[1] is an index
        return words(bracket[1]), scales.get(bracket[2].replace(" ", "").lower())
    parts = words(heading)
    for count in (2, 1):
        stated = "/".join(parts[-count:])
        if stated in scales and len(parts) > count:
            return parts[:-count], scales[stated]
    return parts, 1.0


def _known(scale: float | None, heading: str, unit: str) -> float:
    if scale is None:
        raise UserError(f"the column {printable(heading, 40)} must be in {' or '.join(SCALES.get(unit, [unit]))}")
    return scale


def _rank(parts: set[str], name: str, states: Sequence[str]) -> int | None:
    """The rank of the source of a heading that stands for `name`, the time or one of the `states`; None for others."""
    parts = {part for word in parts for part in _apart(word)}
    rank = min((SOURCES[part] for part in parts & SOURCES.keys()), default=PLAIN)
    parts -= SOURCES.keys()
    if name == "time":
        return rank if parts and parts <= TIME else None
    joints, index = len(states) // 2, states.index(name)
    joint = states[index % joints]
    of_joint = parts & {*words(joint), *JOINTS.get(joint, ())}
    numbers = {part for part in parts - of_joint if part.isdecimal()}
    kind = parts - of_joint - numbers
    named = not numbers if joints == 1 else numbers == {str(index % joints + 1)} or bool(of_joint and not numbers)
    right = kind <= POSITION if index < joints else bool(kind & VELOCITY) and kind <= VELOCITY | POSITION
    return rank if named and right and parts else None


def _apart(word: str) -> tuple[str, ...]:
    """thetadot is theta, dot."""
    return (word[:-3], "dot") if word.endswith("dot") and len(word) > 3 else (word,)
