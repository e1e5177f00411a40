"""The closed loop of a stored elite before C MuJoCo, sampled at a video's times."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from jaxtyping import Float

from rtcd_jax.elite.closed_loop import ClosedLoop, Dynamics, fastest_rate, runge_kutta
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.funnel import FunnelInterpolant
from rtcd_jax.elite.simulators import STEP_OF_FASTEST, STEPS
from rtcd_jax.plants import model_of


@final
@dataclass(frozen=True)
class Motions:
    """Some starts of one elite's loop: states at the times [s], and V/rho there."""

    time: Float[np.ndarray, " T"]
    x: Float[np.ndarray, "T starts n"]
    ratio: Float[np.ndarray, "T starts"]


def motions(
    funnel: FunnelInterpolant, f: Dynamics, starts: Float[np.ndarray, "starts n"], time: Float[np.ndarray, " T"]
) -> Motions:
    """The closed loop from `starts` at t = 0 on, after the last knot held by the goal's LQR, or standing still in the
    catch set; `time` is ascending.
    """
    elite = funnel.elite
    interval = float(np.min(np.diff(elite.time)))
    march = runge_kutta(f, min(interval / STEPS, STEP_OF_FASTEST / fastest_rate(elite, f)))
    loop = ClosedLoop.of(elite, f)
    x, times, states = starts, [0.0], [starts]
    ends = [*elite.time, *np.arange(elite.time[-1] + interval, time[-1] + interval, interval)]
    for k, (begin, end) in enumerate(itertools.pairwise(ends)):
        if k >= len(elite.u) and elite.caught:
            break
        policy = loop.tracking(k) if k < len(elite.u) else loop.holding()
        passed = list(march(policy, begin, end, x))
        times += np.linspace(begin, end, len(passed) + 1)[1:].tolist()
        states += passed
        x = passed[-1]
    flat = np.array(states).reshape(len(states), -1)
    x = np.stack([np.interp(time, times, column) for column in flat.T], axis=1).reshape(len(time), *starts.shape)
    return Motions(time, x, np.stack([funnel.ratio(time, x[:, i]) for i in range(len(starts))], axis=1))


def frame_times(elites: Sequence[Elite], hold: float, rate: float) -> Float[np.ndarray, " T"]:
    """Frames of a video [s] that shows the longest motion and `hold` seconds after it, `rate` a second.

    What ends in a catch set stands still there.
    """
    longest = max(float(elite.time[-1]) for elite in elites)
    return np.arange(math.ceil((longest + hold) * rate) + 1) / rate


def dynamics_before_mujoco(elite: Elite, starts: int) -> tuple[Any, Dynamics]:
    """The compiled model of the elite's design and its accelerations, for so many states at once."""
    from rtcd_jax.plants.model import CpuDynamics

    model = model_of(elite.robot, elite.parameters)
    return model, CpuDynamics(model, max(starts, elite.x_goal.size + elite.u_max.size, 2))
