"""Confidence in a proportion seen in independent trials."""

import jax.numpy as jnp


def failure_bound(trials, doubt):
    """Largest failure probability that `trials` trials without a failure leave possible at confidence 1 - doubt.

    The exact (Clopper-Pearson) bound 1 - doubt^(1/trials); 1 for no trials.
    """
    return -jnp.expm1(jnp.log(doubt) / jnp.maximum(trials, 1e-300))
