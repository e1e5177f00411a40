"""Tests run in float64 on the CPU."""

import jax

jax.config.update("jax_enable_x64", True)
