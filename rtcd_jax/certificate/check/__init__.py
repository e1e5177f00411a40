"""The independent checker: it accepts a certificate only if the theorem below follows from it, by exact arithmetic.

`rtcd check FILE` or `python -m rtcd_jax.certificate.check FILE`. It knows no solver and nothing of the rest of the
package: the standard library is enough, and python-flint makes it faster. To trust a certificate is to trust this
folder and nothing else. Read it in this order:

    exact       rational numbers and their rounding
    taylor      Taylor models: polynomials in time, space and robots with bounds of their remainders; sine and cosine
    matrix      products and determinants
    squares     positive on the sphere: sums of squares, by Bernstein polynomials in the time and in the robot's numbers
    robot       a robot's equations from its mass matrix and potential; det M > 0 for all angles
    claim       the robots and closed loops that a certificate is about
    delay       feedback of old measurements, to first order
    saturation  what the motor gives, between two saturated laws
    funnel      the obligations of one interval of the funnel
    keep_out    sets of states to keep out of
    push        the largest impulse
    goal        the obligations of the goal region
    catch       the obligation of a motion that ends in a catch set, or with a reset
    version1    the two robots that files of version 1 name
    node        the file's text, its numbers exact
    file        the file's parts
    verdict     every obligation of a certificate
    sentence    what follows, in plain words
    cycle       motions that follow one another
    command     `rtcd check`

THEOREM. The claim holds a robot: its mass matrix M, potential, dampers and one motor, whose numbers p lie in a box (at
every instant; they may vary in time). With D = det M, D x' = a + b (u + w). Its controller is

    u = clip(u_k - phi, -F, F)  on [t_k, t_{k+1}],      u = clip(-phi, -F, F)  after t_N,

with any F between its bounds, any measurable |w(t)| <= w_max, and the feedback phi = K(r) (x(r) + e - x*(r)), after t_N
K_g (x(r) + e - x_g), of a measurement at some time r: not more than `age` before, not before the motion began, not by
the controller of another phase; with any error |e_i| <= `noise`_i. Where the claim has a `jerk` or `shifts`, p is
constant in time. x* is the cubic Hermite interpolant of the claimed states and rates, K linear between K_k and K_{k+1}.
c_p is x* plus the `shifts`, each a product of powers of p, scaled to [-1, 1], times such an interpolant; without any,
c_p is x*. If `check` accepts, then with E(t) = {c_p(t) + L(t) y : |y| <= 1}, each robot's own, and
G = {x_g + L_g y : |y| <= 1} of the certificate, every motion that is in E(t) at some t of [start, t_N] stays in E until
t_N, is then in G, never leaves G, and comes and stays as close to x_g as reported; in E and G no state exceeds its
limit or is in a set of the claim's `keep_out`; and c_p(t) + M^-1 (motor) J is in E(t) for all t of [start, t_N] and
|J| <= `push`. At t = 0 c_p is x*(0) for all p.
A claim that ends in a `catch` says nothing of u after t_N, and has no G but C = {c + L_c y : |y| <= 1}: every such
motion is in C at t_N, or, if there is a `reset`, q+ = P q + pi k and v+ = M+(q+)^-1 X(q) v are, with the claimed P, k
and X and M+ the mass matrix of the robot with the claimed numbers after it. Where of several accepted files each C is
E(0) of the next one, about the robot of these numbers (cycle.py), a robot goes from funnel to funnel.

PROOF. *Funnel.* In y, d/dt |y|^2 = 2 y'L^-1 (f - c_p' - L'y). Let L = L(s), s in [-1, 1] the time of one interval,
det L > 0; det M > 0 is shown for all angles and robots (robot.py). Then q = -2 c y' adj(L) (a + b (u + w) -
D (c_p' + L'y)), with a constant c > 0, is -d/dt |y|^2 times a positive function. The feedback differs from K (x - x*)
by at most `error` = sum_i |K_i| noise_i + age speed, where |d/dt K (x - x*)| <= speed is shown in E. So u + w lies
between two saturated laws (saturation.py), or four where old measurements count to first order (delay.py), and since q
is affine in it, it is enough that q > 0 for all. On the sphere |y| = 1 one of three cases holds for each law: it is
free, or at the upper, or at the lower limit. For each, q is a polynomial
p(s, y, robot) up to a remainder r (sine, cosine and every rounding enclosed). In Bernstein polynomials of the robot's
numbers it is a mean of its control points, each a polynomial p(s, y), so that it is enough that these are > r; and the
certificate gives p = sum_j B_j(s) p_j(y) in Bernstein polynomials with, modulo |y|^2 = 1,

    p_j = z'G_j z + sum_i (sigma_i g_i)_j + rest_j,    G_j > 0,    sigma_i = sum_a B_a(s) z'S_ia z,    S_ia > 0,

g_i >= 0 the inequalities of the case. B_j >= 0 and sum_j B_j = 1, so that q >= min_j inf rest_j - r = margin > 0 on the
case. There may be such proofs of the two halves in s, or of halves of these, in the place of one. Where p has a higher
order in s than the B_j, the rest of its Chebyshev series counts to r; where g_i has, to g_i (g_i plus that is >= 0
wherever g_i is). So |y| decreases wherever |y| = 1: no motion leaves E (x' is bounded, and the intervals join without
a gap).
*Goal.* The same with y = l z, |z| = 1, l in [rest, 1] in the place of s, and q divided by l. So |y| decreases wherever
l >= rest. Where no w, noise or age acts, rest = 0, and q is divided by l^2 where u is free: the remainder of q is
r l^2 + d l, where d bounds what does not vanish with l (x_g is a rounded multiple of pi), and |y| decreases wherever
l > d / margin.
*Catch.* With D = det M+, or 1, |L_c^-1 (x+ - c)| < 1 is q = (D det L_c)^2 - |adj(L_c) (D x+ - D c)|^2 > 0, in which
there is no quotient, at all x = c_p(t_N) + l L_N z, l in [0, 1], |z| = 1; and where q > 0, M+ has an inverse.
*Own motions.* With shifts u_lin = u_k - K (c_p - x* + L y). The conditions of a case are loosened by the largest
|K (c_p - x*)|, so that they are the same for all robots and hold wherever they do for one. Terms of high order in y and
p go to the remainder, and so does what p loses where its powers above a degree are replaced by lower ones (|T_k| <= 1).
The centers c with c + L_N y in G for all |y| <= 1 are convex: the control points of c_p(t_N) are enough.
*Sets to keep out of.* Each lies in a half space w'(x - c) > offset (keep_out.py), which E does not meet if
offset - w'(c_p - c) > 0 and its square > |L'w|^2, in s and the robot's numbers; G likewise.
*Push.* |L^-1 (b / D) J| < 1 is (D det L)^2 > |adj(L) b J|^2, one inequality in s and the robot's numbers. QED

Every number of a file is an exact double in hexadecimal notation. Digests show where a file was changed; the theorem
does not rest on them.
"""

