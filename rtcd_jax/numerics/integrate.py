"""Explicit Runge-Kutta integration of x' = f(x, u) with the input held."""

from collections.abc import Callable


def rk4_step(f: Callable, x, u, dt):
    """x(t + dt) by the classical fourth-order Runge-Kutta step; any shapes that `f` accepts."""
    k1 = f(x, u)
    k2 = f(x + 0.5 * dt * k1, u)
    k3 = f(x + 0.5 * dt * k2, u)
    k4 = f(x + dt * k3, u)
    return x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def rk4(f: Callable, x, u, duration, steps: int):
    """x(t + duration) by equal Runge-Kutta steps."""
    for _ in range(steps):
        x = rk4_step(f, x, u, duration / steps)
    return x
