"""Evaluation -> the stable result format of `elites/NNN.npz` and `NNN.json`, which others read."""

from typing import Any

import jax
import numpy as np

from rtcd_jax.config.load import config_hash
from rtcd_jax.numerics.proportion import failure_bound
from rtcd_jax.policy import options
from rtcd_jax.problem import Problem
from rtcd_jax.types import Evaluation, Status
from rtcd_jax.validation import Effort


def arrays_of(problem: Problem, evaluation: Evaluation) -> dict[str, np.ndarray]:
    """The numbers of one candidate (no leading axis), SI units; knots first."""
    host = jax.tree.map(np.asarray, evaluation)
    policy, volumes = host.funnel.policy, host.volumes
    knots = len(policy.trajectory.xs)
    return {
        "time": policy.trajectory.dt * np.arange(knots),
        "x": policy.trajectory.xs,
        "u": policy.trajectory.us,
        "K": policy.gains,
        "S": policy.values,
        "rho": host.funnel.levels,
        "trials": host.funnel.trials,
        "Q": np.diag(host.candidate.q),
        "R": np.diag(host.candidate.r),
        "K_goal": policy.gains[-1],
        "x_goal": problem.goal,
        "u_max": problem.input_limits,
        "volumes_per_knot": volumes.per_knot,
        "volumes_sum": volumes.total,
        "volumes_integral": volumes.integral,
        "volumes_inlet": volumes.inlet,
        "volumes_geometric_mean": volumes.geometric_mean,
        "genome": host.genome,
    }


def record_of(problem: Problem, effort: Effort, evaluation: Evaluation) -> dict[str, Any]:
    """What a human wants to read of one candidate, and what its numbers mean."""
    host = jax.tree.map(np.asarray, evaluation)
    plant, config = problem.plant, problem.config
    funnel, volumes = host.funnel, host.volumes
    design = host.candidate.design
    return {
        "plant": config.plant.name,
        "parameters": plant.parameters(design),
        "design": {name: float(getattr(design, name)) for name in plant.design_units},
        "weights": {"q": host.candidate.q, "r": host.candidate.r},
        "policy": options(problem, host.candidate),
        "units": {
            "states": dict(zip(plant.state_names, plant.state_units, strict=True)),
            "inputs": dict(zip(plant.input_names, plant.input_units, strict=True)),
            "design": dict(plant.design_units),
            "time": "s",
            "volume": " ".join(plant.state_units),
        },
        "state_limits": [limit if np.isfinite(limit) else None for limit in problem.state_limits.tolist()],
        "status": Status(int(host.status)).name,
        "rung": "sampled",
        "epsilon": epsilon(funnel.trials, config.funnel.confidence),
        "confidence": config.funnel.confidence,
        "samples": int(funnel.trials.min()),
        "volumes": {
            "sum": volumes.total,
            "integral": volumes.integral,
            "inlet": volumes.inlet,
            "geometric_mean": volumes.geometric_mean,
            "share_of_largest_knot": float(volumes.per_knot.max() / max(volumes.total, np.finfo(float).tiny)),
        },
        "duration": float(funnel.policy.trajectory.dt * problem.intervals),
        "trajectory": {
            "cost": funnel.policy.trajectory.cost,
            "defect": funnel.policy.trajectory.defect,
            "iterations": funnel.policy.trajectory.iterations,
        },
        "followed_to_the_goal": effort.follow,
        "seed": config.search.seed,
        "config_hash": config_hash(config),
    }


def epsilon(trials: np.ndarray, confidence: float) -> float:
    """Largest failure probability of a state uniform in any knot's ellipsoid, at `confidence` jointly for all knots.

    `trials` [K] states of each knot had no failure; Bonferroni's share of the doubt for each knot.
    """
    return float(np.max(failure_bound(np.asarray(trials, float), (1 - confidence) / len(trials))))
