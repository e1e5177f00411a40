"""`rtcd export`: what a lab needs of one elite, in one folder that stands alone.

Tables, the controller with its funnel monitor in numpy and in C99, test vectors, and the design as MJCF and URDF. All
mean the closed loop that the run has sampled: x*(t) cubic Hermite, K linear, after t_N the goal's LQR.
"""

import hashlib
import io
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import jax
import numpy as np
import yaml

from rtcd_jax.elite.records import elite_name
from rtcd_jax.export import robot, source, tables
from rtcd_jax.export.bundle import Bundle, certificate_path, read_bundle
from rtcd_jax.system.errors import UserError
from rtcd_jax.system.files import is_temporary, plain, replace, replace_json, writing

FORMAT = "rtcd_jax export"
VERSION = 1
MARK = "export.json"
"""Says that a folder is an export, and the digest of every file that belongs to it."""


class Console(Protocol):
    def message(self, text: str, /) -> None: ...


def export_run(folder: Path, elite: int | str, target: Path, console: Console) -> None:
    """Writes one elite of a run folder, by number or "initial", into `target`: a new, empty or former export folder.

    Raises:
        UserError: no run folder, no such elite, one without a funnel, or a target that holds something else.
    """
    bundle = read_bundle(folder, elite_name(elite))
    former = _claim(target)
    contents = _files(folder, bundle)
    with writing(target):
        target.mkdir(parents=True, exist_ok=True)
        for leftover in target.glob(".*.tmp"):
            leftover.unlink()
    digests = {file: hashlib.sha256(content).hexdigest() for file, content in contents.items()}
    # Written twice, so that a folder that a kill has left half old and half new says so.
    _mark(target, complete=False, files=digests)
    for file, content in contents.items():
        replace(target / file, content)
    with writing(target):
        for stale in former - contents.keys():
            (target / stale).unlink(missing_ok=True)
    _mark(target, complete=True, files=digests)
    for line in _summary(bundle, target, bool(former)):
        console.message(line)


def _claim(target: Path) -> frozenset[str]:
    """The files of the export that `target` holds already; nothing else may be replaced."""
    if target.exists() and not target.is_dir():
        raise UserError(f"{target} is a file: an export needs a folder")
    if not target.is_dir():
        return frozenset()
    mark = target / MARK
    if mark.is_file():
        try:
            stored = json.loads(mark.read_bytes())
            if stored["format"] == FORMAT:
                return frozenset(stored["files"])
        except (ValueError, KeyError, TypeError, OSError):
            pass
    foreign = sorted(item.name for item in target.iterdir() if not is_temporary(item))
    if foreign:
        raise UserError(
            f"{target} is not empty and no former export: it has {', '.join(foreign[:5])}; choose another one"
        )
    return frozenset()


def _mark(target: Path, complete: bool, files: Mapping[str, str]) -> None:
    replace_json(target / MARK, {"format": FORMAT, "version": VERSION, "complete": complete, "files": files})


def _files(folder: Path, bundle: Bundle) -> dict[str, bytes]:
    """Every file of the export by its name."""
    described = bundle.describe()
    texts = {
        "README.md": source.readme(bundle, described),
        "controller.json": json.dumps(plain(described), indent=2, ensure_ascii=False, allow_nan=False) + "\n",
        "parameters.yaml": _parameters(bundle, described),
        "trajectory.csv": tables.trajectory(bundle),
        "gains.csv": tables.gains(bundle),
        "funnel.csv": tables.funnel(bundle),
        "test_vectors.csv": tables.vectors(bundle),
        "controller_size.h": source.size_header(bundle),
        "controller_data.h": source.data_header(bundle),
        **{name: source.template(name) for name in source.COPIED},
        **_robot(bundle),
    }
    archive = io.BytesIO()
    np.savez(archive, **bundle.arrays())  # type: ignore[arg-type]
    contents = {name: text.encode() for name, text in texts.items()} | {"controller.npz": archive.getvalue()}
    if bundle.certificate:
        contents["certificate.json"] = certificate_path(folder, bundle.name).read_bytes()
    return contents


def _robot(bundle: Bundle) -> dict[str, str]:
    elite = bundle.elite
    with jax.enable_x64(True):
        edits = jax.tree.map(np.asarray, bundle.plant.edit_model(bundle.design))
    return {
        "robot.xml": robot.mjcf(bundle.plant.mjcf, edits, elite.u_max.tolist()),
        "robot.urdf": robot.urdf(elite.plant, bundle.model, elite.state_limits.tolist(), elite.u_max.tolist()),
    }


def _parameters(bundle: Bundle, described: Mapping[str, Any]) -> str:
    units = described["parameter_units"]
    numbers = {name: {"value": value, "unit": units[name]} for name, value in described["parameters"].items()}
    kept = {key: described[key] for key in ("plant", "design", "weights", "config_hash")}
    return yaml.safe_dump(plain({**kept, "parameters": numbers}), sort_keys=False, default_flow_style=None, width=120)


def _summary(bundle: Bundle, target: Path, again: bool) -> Iterator[str]:
    plant, rung, certificate = bundle.elite.plant, bundle.elite.guarantee, bundle.certificate
    verb = "replaces the former export" if again else "is"
    yield f"{plant}, elite {bundle.name} with its {rung} funnel, {verb} in {target}"
    if certificate:
        yield f"certificate: rung {certificate['rung'] or 'unknown'}, in {target / 'certificate.json'}"
    else:
        yield "certificate: none; `rtcd certify` proves the funnel"
    yield f"test it: python {target / 'controller.py'}"
