"""A certificate's closed loop and funnel in floats, written apart from the package: to falsify what is proved.

One robot and no disturbance: that of a claim without uncertainty.
"""

import numpy as np

from tests.certificate.swing import rate


def floats(values):
    return np.array([floats(v) for v in values]) if isinstance(values, list) else float.fromhex(values)


class Simulated:
    """Motions that start on and in the ellipsoid of one interval, followed to t_N and beyond."""

    def __init__(self, content, steps=20, rate=rate):
        claim = content["claim"]
        self.parameters = {key: float.fromhex(low) for key, (low, _) in claim["parameters"].items()}
        self.x, self.rates, self.u, self.K = (floats(claim[key]) for key in ("x", "rates", "u", "K"))
        self.goal, self.goal_gain, self.dt = (floats(claim[key]) for key in ("x_goal", "K_goal", "dt"))
        self.limit, self.steps, self.rate = floats(claim["limit"])[0], steps, rate
        self.funnel, self.goal_axes = content["funnel"], floats(content["goal"]["axes"])

    def nominal(self, k, t):
        a, b, va, vb = self.x[k], self.x[k + 1], self.rates[k][0] * self.dt, self.rates[k][1] * self.dt
        return (2 * t**3 - 3 * t**2 + 1) * a + (t**3 - 2 * t**2 + t) * va + (3 - 2 * t) * t**2 * b + (t**3 - t**2) * vb

    def largest_levels(self, first, y):
        """max |y| at the end of every step from interval `first` on, then at the goal; `y` [2 M] in the unit ball."""
        piece = self.funnel[first]
        center = self.nominal(piece["knot"], float.fromhex(piece["start"]))
        x, levels = center[:, None] + floats(piece["first"]) @ y, []
        for piece in self.funnel[first:]:
            k, start, end = piece["knot"], *(float.fromhex(piece[key]) for key in ("start", "end"))
            step = (end - start) / self.steps
            for i in range(self.steps):
                x = self.step(lambda x, t, k=k: self.tracking(k, t, x), x, start + i * step, step)
                levels.append(self._level(piece, k, start + (i + 1) * step, -1 + 2 * (i + 1) / self.steps, x))
        return levels, self.goal_levels(x)

    def tracking(self, k, t, x):
        gain = (1 - t) * self.K[k] + t * self.K[k + 1]
        u = self.u[k] - gain @ (x - self.nominal(k, t)[:, None])
        return self.dt * self.rate(x, np.clip(u, -self.limit, self.limit), self.parameters)

    def _level(self, piece, k, t, s, x):
        bend = floats(piece["bend"])
        straight = (floats(piece["first"]) * (1 - s) + floats(piece["last"]) * (1 + s)) / 2
        axes = straight + (1 - s * s) * (bend[0] + s * bend[1])
        return np.linalg.norm(np.linalg.solve(axes, x - self.nominal(k, t)[:, None]), axis=0).max()

    def goal_levels(self, x, duration=12.0, step=0.01):
        def held(x, _):
            u = -self.goal_gain @ (x - self.goal[:, None])
            return self.rate(x, np.clip(u, -self.limit, self.limit), self.parameters)

        levels = []
        for _ in range(round(duration / step)):
            levels.append(np.linalg.norm(np.linalg.solve(self.goal_axes, x - self.goal[:, None]), axis=0))
            x = self.step(held, x, 0.0, step)
        return np.array(levels)

    @staticmethod
    def step(f, x, t, h):
        a = f(x, t)
        b = f(x + h / 2 * a, t + h / 2)
        c = f(x + h / 2 * b, t + h / 2)
        return x + h / 6 * (a + 2 * b + 2 * c + f(x + h * c, t + h))


def ball(count, seed=0):
    """Half of them on the boundary of the unit disk, half uniform inside."""
    random = np.random.default_rng(seed)
    angle, radius = random.uniform(0, 2 * np.pi, count), np.sqrt(random.uniform(size=count))
    radius[::2] = 1
    return radius * np.stack([np.cos(angle), np.sin(angle)])
