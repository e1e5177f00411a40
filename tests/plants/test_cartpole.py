"""The cart-pole beside the equations of the paper's authors, and its two inertias."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.config.plants import PLANTS
from tests.plants.robots import MEASURED_INERTIA, design, packaged

LP, MP, MC, BEQ, BP, G = 0.1778, 0.227, 1.0731266, 5.4, 0.0024, 9.81
UPRIGHT = jnp.zeros(4)


def _design():
    return design("cartpole", pole_length=LP, pole_mass=MP)


def test_the_rods_dynamics_are_the_authors():
    """Their equations of motion, with the rod's inertia inserted, at random states and forces."""
    random = np.random.default_rng(0)
    x, u = random.uniform(-4, 4, (4, 100)), random.uniform(-6, 6, (1, 100))
    _, th, xd, thd = x
    force, s, c = u[0] - BEQ * xd, np.sin(th), np.cos(th)
    d = 4 * MC + MP + 3 * MP * s**2
    cart = (4 * force - 4 * MP * LP * s * thd**2 + 3 * MP * G * s * c - 3 * BP * c * thd / LP) / d
    pole = 3 * (MC + MP) * G * s / LP - 3 * MP * s * c * thd**2 + 3 * c * force / LP
    pole = (pole - 3 * (MC + MP) * BP * thd / (MP * LP**2)) / d
    found = packaged("cartpole").dynamics(_design(), jnp.asarray(x), jnp.asarray(u))
    np.testing.assert_allclose(found, np.stack([xd, thd, cart, pole]), rtol=1e-11, atol=1e-12)


@pytest.mark.thorough
def test_the_upright_linearization_is_the_authors():
    """Their numbers have four decimals."""
    a, b = jax.jacfwd(packaged("cartpole").dynamics, (1, 2))(_design(), UPRIGHT, jnp.zeros(1))
    np.testing.assert_allclose(a[2:], [[0, 1.4782, -4.7793, -0.0090], [0, 47.6160, -20.1601, -0.2886]], atol=5.1e-5)
    np.testing.assert_allclose(b[2:, 0], [0.8851, 3.7333], atol=5.1e-5)


@pytest.mark.parametrize(("inertia", "value"), [("rod", MP * LP**2 / 3), ("measured", MEASURED_INERTIA)])
def test_a_hanging_pole_swings_with_its_inertia(inertia, value):
    """On a cart held by a very large mass, without friction: omega^2 = Mp g lp / (I + Mp lp^2)."""
    plant = packaged("cartpole", cart_mass=1e6, cart_damping=0.0, pivot_damping=0.0, inertia=inertia)
    slope = jax.jacfwd(plant.dynamics, 1)(_design(), jnp.array([0, jnp.pi, 0, 0]), jnp.zeros(1))
    np.testing.assert_allclose(-slope[3, 1], MP * G * LP / (value + MP * LP**2), rtol=1e-5)


@pytest.mark.parametrize("inertia", ["rod", "measured"])
def test_parameters_tell_the_inertia(inertia):
    parameters = packaged("cartpole", inertia=inertia).parameters(_design())
    assert PLANTS["cartpole"]().with_parameters(parameters).inertia == inertia


def test_an_unknown_inertia_is_refused_with_the_known_ones():
    parameters = packaged("cartpole").parameters(_design()) | {"inertia_about_com": 0.005}
    with pytest.raises(ValueError, match=r"inertia_about_com = 0.005: must be one of .*rod.*measured"):
        PLANTS["cartpole"]().with_parameters(parameters)
