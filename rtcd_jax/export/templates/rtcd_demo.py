"""The exported controller swings up `robot.xml` in MuJoCo. Needs numpy and mujoco, and the folder's files beside it.

    python rtcd_controller.py --demo [--seed N] [--headless]

The robot starts from a random state near the boundary of the first ellipsoid and is held at the goal for two seconds
more, unless the motion ends in a catch set. Where there is a display MuJoCo's viewer shows it; where there is none, or
with --headless, `demo.svg` has the states beside the nominal ones, the inputs with their limits, and V/rho.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np
from rtcd_controller import Controller

HOLD, STEP, NEAR = 2.0, 1e-3, 0.9
"""Seconds at the goal; longest step [s]; V/rho of the start."""
WIDTH, HEIGHT, LEFT, BETWEEN = 720, 130, 70, 26
"""Of a panel of the drawing, what is left for its labels, and the gap below it [pixels]."""


def start(controller: Controller, seed: int) -> np.ndarray:
    """A state in a random direction from x*(0), as far as V/rho = `NEAR`."""
    nominal = controller.nominal(0.0)
    direction = np.random.default_rng(seed).normal(size=nominal.shape)
    small = 1e-6 / np.linalg.norm(direction)
    ratio = controller.monitor(0.0, nominal + small * direction).ratio
    return nominal + small * np.sqrt(NEAR / ratio) * direction


def simulate(folder: Path, seed: int, view: bool):
    """Times [T], states [T n], inputs [T m] and ratios [T] of the motion; `view` shows it as it goes."""
    import mujoco

    controller = Controller(folder)
    model = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    steps = int(np.ceil(controller.dt / STEP))
    model.opt.timestep = controller.dt / steps  # so that the controller is called at every knot
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = np.split(start(controller, seed), 2)
    rows = []

    def step() -> None:
        x = np.concatenate([data.qpos, data.qvel])
        u = controller.control(data.time, x)
        rows.append((data.time, x, u, controller.monitor(data.time, x).ratio))
        data.ctrl[:] = u
        mujoco.mj_step(model, data)

    end = controller.duration - model.opt.timestep / 2 if controller.caught else controller.duration + HOLD
    if not view:
        while data.time < end:
            step()
    else:
        from mujoco import viewer

        with viewer.launch_passive(model, data) as window:
            begun = time.monotonic()
            while window.is_running() and data.time < end:
                step()
                if len(rows) % 16 == 0:
                    window.sync()
                    time.sleep(max(0.0, begun + data.time - time.monotonic()))
    times, states, inputs, ratios = zip(*rows)  # noqa: B905 (old Pythons have no strict=)
    return controller, np.array(times), np.array(states), np.array(inputs), np.array(ratios)


def drawing(controller: Controller, t: np.ndarray, x: np.ndarray, u: np.ndarray, ratio: np.ndarray) -> str:
    """An SVG: a panel for each state (dashed: nominal), each input (dashed: its limits), and V/rho (dashed: 1)."""
    nominal = np.array([controller.nominal(now) for now in t])
    panels = [(f"x{i + 1}", x[:, i], [nominal[:, i]]) for i in range(x.shape[1])]
    for j, limit in enumerate(controller.u_max):
        panels.append((f"u{j + 1}", u[:, j], [np.full_like(t, limit), np.full_like(t, -limit)]))
    panels.append(("V/rho", ratio, [np.ones_like(t)]))
    parts = []
    for row, (name, values, beside) in enumerate(panels):
        low, high = min(map(np.min, [values, *beside])), max(map(np.max, [values, *beside]))
        top, size = row * (HEIGHT + BETWEEN) + 10, max(high - low, 1e-12)

        def path(curve: np.ndarray, low: float = low, top: int = top, size: float = size) -> str:
            across, down = LEFT + WIDTH * t / t[-1], top + HEIGHT * (1 - (curve - low) / size)
            return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(across[::4], down[::4]))  # noqa: B905

        parts += [f'<path d="{path(curve)}" stroke="#999" stroke-dasharray="5 4"/>' for curve in beside]
        parts.append(f'<path d="{path(values)}" stroke="#d55e00" stroke-width="1.6"/>')
        for value, at in ((high, top + 10), (low, top + HEIGHT)):
            parts.append(f'<text x="{LEFT - 6}" y="{at}" text-anchor="end">{value:.3g}</text>')
        parts.append(f'<text x="{LEFT - 6}" y="{top + HEIGHT // 2}" text-anchor="end" font-weight="bold">{name}</text>')
    height = len(panels) * (HEIGHT + BETWEEN) + 20
    parts.append(f'<text x="{LEFT}" y="{height - 8}">0 … {t[-1]:.2f} s</text>')
    size = f'width="{LEFT + WIDTH + 10}" height="{height}"'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="11">'
    return f'{head}<rect width="100%" height="100%" fill="#fff"/><g fill="none">{_only(parts, "<path")}</g>' + (
        f"<g>{_only(parts, '<text')}</g></svg>\n"
    )


def _only(parts: list[str], kind: str) -> str:
    return "".join(part for part in parts if part.startswith(kind))


def main(words: list[str] | None = None, folder: Path = Path(__file__).parent) -> int:
    """Runs the demonstration; 0 if the motion ends in the funnel."""
    parser = argparse.ArgumentParser(prog="rtcd_controller.py --demo", description="The robot in MuJoCo.")
    parser.add_argument("--seed", type=int, default=0, help="of the start, near the first ellipsoid's boundary")
    parser.add_argument("--headless", action="store_true", help="draw demo.svg instead of opening the viewer")
    options = parser.parse_args(words)
    shown = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform in ("darwin", "win32"))
    view = shown and not options.headless
    controller, t, x, u, ratio = simulate(folder, options.seed, view)
    if not view:
        (folder / "demo.svg").write_text(drawing(controller, t, x, u, ratio), encoding="utf-8")
        print("demo.svg, beside the controller: states, inputs and V/rho over time")
    away = np.abs(x[-1] - controller.x_goal).max()
    print(f"at {t[-1]:.2f} s: {away:.2g} from the goal, largest V/rho {ratio.max():.3g}, at the end {ratio[-1]:.2g}")
    return 0 if ratio[-1] <= 1 else 1


if __name__ == "__main__":
    sys.exit(main())
