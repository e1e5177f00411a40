"""Verification of a funnel on held-out states by independent simulators: they share no code with the search.

States are uniform in the ellipsoids of all knots, evenly spread over them, not only in the first. A state fails if it
leaves the funnel at a later knot, leaves the state limits, or does not settle at the goal. Two independent
simulators judge the same states, each with its own dynamics and integrator:

    C MuJoCo       accelerations of the compiled MJCF, fixed Runge-Kutta steps
    closed form    written here in numpy, apart from the plants'; scipy's adaptive RK45
"""
