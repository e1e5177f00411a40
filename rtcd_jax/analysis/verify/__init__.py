"""Verification of a funnel on held-out states by independent simulators: they share no code with the search.

States are uniform in the ellipsoids of all knots, evenly spread over them, not only in the first. A state fails if it
leaves the funnel at a later knot, leaves the state limits, or does not settle at the goal. C MuJoCo accelerates them,
its model compiled anew for the design; two integrators judge the same states:

    C MuJoCo    fixed Runge-Kutta steps
    RK45        the steps that the method of Dormand and Prince asks for
"""
