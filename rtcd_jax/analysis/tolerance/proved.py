"""The largest factor of a box under which an elite's funnel is proved, by certificates of one factor after another."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from rtcd_jax.analysis.tolerance.factors import MOST, largest_factors
from rtcd_jax.certificate.prove.certify import Checking, Step, certify_elite
from rtcd_jax.config.schema import UncertaintyConfig
from rtcd_jax.elite.records import elite_digests
from rtcd_jax.system.console import Clock, Console, Progress, duration
from rtcd_jax.system.devices import cores
from rtcd_jax.system.files import make_folder, replace
from rtcd_jax.system.journal import Journal

PRECISE = 1.05
"""Ratio of the smallest factor that is not proved to the largest one that is."""
TRIED = ".tried"
"""The folder of the certificate that is being made."""


def proved_factor(
    run: Path, folder: str, name: str, box: UncertaintyConfig, most: float, console: Console
) -> dict[str, Any]:
    """A row of the table: the `factor`, 0 if there is none, and what is proved there of the elite's `volumes`.

    The certificate is `certificates/NAME.json` in the run's `folder`. What was tried before a kill is not tried again.

    Raises:
        UserError: a robot or a box of which there is no claim, or a folder that cannot be written.
    """
    place, tried = run / folder, f"{folder}/{TRIED}"
    make_folder(place / "certificates")
    make_folder(run / tried)
    best = place / "certificates" / f"{name}.json"
    journal = Journal(
        place / f".{name}.proofs.jsonl", {"elite": elite_digests(run, name), "box": box.model_dump(mode="json")}
    )
    if not journal.lines:
        best.unlink(missing_ok=True)
    known = {line["factor"]: line["volumes"] for line in journal.lines}
    clock = Clock()

    def proved(factor: float) -> bool:
        if factor not in known:
            known[factor] = _volumes(factor)
            journal.append({"factor": factor, "volumes": known[factor]})
        return known[factor] is not None

    def _volumes(factor: float) -> dict[str, float] | None:
        """None unless the funnel is proved from t = 0 on."""

        def tell(step: Step | Checking) -> None:
            if isinstance(step, Checking):
                return
            text = f"factor {factor:.3g}: interval {step.knot + 1}/{step.knots}  elapsed {duration(clock.elapsed)}"
            console.progress(Progress(step.knots - step.knot, step.knots, text))

        outcome = certify_elite(run, name, "proved", tell, uncertainty=box.times(factor), target=tried, threads=cores())
        if outcome is None or not outcome.whole:
            return None
        replace(best, (run / tried / f"{name}.json").read_bytes())
        return outcome.volumes

    (factor,) = largest_factors(
        lambda factors: np.array([proved(float(factors[0]))]), np.array([most]), precise=PRECISE
    )
    shutil.rmtree(run / tried)
    journal.close()
    volumes, at_most = known[float(factor)] or {}, bool(factor >= min(most, MOST))
    return {"factor": float(factor), "at_most": at_most, "volumes": volumes, "guarantee": "proved"}