from rtcd_jax.certificate.check.catch import catch_obligations
from rtcd_jax.certificate.check.claim import Catch, Claim, Reset, Shift
from rtcd_jax.certificate.check.command import SECONDS, main, within
from rtcd_jax.certificate.check.cycle import require_cycle
from rtcd_jax.certificate.check.delay import jumps_within_reach, lateness
from rtcd_jax.certificate.check.exact import (
    MAX_TERMS,
    PI,
    PI_ERROR,
    Damaged,
    Q,
    Refused,
    Undecided,
    alternating,
    near,
    printable,
    rational,
    require,
    root_up,
    up,
)
from rtcd_jax.certificate.check.file import count_terms, read_claim, read_goal, read_interval
from rtcd_jax.certificate.check.funnel import (
    Interval,
    Motion,
    funnel_delay,
    funnel_jump,
    funnel_models,
    funnel_obligations,
    funnel_speed,
    motion,
    obligations_of,
    require_bounds,
    require_jump,
    require_kept_out,
)
from rtcd_jax.certificate.check.goal import (
    GoalField,
    Shell,
    goal_delay,
    goal_field,
    goal_obligations,
    goal_speed,
    last_centers,
)
from rtcd_jax.certificate.check.keep_out import Ellipsoid, HalfSpace
from rtcd_jax.certificate.check.matrix import cofactors
from rtcd_jax.certificate.check.node import Node, digest, parse, read_bytes
from rtcd_jax.certificate.check.push import push_clearance, require_push
from rtcd_jax.certificate.check.robot import (
    HINGE,
    SLIDE,
    Equations,
    Function,
    Robot,
    Term,
    derive,
    mass_is_definite,
    numbers_of,
)
from rtcd_jax.certificate.check.saturation import Case, Feedback, are_joined, cases_of, error_under, input_error
from rtcd_jax.certificate.check.sentence import sentence
from rtcd_jax.certificate.check.squares import (
    GramCertificate,
    Halves,
    Obligation,
    Squares,
    bernstein,
    condition,
    control_points,
    economized,
    halves_of,
    is_positive,
    is_positive_definite,
    margin,
    monomials,
    reduced,
)
from rtcd_jax.certificate.check.taylor import Space, Taylor, economize, peak, polynomial, sine_and_cosine, terms_of
from rtcd_jax.certificate.check.verdict import FORMAT, VERSION, Report, check, check_file, volumes_of
from rtcd_jax.certificate.check.version1 import PLANTS, Plant
