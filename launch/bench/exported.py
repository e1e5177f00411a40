"""Time of one step of an exported controller: `rtcd export RUN --to DIR`, then this script on DIR.

Python by its median over many single calls, C by the loop in its test, both on the motion itself.
"""

import argparse
import importlib.util
import json
import re
import shutil
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from types import ModuleType

from measure import RESULTS, environment, save

CALLS = 20_000


def _name(folder: Path) -> str:
    """Of the controller's files."""
    return json.loads((folder / "export.json").read_text())["name"]


def load_controller(folder: Path) -> ModuleType:
    """The exported module, from its file."""
    spec = importlib.util.spec_from_file_location("controller", folder / f"{_name(folder)}_controller.py")
    if spec is None or spec.loader is None:
        raise SystemExit(f"{folder} is no export: it has no controller")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def python_steps(folder: Path) -> dict[str, float]:
    """Median microseconds of a call."""
    controller = load_controller(folder).Controller(folder)
    x = controller.x_goal + 0.01
    half = len(x) // 2
    pos, vel = (float(x[0]), float(x[1])) if half == 1 else (x[:half], x[half:])
    calls = {
        "get_control_output": lambda t: controller.get_control_output(pos, vel, None, t),
        "control": lambda t: controller.control(t, x),
        "monitor": lambda t: controller.monitor(t, x),
    }
    return {name: 1e6 * _median(call, controller.duration) for name, call in calls.items()}


def _median(call, duration: float) -> float:
    taken = []
    for i in range(CALLS):
        begin = time.perf_counter()
        call(duration * i / CALLS)
        taken.append(time.perf_counter() - begin)
    return statistics.median(taken)


def c_step(folder: Path) -> float | None:
    """Microseconds of controller and monitor together; None without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as place:
        program = Path(place) / "controller_test"
        sources = [folder / f"{_name(folder)}_controller{end}.c" for end in ("_test", "")]
        subprocess.run([compiler, "-std=c99", "-O2", *sources, "-lm", "-o", program], check=True)
        done = subprocess.run([program, folder / "test_vectors.csv"], check=True, capture_output=True, text=True)
    found = re.search(r"(\d+) ns", done.stdout)
    return float(found.group(1)) / 1e3 if found else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, metavar="DIR", help="an exported folder")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the JSON file")
    arguments = parser.parse_args()
    steps: dict[str, float | None] = dict(python_steps(arguments.folder))
    steps["C, control and monitor"] = c_step(arguments.folder)
    for name, taken in steps.items():
        print(f"{name:24}" + ("no C compiler" if taken is None else f"{taken:10.3f} us"))
    plant = (arguments.folder / "README.md").read_text().splitlines()[0].removeprefix("# Controller of a ")
    record = {"plant": plant, **environment("numpy"), "microseconds": steps}
    print(f"written: {save(f'exported_{plant}.json', record, arguments.results)}")


if __name__ == "__main__":
    main()
