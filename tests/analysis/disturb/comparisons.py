"""Two loops of one robot into the upright, to be disturbed."""

import dataclasses

from rtcd_jax.analysis.disturb.comparison import comparison_of
from rtcd_jax.elite.elite import Elite
from tests.export.folders import run_folder


def elite_of(path, plant):
    """The elite of a fresh run folder at `path`."""
    return Elite.read(run_folder(path, plant), "000")


def comparison(path, plant):
    """An elite as the initial one, and as the best one the same with gains that are a tenth larger."""
    elite = elite_of(path, plant)
    return comparison_of({"initial": elite, "best": dataclasses.replace(elite, K=1.1 * elite.K)}, "0123456789ab")
