"""A bundle as tables that people and toolkits read: CSV with a header row, SI units, numbers that read back exactly."""

import sys
from collections.abc import Sequence

import numpy as np

from rtcd_jax.export.bundle import Bundle

VECTORS = 400
"""Rows of the test vectors."""
LONGEST = 1.1
"""Last time of the test vectors over that of the last knot."""
FARTHEST = 2.5
"""Of the test vectors: so many times as far from the nominal motion as the funnel reaches."""
ABORT = 4.0
"""Ratio above which the exported monitors advise to abort."""
LARGEST = sys.float_info.max
"""The ratio of what is not finite, and after a catch."""


def trajectory(bundle: Bundle) -> str:
    """The nominal motion at the knots, with the columns that the DFKI toolkits read.

    One joint: time, pos, vel, torque. Two: time, pos1, pos2, vel1, vel2, tau1, tau2, and the gains K11 ... K24 of the
    joints' inputs. The torque of a row is held until the next one; the last one is the goal's.
    """
    elite = bundle.elite
    feedforward = np.concatenate([elite.u, np.zeros_like(elite.u[:1])])
    inputs = _by_joint(bundle, feedforward)
    if inputs.shape[1] == 1:
        return csv(("time", "pos", "vel", "torque"), elite.time, elite.x, inputs)
    header = [f"{kind}{i + 1}" for kind in ("pos", "vel", "tau") for i in range(inputs.shape[1])]
    gains = np.stack([_by_joint(bundle, elite.K[:, :, i]) for i in range(elite.x_goal.size)], axis=2)
    return csv(["time", *header, *entries("K", gains)], elite.time, elite.x, inputs, gains)


def gains(bundle: Bundle) -> str:
    """K_k at the knots, one row of it for each input: u = clip(u_k - K (x - x*)); the last one is the goal's."""
    return csv(["time", *entries("K", bundle.elite.K)], bundle.elite.time, bundle.elite.K)


def funnel(bundle: Bundle) -> str:
    """rho_k, the ellipsoid's volume and the upper triangle of S_k at the knots."""
    elite, n = bundle.elite, bundle.elite.x_goal.size
    upper = np.triu_indices(n)
    names = [f"S{i + 1}{j + 1}" for i, j in zip(*upper, strict=True)]
    header = ["time", "rho", f"volume_{elite.guarantee}", *names]
    return csv(header, elite.time, elite.rho, elite.volumes_per_knot, elite.S[:, *upper])


def vectors(bundle: Bundle) -> str:
    """Times, states around the funnel, and what controller and monitor must say there: u, ratio, inside, abort, proved.

    In the last rows one entry of (t, x) is no number, or infinite.
    """
    random, n = np.random.default_rng(0), bundle.elite.x_goal.size
    rows = []
    for t in np.sort(random.uniform(0, LONGEST * bundle.elite.time[-1], VECTORS)):
        direction = random.normal(size=n)
        y = FARTHEST * random.uniform() * direction / np.linalg.norm(direction)
        rows.append(_vector(bundle, t, y))
    usual = rows[0]
    for bad in (np.nan, np.inf, -np.inf):
        for i in range(1 + n):
            row = usual.copy()
            row[i] = bad
            proved = bool(np.isfinite(row[0])) and usual[-1]
            rows.append([*row[: 1 + n], *np.zeros_like(bundle.elite.u_max), LARGEST, False, True, proved])
    names = [f"x{i + 1}" for i in range(n)], [f"u{j + 1}" for j in range(bundle.elite.u_max.size)]
    return csv(["time", *names[0], *names[1], "ratio", "inside", "abort", "proved"], np.array(rows, float))


def _vector(bundle: Bundle, t: float, y: np.ndarray) -> np.ndarray:
    """A row of the test vectors, for the state x* + axes y."""
    elite, now = bundle.elite, bundle.at(t)
    error, ratio = now.axes @ y, y @ y
    x, u = now.x + error, np.clip(now.u - now.gain @ error, -elite.u_max, elite.u_max)
    if elite.caught and t > elite.time[-1]:
        return np.array([t, *x, *np.zeros_like(u), LARGEST, False, True, False], float)
    outside = bool((np.abs(x) > elite.state_limits).any())
    return np.array([t, *x, *u, ratio, ratio <= 1 and not outside, ratio > ABORT or outside, now.proved], float)


def csv(header: Sequence[str], *columns: np.ndarray) -> str:
    """One row for every entry of the columns' first axis; what has further axes is written row by row."""
    table = np.concatenate([np.reshape(column, (len(column), -1)) for column in columns], axis=1)
    if table.shape[1] != len(header):
        raise ValueError(f"{len(header)} names for {table.shape[1]} columns")
    lines = [",".join(header), *(",".join(repr(value) for value in row) for row in table.tolist())]
    return "\n".join(lines) + "\n"


def entries(letter: str, matrices: np.ndarray) -> list[str]:
    """K11, K12, ... of matrices [... rows columns]."""
    rows, columns = matrices.shape[-2:]
    return [f"{letter}{i + 1}{j + 1}" for i in range(rows) for j in range(columns)]


def _by_joint(bundle: Bundle, values: np.ndarray) -> np.ndarray:
    """Inputs' values [knots m] as the joints' [knots n/2], zero where no motor is."""
    joints = np.zeros((len(values), bundle.elite.x_goal.size // 2))
    joints[:, bundle.joints] = values
    return joints
