"""Does a funnel keep its promise? Fresh random states before witnesses that share nothing with the search.

States are uniform in the ellipsoids of all knots, evenly spread over them, not only in the first. A state fails if it
leaves the funnel at a later knot, leaves the state limits, or does not settle at the goal. Two witnesses judge the
same states, each with dynamics and integrator of its own:

    C MuJoCo       accelerations of the compiled MJCF, fixed Runge-Kutta steps
    closed form    written here in numpy, apart from the plants'; scipy's adaptive RK45
"""
