"""`rtcd export`: what a lab needs of one elite, in one folder that stands alone.

Tables, the controller with its funnel monitor in numpy and in C99, test vectors, and the design as MJCF and URDF. All
mean the closed loop that the run has sampled: x*(t) cubic Hermite, K linear, after t_N the goal's LQR or, where the
motion ends in a catch set, nothing.
"""

import contextlib
import hashlib
import io
import json
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import yaml

from rtcd_jax.certificate.standing import certificate_path
from rtcd_jax.elite.records import elite_name
from rtcd_jax.export import robot, source, tables
from rtcd_jax.export.bundle import Bundle, read_bundle
from rtcd_jax.system.console import Console, each_second
from rtcd_jax.system.errors import UserError, printable
from rtcd_jax.system.files import plain, replace, replace_json, require_own_folder, writing

FORMAT = "rtcd_jax export"
VERSION = 1
MARK = "export.json"
"""Says that a folder is an export, and the digest of every file that belongs to it."""


def export_run(folder: Path, elite: int | str, target: Path, console: Console, label: str | None = None) -> None:
    """Writes one elite of a run folder, by number or "initial", into `target`: a new, empty or former export folder.

    `label` names the controller's files and symbols, by default after robot and elite.

    Raises:
        UserError: no run folder, no such elite, one without a funnel, or a target that holds something else.
    """
    former = _former(target)
    bundle = read_bundle(folder, elite_name(elite), label, each_second(console))
    contents = _files(folder, bundle)
    _require_ours(target, former, contents)
    digests = {file: _digest(content) for file, content in contents.items()}
    stale = {file: digest for file, digest in former.items() if file not in contents}
    with writing(target):
        target.mkdir(parents=True, exist_ok=True)
        for file in contents:
            (target / f".{file}.tmp").unlink(missing_ok=True)
    # Written twice, so that a folder that a kill has left half old and half new says so.
    _mark(target, bundle, complete=False, files=stale | digests)
    for file, content in contents.items():
        replace(target / file, content)
    changed = [file for file, digest in stale.items() if not _remove(target / file, digest)]
    _mark(target, bundle, complete=True, files=digests)
    for line in _summary(bundle, target, bool(former), changed):
        console.message(line)


def export_cycle(targets: Sequence[Path], console: Console) -> None:
    """Writes `cycle.py` beside the exports of a cycle's tasks, which are in its order: the hand-over between them.

    Raises:
        UserError: another file has that name, or the folder cannot be written.
    """
    path, text = targets[0].parent / "cycle.py", source.template("cycle.py")
    head = text.splitlines()[0]
    if path.exists() and not path.read_text(encoding="utf-8", errors="replace").startswith(head):
        raise UserError(f"{path} is there, and no export has written it: move it away, or choose another folder")
    names = [(target.name, json.loads((target / MARK).read_bytes())["name"]) for target in targets]
    replace(path, text.replace("SWINGS = ()", f"SWINGS = {tuple(names)!r}").encode())
    console.message(f"hand-over from swing to swing: {path}; try it: python {path}")


def _former(target: Path) -> dict[str, str]:
    """The files of the export that `target` holds already, with their digests; nothing else may be replaced.

    Raises:
        UserError: `target` is a file, or a folder with something else in it.
    """
    mark, files = target / MARK, None
    if mark.is_file() and not mark.is_symlink():
        with contextlib.suppress(ValueError, KeyError, TypeError, AttributeError, RecursionError, OSError):
            stored = json.loads(mark.read_bytes())
            if stored["format"] == FORMAT:
                files = {name: str(digest) for name, digest in stored["files"].items() if _is_plain(name)}
    require_own_folder(target, "an export", files is not None)
    return files or {}


def _is_plain(name: str) -> bool:
    """True for the name of a file directly inside a folder, on any system."""
    return name not in ("", ".", "..", MARK) and not re.search(r"[/\\:\0]", name)


