"""Swing after swing of a cycle of tasks: the controllers of this export, and the hand-over between them.

    cycle = Cycle()
    u, watch = cycle.control(t, x), cycle.monitor(t, x)      x = (positions, velocities), from the bar that holds
    ... at the swing's end, `cycle.over(t)`: the free hook is on the next bar, the other one lets go
    watch = cycle.hand_over(t, cycle.after_catch(x))         x+ is counted from the new bar; begins the next swing

Needs numpy. `python cycle.py [SWINGS]` follows a disturbed start through that many swings (4) in MuJoCo, with the
plastic impact of `after_catch` between them; on a robot the state after a catch is the measured one, counted from the
new bar.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
SWINGS = ()
"""Folder and name of each swing's controller, in the order of the cycle."""
NEAR = 0.9
"""V/rho of the start in MuJoCo."""


class Cycle:
    """The controllers of all swings; `number` counts the swings from 0, `begun` is when the present one began [s]."""

    def __init__(self, folder: Path | str = HERE, wrapped: bool = False):
        self.controllers, self._robots = [], []
        for place, name in SWINGS:
            own = Path(folder) / place
            spec = importlib.util.spec_from_file_location(f"{place}_{name}", own / f"{name}_controller.py")
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            self.controllers.append(module.Controller(own, wrapped=wrapped))
            described = json.loads((own / f"{name}_controller.json").read_text(encoding="utf-8"))
            self._robots.append(described["parameters"])
        self.number, self.begun = 0, 0.0

    @property
    def controller(self):
        """That of the present swing."""
        return self.controllers[self.number % len(self.controllers)]

    def control(self, t: float, x) -> np.ndarray:
        """u; zero after the swing's end, until the next one begins."""
        return self.controller.control(t - self.begun, x)

    def monitor(self, t: float, x):
        """Whether x is in the present swing's funnel; at its very end, whether it is caught."""
        return self.controller.monitor(t - self.begun, x)

    def over(self, t: float) -> bool:
        """Whether the swing has come to its end."""
        return t - self.begun >= self.controller.duration

    def after_catch(self, x) -> np.ndarray:
        """The model's state from the new bar, after the free hook took it at x, and the other one let go:

        M+ w+ = X w- of the links' rates: of their momentum as much is kept as motions about the new bar see.
        """
        robot = self._robots[self.number % len(self._robots)]
        links = [link for link in ("support", "body", "swing") if f"{link}_mass" in robot]
        arm, of_links = robot["arm_length"], ("mass", "center", "inertia")
        masses, centers, inertias = (np.array([robot[f"{link}_{what}"] for link in links]) for what in of_links)
        angles, rates = (np.cumsum(part) for part in np.split(np.asarray(x, float).reshape(-1), 2))
        along = np.stack([np.cos(angles), np.sin(angles)], 1)  # of the links' ends, for a unit rate
        # Velocities of the links' centers per unit rate of each link: about the old bar, and about the new one.
        before, after = np.zeros((2, len(links), len(links), 2))
        before[1:, 0], after[:-1, -1] = arm * along[0], -arm * along[-1]
        for i, link in enumerate(links):
            before[i, i], after[i, i] = centers[i] * along[i], (centers[i] - arm * (link != "body")) * along[i]
        mass_matrix = np.einsum("l,lak,lbk->ab", masses, after, after) + np.diag(inertias)
        momentum = np.einsum("l,lak,lbk,b->a", masses, after, before, rates) + inertias * rates
        angles[[0, -1]] -= np.pi  # the arms, from their other ends
        ends = angles[::-1], np.linalg.solve(mass_matrix, momentum)[::-1]  # the swing arm holds now
        return np.concatenate([np.diff(end, prepend=0) for end in ends])

    def hand_over(self, t: float, x):
        """Begins the next swing at t if x, from the new bar, is inside its first ellipsoid; what its monitor says."""
        following = self.controllers[(self.number + 1) % len(self.controllers)]
        watch = following.monitor(0.0, x)
        if watch.inside:
            self.number, self.begun = self.number + 1, t
        return watch


def simulate(cycle: Cycle, swings: int, seed: int = 0) -> bool:
    """Prints V/rho at the start and at the end of every swing in MuJoCo; whether all were inside."""
    import mujoco

    direction = np.random.default_rng(seed).normal(size=len(cycle.controller.x_goal))
    x = cycle.controller.nominal(0.0) + 1e-6 * direction
    x = cycle.controller.nominal(0.0) + 1e-6 * direction * np.sqrt(NEAR / cycle.monitor(0.0, x).ratio)
    begin = 0.0
    for number in range(swings):
        controller = cycle.controller
        model = mujoco.MjModel.from_xml_path(str(HERE / SWINGS[number % len(SWINGS)][0] / "robot.xml"))
        steps = int(np.ceil(controller.dt / 1e-3))
        model.opt.timestep = controller.dt / steps
        data, first = mujoco.MjData(model), controller.monitor(0.0, x).ratio
        data.qpos[:], data.qvel[:] = np.split(x, 2)
        for k in range(round(controller.duration / model.opt.timestep)):
            data.ctrl[:] = controller.control(k * model.opt.timestep, np.concatenate([data.qpos, data.qvel]))
            mujoco.mj_step(model, data)
        x = np.concatenate([data.qpos, data.qvel])
        caught = controller.monitor(controller.duration, x)
        print(f"swing {number + 1}: V/rho {first:.3g} at the start, {caught.ratio:.3g} at the catch")
        begin += controller.duration
        x = cycle.after_catch(x)
        if not caught.inside or not cycle.hand_over(begin, x).inside:
            return False
    return True


if __name__ == "__main__":
    sys.exit(0 if simulate(Cycle(), int(sys.argv[1]) if len(sys.argv) > 1 else 4) else 1)
