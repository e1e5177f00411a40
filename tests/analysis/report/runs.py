"""Finished run folders without a search: funnels of random ellipsoids, generations of known numbers."""

import json
from dataclasses import replace

import numpy as np
import yaml

from rtcd_jax.analysis.report.reading import Certificate, read_run
from rtcd_jax.config import load as configuration
from rtcd_jax.elite.records import FORMAT, VERSION, write_elite
from rtcd_jax.system.files import plain, replace_json

KNOTS = 7
CARTPOLE = """\
plant: {name: cartpole}
task: {start: [0, 3.14, 0, 0], goal: [0, 0, 0, 0], state_limits: [0.3, .inf, .inf, .inf]}
design: {pole_length: {initial: 0.2, min: 0.17, max: 0.3}, pole_mass: {initial: 0.2, min: 0.12, max: 0.3}}
weights:
  q: [{initial: 10, min: 1, max: 20}, {initial: 10, min: 1, max: 20}, {initial: 1, min: 1, max: 1}, {initial: 1, min: 1, max: 1}]
  r: [{initial: 10, min: 5, max: 15}]
"""  # noqa: E501 (YAML of one variable a line would hide the rest)
SEARCHED_POLICY = {
    "authority": {"initial": 0.05, "min": 0.01, "max": 1.0}, "discount": {"initial": 0.5, "min": 0.0, "max": 2.0}
}  # fmt: skip
PARAMETERS = {
    "pendulum": {"m": 0.7, "l": 0.4, "b": 0.1, "g": 9.81, "torque_limit": 2.5},
    "cartpole": {
        "Mc": 1.07, "Mp": 0.2, "lp": 0.2, "inertia_about_com": 0.0027, "Beq": 5.4, "Bp": 0.0024, "g": 9.81,
        "force_limit": 6.0,
    },
}  # fmt: skip
YAMLS = {"pendulum": configuration.EXAMPLE, "cartpole": CARTPOLE}
PROVED = Certificate(
    "proved", "proved", "", start=0.0, intervals=6, seconds=7.25,
    sampled={"inlet": 0.9, "sum": 333.0, "integral": 66.0, "goal": 1.0},
    shown={"inlet": 0.8, "sum": 330.0, "integral": 65.0, "outlet": 1.0, "goal": 1.0},
)  # fmt: skip
"""As of a run whose elite 000 is proved; test_proofs.py has a real one."""
VERIFICATION = {
    "states": 1020, "epsilon": 0.0043, "confidence": 0.99, "kept": True,
    "witnesses": {
        "C MuJoCo": {
            "left_funnel": 0, "left_limits": 0, "missed_goal": 0, "rate": 0.0, "rate_upper": 0.0045, "kept": True,
        },
    },
}  # fmt: skip


def experiment(plant="pendulum", **changes):
    data = yaml.safe_load(YAMLS[plant])
    return configuration.parse(data | {section: data.get(section, {}) | new for section, new in changes.items()})


def random_values(n, seed=0):
    """Symmetric positive definite matrices [KNOTS n n] and levels [KNOTS], no axis aligned with another."""
    random = np.random.default_rng(seed)
    root = random.normal(size=(KNOTS, n, n))
    return root @ np.swapaxes(root, 1, 2) + np.eye(n), random.uniform(0.05, 0.2, KNOTS)


