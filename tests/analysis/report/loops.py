"""Run folders with a real closed loop: a motion into the upright, its LQR, and a level, for both robots."""

import numpy as np

from tests.analysis.report.runs import experiment, run_folder
from tests.certificate import balance, swing

LOOPS = {"pendulum": swing, "cartpole": balance}
PROMISE = {
    "status": "OK", "rung": "sampled", "epsilon": 0.01, "confidence": 0.99, "design": {}, "weights": {},
    "config_hash": "0" * 12,
}  # fmt: skip


def stored(plant):
    """Arrays and record of an elite."""
    arrays, record = LOOPS[plant].elite()
    volumes = {f"volumes_{name}": np.array(1.0) for name in ("sum", "integral", "inlet", "geometric_mean")}
    return arrays | volumes, record | PROMISE


def loop_folder(path, plant, initial=None):
    """A run folder whose elite 000 is such a loop, the initial candidate too unless `initial` says otherwise."""
    arrays, record = stored(plant)
    task = {"start": arrays["x"][0].tolist(), "goal": arrays["x_goal"].tolist()}
    config = experiment(plant, task=task)
    return run_folder(path, config, (arrays, record | (initial or {})), (arrays, record))
