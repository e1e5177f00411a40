"""Robust co-design of robots: designs, cost weights and funnels, whole populations at once.

The data flow, one module a step; every step is written for one candidate and mapped over the population once:

    genome -> Candidate -> Trajectory -> Policy -> Funnel -> Volumes
              genome       trajectory    policy    funnel    volume

`evaluation` chains the steps, `search` asks CMA-ES for genomes and keeps the elites, `rtcd` is the command line.
The names below are imported at their first use, so that `import rtcd_jax` alone stays light.
"""

from importlib import import_module
from typing import Any

_HOMES = {
    "Config": "config.load",
    "prepare_jax": "system.devices",
    "load": "config.load",
    "parse_yaml": "config.load",
    "ConfigError": "system.errors",
    "UserError": "system.errors",
    "Candidate": "types",
    "Trajectory": "types",
    "Policy": "types",
    "Funnel": "types",
    "Volumes": "types",
    "Evaluation": "types",
    "Status": "types",
    "Problem": "problem",
    "make_problem": "problem",
    "decode": "genome",
    "initial_genome": "genome",
    "plan": "trajectory",
    "stabilize": "policy",
    "estimate_funnel": "funnel",
    "funnel_volume": "volume",
    "make_evaluate": "evaluation",
}

__all__ = list(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOMES})