def candidate(config, seed=0, scale=1.0, **changes):
    """A funnel as a run stores it: from start to goal, its ellipsoids random; the volumes are marks, not measured."""
    S, rho = random_values(len(config.task.start), seed)
    start, goal = np.array(config.task.start), np.array(config.task.goal)
    per_knot, n = scale * np.geomspace(0.01, 10, KNOTS), len(start)
    volumes = {"sum": 111.0, "integral": 22.0, "inlet": 0.3, "geometric_mean": 4.0}
    arrays = {
        "time": 0.1 * scale * np.arange(KNOTS),
        "x": start + (goal - start) * np.linspace(0, 1, KNOTS)[:, None],
        "u": np.zeros((KNOTS - 1, 1)),
        "K": np.zeros((KNOTS, 1, n)),
        "S": S,
        "rho": scale * rho,
        "Q": np.eye(n),
        "R": np.eye(1),
        "K_goal": np.zeros((1, n)),
        "x_goal": goal,
        "u_max": np.ones(1),
        **{f"volumes_{name}": np.array(value * scale) for name, value in volumes.items()},
        "volumes_per_knot": per_knot,
    }
    record = {
        "plant": config.plant.name,
        "parameters": PARAMETERS[config.plant.name],
        "state_limits": [limit if np.isfinite(limit) else None for limit in config.task.state_limits],
        "status": "OK",
        "design": {name: variable.initial for name, variable in config.design.items()},
        "weights": {letter: [variable.initial for variable in found] for letter, found in config.weights},
        "policy": config.policy.initial(),
        "rung": "sampled",
        "epsilon": 0.0023,
        "confidence": 0.99,
        "duration": 0.6 * scale,
        "volumes": {name: value * scale for name, value in volumes.items()} | {"share_of_largest_knot": 0.05},
    }
    return arrays, record | changes


def generation(index, dims=5, **changes):
    """Four candidates, the last one without a funnel; their genomes are shares index / 10 and above."""
    shares = np.clip(index / 10 + 0.1 * np.arange(4), 0, 1)
    best = 100.0 + index
    numbers = {
        "index": index, "evaluations": 4 * (index + 1), "objective": "sum", "best": best, "median": 60.0,
        "best_so_far": best, "feasible": 0.75, "counts": {"OK": 3, "FUNNEL_EMPTY": 1}, "sigma": 0.3, "restarts": 0,
        "genomes": np.repeat(shares[:, None], dims, 1), "volumes": {"sum": [40.0, 60.0, best, None]},
    }  # fmt: skip
    return numbers | changes


def run_folder(path, config, initial=None, best=None, generations=None):
    """A run folder as a search leaves it; `best` are one candidate or several, generations three by default."""
    dims = sum(variable.free for variable in config.variables().values())
    elites = [best] if isinstance(best, tuple) else best or []
    (path / "elites").mkdir(parents=True)
    replace_json(path / "format.json", {"format": FORMAT, "version": VERSION})
    (path / "config.yaml").write_text(configuration.dump(config))
    start = {"time": "2026-01-01T00:00:00+00:00", "commit": "c0ffee", "versions": {"numpy": np.__version__}}
    replace_json(path / "provenance.json", {"config_hash": configuration.config_hash(config), "starts": [start]})
    if initial:
        write_elite(path, "initial", *initial)
    for index, elite in enumerate(elites):
        write_elite(path / "elites", f"{index:03d}", *elite)
    records = [generation(k, dims) for k in range(3)] if generations is None else generations
    (path / "generations.jsonl").write_text("".join(json.dumps(plain(record)) + "\n" for record in records))
    return path


def finished(path, plant="pendulum", scale=3.0, **changes):
    """The folder of a whole run, its best funnel `scale` times the initial one."""
    config = experiment(plant, **changes)
    return run_folder(path, config, candidate(config), candidate(config, 1, scale))


def proved(folder, **certificates):
    """The run of a folder as if its elite 000 were proved."""
    return replace(read_run(folder), certificates={"000": PROVED, **certificates})


def verify_and_disturb(path):
    """What `rtcd verify` and an experiment leave in the folder."""
    for place, name, record in (
        ("verification", "000", VERIFICATION),
        ("disturbance", "off_nominal", {"summary": {"initial": {"success": 0.25}, "best": {"success": 0.75}}}),
    ):
        (path / place).mkdir()
        (path / place / f"{name}.json").write_text(json.dumps(record))
    return path