def _require_ours(target: Path, former: Mapping[str, str], contents: Mapping[str, bytes]) -> None:
    """Raises UserError where a file would be replaced that no export has written."""
    foreign = [file for file in contents if file not in former and os.path.lexists(target / file)]
    if foreign:
        raise UserError(
            f"{target} has {', '.join(foreign[:5])}, which the former export has not written: "
            "move it away, or choose another folder"
        )


def _remove(path: Path, digest: str) -> bool:
    """Deletes a file that is still as a former export has written it; True if nothing is there any more."""
    if not os.path.lexists(path):
        return True
    with writing(path):
        if path.is_symlink() or not path.is_file() or _digest(path.read_bytes()) != digest:
            return False
        path.unlink()
    return True


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _mark(target: Path, bundle: Bundle, complete: bool, files: Mapping[str, str]) -> None:
    about = {
        "name": bundle.label,
        "plant": bundle.elite.plant,
        "elite": bundle.name,
        "claim": bundle.standing.claim if bundle.proof else None,
    }
    replace_json(target / MARK, {"format": FORMAT, "version": VERSION, "complete": complete, **about, "files": files})


def _files(folder: Path, bundle: Bundle) -> dict[str, bytes]:
    """Every file of the export by its name."""
    described = bundle.describe()
    texts = {
        "README.md": source.readme(bundle, described),
        f"{bundle.label}_controller.json": json.dumps(plain(described), indent=2, ensure_ascii=False, allow_nan=False)
        + "\n",
        "parameters.yaml": _parameters(bundle, described),
        "trajectory.csv": tables.trajectory(bundle),
        "gains.csv": tables.gains(bundle),
        "funnel.csv": tables.funnel(bundle),
        "test_vectors.csv": tables.vectors(bundle),
        **source.sources(bundle),
        **_robot(bundle),
    }
    archive = io.BytesIO()
    np.savez(archive, **bundle.arrays())  # type: ignore[arg-type]
    contents = {name: text.encode() for name, text in texts.items()}
    contents[f"{bundle.label}_controller.npz"] = archive.getvalue()
    if bundle.proof:
        contents["certificate.json"] = certificate_path(folder, bundle.name).read_bytes()
    return contents


def _robot(bundle: Bundle) -> dict[str, str]:
    elite = bundle.elite
    with jax.enable_x64(True):
        edits = jax.tree.map(np.asarray, bundle.plant.edit_model(bundle.design))
    return {
        "robot.xml": robot.mjcf(bundle.plant.xml, edits, elite.u_max.tolist()),
        "robot.urdf": robot.urdf(elite.plant, bundle.model, elite.state_limits.tolist(), elite.u_max.tolist()),
    }


def _parameters(bundle: Bundle, described: Mapping[str, Any]) -> str:
    units = described["parameter_units"]
    numbers = {name: {"value": value, "unit": units[name]} for name, value in described["parameters"].items()}
    origin = {key: described[key] for key in ("plant", "design", "weights", "config_hash")}
    return yaml.safe_dump(plain({**origin, "parameters": numbers}), sort_keys=False, default_flow_style=None, width=120)


def _summary(bundle: Bundle, target: Path, again: bool, changed: Sequence[str]) -> Iterator[str]:
    verb, standing = "replaces the former export" if again else "is", bundle.standing
    yield f"{bundle.elite.plant}, elite {bundle.name}, {verb} in {target}; its monitor's funnel is {bundle.guarantee}"
    if bundle.proof:
        where = target / "certificate.json"
        yield f"certificate: proved from {standing.start:.6g} s on, in {where}; claim: sha256 {standing.claim}"
    elif standing.verdict == "missing":
        yield "certificate: none; `rtcd certify` proves the funnel"
    else:
        yield f"certificate: {standing.verdict}, so it does not go along: {printable(standing.reason)}"
    yield f"control rate: {bundle.control_rate.sentence}"
    if changed:
        yield f"left where they are, for they were changed since the former export: {', '.join(changed)}"
    yield f"test it: python {target / f'{bundle.label}_controller.py'}"
