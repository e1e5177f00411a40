"""Run folder -> figures. Reads what a run has stored, computes nothing anew, and needs no JAX."""

from rtcd_jax.report.figures import draw_convergence, draw_funnels

__all__ = ["draw_convergence", "draw_funnels"]
