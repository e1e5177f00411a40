"""What `rtcd disturb` found that an elite bears, for the README of its export."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rtcd_jax.elite.records import INITIAL
from rtcd_jax.system.files import read_json, reading

CONTROLLERS = {INITIAL: "initial", "000": "best"}
"""The elites that are tried, by their names in the records."""
_ADVICE = "make it again by `rtcd disturb`"


def borne(folder: Path, name: str) -> str:
    """A list in Markdown, a line for each perturbation; empty where the elite was not tried.

    Raises:
        UserError: a record that cannot be read.
    """
    robustness, push = (folder / "disturbance" / f"{each}.json" for each in ("robustness", "push_margin"))
    controller = CONTROLLERS.get(name)
    if controller is None or not robustness.is_file():
        return ""
    with reading(robustness, _ADVICE):
        lines = list(_lines(read_json(robustness, _ADVICE)["troubles"], controller))
    if push.is_file():
        with reading(push, _ADVICE):
            record = read_json(push, _ADVICE)
            if tolerated := record["summary"].get(controller, {}).get("tolerated_at_all_times"):
                lines.append(f"- sudden push, at any time: up to {tolerated:.3g} {record['impulse_unit']}")
    head = "In simulation (`rtcd disturb`), each alone and from the nominal start, the motion still arrived with:"
    return "\n".join([head, "", *lines]) if lines else ""


def _lines(perturbations: list[Mapping[str, Any]], controller: str) -> Iterator[str]:
    for each in perturbations:
        if controller not in each["success"] or each["unit"] == "profile":
            continue
        pairs = list(zip(each["levels"], each["success"][controller], strict=True))
        held = _around(pairs, undisturbed=1.0 if "period" in each["unit"] else 0.0, descending=each["unit"] == "Hz")
        if held is None:
            yield f"- {each['name']}: not even undisturbed"
        else:
            yield f"- {each['name']}: {_words(held, each['unit'], [level for level, _ in pairs])}"


def _around(pairs: list[tuple[float, float]], undisturbed: float, descending: bool) -> tuple[float, float] | None:
    """The ends of the levels about the undisturbed one at which every motion arrived; None where that one did not."""
    ordered = sorted(pairs)
    base = len(ordered) - 1 if descending else min(range(len(ordered)), key=lambda i: abs(ordered[i][0] - undisturbed))
    if ordered[base][1] < 1:
        return None
    low = high = base
    while low > 0 and ordered[low - 1][1] >= 1:
        low -= 1
    while high + 1 < len(ordered) and ordered[high + 1][1] >= 1:
        high += 1
    return ordered[low][0], ordered[high][0]


def _words(held: tuple[float, float], unit: str, levels: list[float]) -> str:
    low, high = held
    if low == high:
        return "nothing that was tried"
    most = " (the most that was tried)" if high == max(levels) else ""
    if unit == "Hz":
        return f"down to {low:g} Hz" + (" (the least that was tried)" if low == min(levels) else "")
    if unit == "relative":
        ends = " (all that was tried)" if held == (min(levels), max(levels)) else ""
        return f"{100 * low:+.3g} to {100 * high:+.3g} %{ends}"
    if unit == "s":
        return f"up to {1000 * high:.3g} ms{most}"
    return f"up to {high:.3g} {'× the ' + unit.removeprefix('times the ') if not _is_si(unit) else unit}{most}"


def _is_si(unit: str) -> bool:
    return unit.split()[0] in ("N", "rad", "m", "kg")
