"""Evaluation -> the stable result format of `elites/NNN.npz` and `NNN.json`, which others read."""

import operator
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax.config.load import Config, config_hash
from rtcd_jax.config.plants import PLANTS
from rtcd_jax.evaluation import elite_budget, volumes_of
from rtcd_jax.genome import decode
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.numerics.proportion import failure_bound
from rtcd_jax.policy import input_jumps, options
from rtcd_jax.problem import Problem
from rtcd_jax.types import Candidate, Evaluation, Funnel, Policy, Status, TaskEvaluations, Trajectory
from rtcd_jax.validation import PhysicsComparison
from rtcd_jax.volume import largest_pushes
from rtcd_jax.window import farthest


def arrays_of(problem: Problem, evaluation: Evaluation) -> dict[str, np.ndarray]:
    """The numbers of one candidate (no leading axis), SI units; knots first."""
    problem, host = problem.of(evaluation.candidate), jax.tree.map(np.asarray, evaluation)
    policy, volumes = host.funnel.policy, host.volumes
    knots = len(policy.trajectory.xs)
    rates = {} if policy.value_rates is None else {"S_rates": policy.value_rates}
    return {
        "time": policy.trajectory.dt * np.arange(knots),
        "x": policy.trajectory.xs,
        "u": policy.trajectory.us,
        "K": policy.gains,
        "S": policy.values,
        **rates,
        "rho": host.funnel.levels,
        "trials": host.funnel.trials,
        "Q": np.diag(host.candidate.q),
        "R": np.diag(host.candidate.r),
        "K_goal": policy.gains[-1],
        "x_goal": np.asarray(problem.goal),
        "u_max": np.asarray(problem.input_limits(host.candidate.design)),
        "volumes_per_knot": volumes.per_knot,
        "pushes": _pushes(problem, evaluation)[0],
        **({} if host.funnel.offsets is None else {"center_offsets": host.funnel.offsets}),
        **{f"volumes_{name}": value for name, value in volumes.named.items()},
        "genome": host.genome,
    }


def policy_of(arrays: Mapping[str, Any], record: Mapping[str, Any]) -> Policy:
    """The policy that `arrays_of` and `record_of` stored, of a candidate that has a funnel."""
    ok, stored = jnp.int32(Status.OK), record.get("trajectory", {})
    us, xs, time, gains, values = (jnp.asarray(arrays[name]) for name in ("u", "x", "time", "K", "S"))
    cost, defect = (jnp.asarray(stored.get(name, 0.0)) for name in ("cost", "defect"))
    rates, iterations = arrays.get("S_rates"), jnp.asarray(stored.get("iterations", 0))
    motion = Trajectory(us, xs, time[1] - time[0], cost, defect, iterations, ok)
    return Policy(motion, gains, values, ok, None if rates is None else jnp.asarray(rates))


def evaluation_of(problem: Problem, arrays: Mapping[str, Any], record: Mapping[str, Any]) -> Evaluation:
    """The evaluation that `arrays_of` and `record_of` stored, of a candidate that has a funnel; on the host."""
    policy = policy_of(arrays, record)
    genome, levels, trials = (jnp.asarray(arrays[name]) for name in ("genome", "rho", "trials"))
    borne = None if problem.uncertainty is None else jnp.ones(())
    offsets = jnp.asarray(arrays["center_offsets"]) if "center_offsets" in arrays else None
    funnel, candidate = Funnel(policy, levels, trials, policy.status, borne, offsets), decode(problem, genome)
    volumes = volumes_of(problem, candidate, funnel)
    return jax.device_get(Evaluation(genome, candidate, funnel, volumes, policy.status))


