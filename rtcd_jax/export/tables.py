"""A bundle as tables that people and toolkits read: CSV with a header row, SI units, numbers that read back exactly."""

from collections.abc import Sequence

import numpy as np

from rtcd_jax.elite.elite import ellipsoid_axes
from rtcd_jax.export.bundle import Bundle

VECTORS = 400
"""Rows of the test vectors."""
LONGEST = 1.1
"""Last time of the test vectors over that of the last knot."""
FARTHEST = 2.0
"""Of the test vectors: so many times as far from the nominal motion as the funnel reaches."""


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
    """Times, states around the funnel, and what controller and monitor must say there: u and V/rho."""
    elite, random = bundle.elite, np.random.default_rng(0)
    n, m = elite.x_goal.size, elite.u_max.size
    rows = []
    for t in np.sort(random.uniform(0, LONGEST * elite.time[-1], VECTORS)):
        now = bundle.at(t)
        direction = random.normal(size=n)
        reach = FARTHEST * random.uniform()
        error = ellipsoid_axes(now.value, np.asarray(now.level)) @ (reach * direction / np.linalg.norm(direction))
        u = np.clip(now.u - now.gain @ error, -elite.u_max, elite.u_max)
        rows.append([t, *(now.x + error), *u, reach**2])
    header = ["time", *(f"x{i + 1}" for i in range(n)), *(f"u{j + 1}" for j in range(m)), "V_over_rho"]
    return csv(header, np.array(rows))


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
