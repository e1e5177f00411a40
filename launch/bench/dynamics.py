"""Time of a Runge-Kutta step: the cart-pole's equations written by hand, and those derived from its MJCF.

    python launch/bench/dynamics.py [--batch 1024] [--steps 100] [--repeats 15]

The programs take turns, so that load on the machine meets all of them; the fastest repetition counts.
"""

import argparse

from measure import environment, save

from rtcd_jax.system.devices import prepare_jax

prepare_jax(1)

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

from rtcd_jax.analysis.scale.clock import timed  # noqa: E402
from rtcd_jax.config.plants import PLANTS  # noqa: E402
from rtcd_jax.numerics.integrate import componentwise, rk4, split  # noqa: E402
from rtcd_jax.numerics.trigonometry import cos, sin  # noqa: E402
from rtcd_jax.plants import make_plant  # noqa: E402

STEP = 0.01


def by_hand(plant: Any, design: Any, x: Any, u: Any) -> Any:
    """The cart-pole's dynamics: accelerations of the pole about a resting pivot, then of the cart, then of both."""
    moment = design.pole_mass * design.pole_length
    inertia = design.pole_mass * design.pole_length**2 / 3 + moment * design.pole_length
    lever, s, c = moment / inertia, sin(x[1]), cos(x[1])
    pole = lever * plant.gravity * s - plant.pivot_damping / inertia * x[3]
    force = u[0] - plant.cart_damping * x[2] + moment * (c * pole - s * x[3] * x[3])
    cart = force / (plant.cart_mass + design.pole_mass - moment * lever * (c * c))
    return jnp.stack([x[2], x[3], cart, pole + lever * (c * cart)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batch", type=int, default=1024, help="states at once")
    parser.add_argument("--steps", type=int, default=100, help="of a call")
    parser.add_argument("--repeats", type=int, default=15, help="calls of each program")
    arguments = parser.parse_args()
    random = np.random.default_rng(0)
    x, u = (jnp.asarray(random.uniform(-1, 1, (rows, arguments.batch))) for rows in (4, 1))
    plant: Any = make_plant(PLANTS["cartpole"](), {})
    design = plant.Design(*jnp.asarray(random.uniform(0.2, 0.3, (2, arguments.batch))))
    programs, compilation = {}, {}
    for name, dynamics in {"by hand": partial(by_hand, plant), "derived": plant.dynamics}.items():

        def steps(design, x, u, dynamics=dynamics):
            def step(_, x):
                rate = componentwise(lambda x, u: dynamics(design, x, u))
                return jnp.stack(rk4(rate, split(x), tuple(split(u)), STEP, 1))

            return jax.lax.fori_loop(0, arguments.steps, step, x)

        programs[name], compilation[name] = timed(lambda f=steps: jax.jit(f).lower(design, x, u).compile())
    error = float(jnp.max(jnp.abs(programs["by hand"](design, x, u) - programs["derived"](design, x, u))))
    best = dict.fromkeys(programs, np.inf)
    for _ in range(arguments.repeats):
        for name, program in programs.items():
            _, taken = timed(lambda f=program: jax.block_until_ready(f(design, x, u)))
            best[name] = min(best[name], taken.cpu)
    ns = {name: 1e9 * seconds / arguments.batch / arguments.steps for name, seconds in best.items()}
    for name, value in ns.items():
        print(f"{name:8} {value:7.1f} ns a step, {value / ns['by hand']:.2f} times by hand")
    print(f"largest difference after {arguments.steps} steps: {error:.1e}")
    record = {**environment("jax", "mujoco"), "ns_a_step": ns, "difference": error}
    print(save("dynamics_cartpole.json", record))


if __name__ == "__main__":
    main()