def record_of(
    problem: Problem,
    evaluation: Evaluation,
    others: Sequence[Evaluation] = (),
    physics: PhysicsComparison | None = None,
    refinement: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """What a human wants to read of one candidate, and what its numbers mean.

    `others` are its evaluations under other keys, `physics` is MJX beside the closed form, `refinement` says what was
    refined, and the volumes before.
    """
    problem, budget = problem.of(evaluation.candidate), elite_budget(problem)
    host = jax.tree.map(np.asarray, evaluation)
    plant, config = problem.plant, problem.config
    funnel, volumes = host.funnel, host.volumes
    design = host.candidate.design
    searched = _searched_design(problem, host)
    candidates = (1 if refinement is None else 2) * (config.elites.count + 1)  # what it was is one of them
    return {
        "plant": config.plant.name,
        **({} if config.plant.name in PLANTS else {"robot": config.plant.model_dump(mode="json")}),
        "parameters": plant.parameters(design),
        "design": {name: float(getattr(searched, name)) for name in plant.design_units},
        **_weights(problem, host.candidate),
        "units": {
            "states": dict(zip(plant.state_names, plant.state_units, strict=True)),
            "inputs": dict(zip(plant.input_names, plant.input_units, strict=True)),
            "design": dict(plant.design_units),
            "time": "s",
            "volume": " ".join(plant.state_units),
        },
        "state_limits": [limit if np.isfinite(limit) else None for limit in problem.state_limits.tolist()],
        **({"keep_out": keep_out} if (keep_out := _keep_out(config)) else {}),
        **({"catch": config.task.catch.model_dump()} if config.task.caught else {}),
        **({"window": _window(problem, evaluation)} if config.task.catch.window else {}),
        "status": Status(int(host.status)).name,
        "rung": "sampled",
        "epsilon": epsilon(funnel.trials, config.funnel.confidence, budget.rounds * candidates),
        "confidence": config.funnel.confidence,
        "uncertainty": None if config.uncertainty.empty else config.uncertainty.model_dump(),
        "samples": int(funnel.trials.min()),
        "volumes": {
            **volumes.named,
            "share_of_largest_knot": float(volumes.per_knot.max() / max(volumes["sum"], np.finfo(float).tiny)),
        },
        "push": _push(problem, evaluation),
        "duration": float(funnel.policy.trajectory.dt * problem.intervals),
        "trajectory": {
            "cost": funnel.policy.trajectory.cost,
            "defect": funnel.policy.trajectory.defect,
            "iterations": funnel.policy.trajectory.iterations,
        },
        "followed_to_the_goal": bool(budget.samples_per_knot),
        "spread": _spread(others) if len(others) > 1 else None,
        "mjx": None if physics is None else dict(vars(jax.tree.map(np.asarray, physics))),
        **({} if refinement is None else {"refinement": dict(refinement)}),
        "seed": config.search.seed,
        "config_hash": config_hash(config),
    }


def common_arrays(evaluation: TaskEvaluations) -> dict[str, np.ndarray]:
    """The numbers that a candidate has in common on all tasks."""
    return {"genome": np.asarray(evaluation.genome)}


def common_record(problem: Problem, evaluation: TaskEvaluations) -> dict[str, Any]:
    """What a candidate has in common on all of the problem's tasks: design, weights if they are shared, and the volumes
    over them.
    """
    host, config = jax.tree.map(np.asarray, evaluation), problem.config
    candidate = jax.tree.map(np.asarray, decode(problem, jnp.asarray(host.genome)))
    each = {}
    for t, name in enumerate(config.tasks):
        alone = jax.tree.map(operator.itemgetter(t), host.tasks)
        each[name] = {"status": Status(int(alone.status)).name, "volumes": dict(alone.volumes.named)}
        if not config.shares_all:
            each[name] |= _weights(problem, alone.candidate)
    return {
        "plant": config.plant.name,
        "design": {name: float(getattr(candidate.design, name)) for name in problem.plant.design_units},
        **(_weights(problem, candidate) if config.shares_all else {}),
        "status": Status(int(host.status)).name,
        "rung": "sampled",
        "over_tasks": config.search.over_tasks,
        "volumes": dict(host.volumes.named),
        "tasks": each,
        **({} if host.after_reset is None else {"reset": _reset(problem, host)}),
        "seed": config.search.seed,
        "config_hash": config_hash(config),
    }


def _weights(problem: Problem, candidate: Candidate) -> dict[str, Any]:
    return {"weights": {"q": candidate.q, "r": candidate.r}, "policy": options(problem, candidate)}


def _reset(problem: Problem, host: TaskEvaluations) -> dict[str, Any]:
    """By task: into which one the reset at its end leads, the largest V / rho_0 there of so many samples, and the state
    before and after the reset that has it; where all are inside, the failure probability of a uniform state of the last
    ellipsoid is at most epsilon.
    """
    names, config = list(problem.config.tasks), problem.config
    samples, statements = elite_budget(problem).samples_per_knot, len(names) * (config.elites.count + 1)
    promise = epsilon(np.array([samples]), config.funnel.confidence, statements)
    return {
        name: {
            "into": names[(i + 1) % len(names)],
            "largest_level": float(level),
            "samples": samples,
            "epsilon": promise if level <= 1 else None,
            **_worst(host, i),
        }
        for i, (name, level) in enumerate(zip(names, np.asarray(host.after_reset), strict=True))
    }


def _window(problem: Problem, evaluation: Evaluation) -> dict[str, Any]:
    """By point: how far from its place at the goal it may be, and is at most in the last ellipsoid [m]."""
    funnel, own = evaluation.funnel, problem.of(evaluation.candidate)
    last = jax.tree.map(jnp.asarray, (funnel.policy.trajectory.xs[-1:].T, funnel.policy.values[-1][..., None]))
    found = farthest(own, evaluation.candidate, Ellipsoids.about(*last), jnp.asarray(funnel.levels[-1]))
    return {name: {"size": size, "farthest": float(found)} for name, size in own.config.task.catch.window.items()}


def _worst(host: TaskEvaluations, task: int) -> dict[str, Any]:
    if host.worst_at_resets is None:
        return {}
    before, after = host.worst_at_resets[task]
    return {"worst": {"before": before, "after": after}}


def _keep_out(config: Config) -> list[dict[str, Any]]:
    """The sets in the task's words, null for an infinite semi axis."""
    stated = config.task.model_dump().get("keep_out", ())
    for each in stated:
        if "semi_axes" in each:
            each["semi_axes"] = [axis if np.isfinite(axis) else None for axis in each["semi_axes"]]
    return list(stated)


def _searched_design(problem: Problem, evaluation: Evaluation) -> eqx.Module:
    """The design that the search chose, without what the task changes of it."""
    if not problem.config.edits:
        return evaluation.candidate.design
    unchanged = replace(problem, config=problem.config.model_copy(update={"tasks": {}}))
    return decode(unchanged, jnp.asarray(evaluation.genome)).design


def _pushes(problem: Problem, evaluation: Evaluation) -> tuple[np.ndarray, np.ndarray]:
    """Largest impulses [N+1 m] on every input, knot by knot, that leave x* + B J in the funnel, and in the limits."""
    funnel = evaluation.funnel
    jumps = np.asarray(input_jumps(problem, evaluation.candidate, funnel.policy.trajectory))
    values, xs = np.asarray(funnel.policy.values), np.asarray(funnel.policy.trajectory.xs)
    inside = largest_pushes(values, np.maximum(np.asarray(funnel.levels), 0), jumps)
    room = (problem.state_limits - np.abs(xs))[:, :, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        within = np.where(jumps != 0, room / np.abs(jumps), np.inf).min(1)
    for each in problem.keep_out:
        within = np.minimum(within, each.reach(xs.T[:, :, None], np.moveaxis(jumps, 1, 0)))
    return np.where(int(evaluation.status) == Status.OK, inside, 0), within


def _push(problem: Problem, evaluation: Evaluation) -> dict[str, Any]:
    """The push margin [input's unit s], the input and the time [s] of its knot, and what the limits leave there."""
    inside, within = _pushes(problem, evaluation)
    k, i = np.unravel_index(np.argmin(inside), inside.shape)
    time = float(evaluation.funnel.policy.trajectory.dt) * int(k)
    name = problem.plant.input_names[i]
    return {"margin": inside[k, i], "input": name, "time": time, "within_limits": within[k, i]}


def epsilon(samples: np.ndarray, confidence: float, statements: int) -> float:
    """Largest failure probability of a state uniform in any knot's ellipsoid, at `confidence` jointly for all knots.

    `samples` [K] held-out samples of each knot had no failure in a round that had none at all. The doubt is shared by
    `statements`: the rounds, of which the first clean one counts, times the candidates, of which the best is chosen by
    these numbers. The knots need no share: one that fails too often keeps the whole round from being clean
    (docs/theory.md, section 4).
    """
    return failure_bound(int(np.min(samples)), (1 - confidence) / statements)


def _spread(evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    """Standard deviation over mean of every volume, over evaluations that differ in their random numbers alone."""
    volumes = {name: [float(e.volumes[name]) for e in evaluations] for name in evaluations[0].volumes.named}
    relative = {
        name: np.std(values, ddof=1) / np.mean(values) if np.mean(values) else None for name, values in volumes.items()
    }
    return {"keys": len(evaluations), "volumes": relative}
