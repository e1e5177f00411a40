"""The independent checker: it accepts a certificate only if the theorem below follows from it, by exact arithmetic.

`rtcd check FILE` or `python -m rtcd_jax.certificate.check FILE`. It knows no solver and nothing of the rest of the
package: the standard library is enough, and python-flint makes it faster. To trust a certificate is to trust this
folder and nothing else. Read it in this order:

    exact     rational numbers and their rounding
    taylor    Taylor models: polynomials in time and space with bounds of their remainders; sine and cosine
    matrix    products and determinants
    claim     the robots' equations, and the closed loop that a certificate is about
    squares   positive on the sphere: sums of squares, by Bernstein polynomials in the time
    funnel    the obligations of one interval of the funnel
    goal      the obligations of the goal region
    file      the file's text into exact numbers
    verdict   every obligation of a certificate, and what follows
    command   `rtcd check`

THEOREM. Let the claim hold a robot x' = f(x, u) with D(x) f(x, u) = a(x) + b(x) u, where a, b, D are polynomials in x
and in the sine and cosine of one angle (claim.py), and its controller

    u = clip(u_k - K(t) (x - x*(t)), -F, F)  on [t_k, t_{k+1}],      u = clip(-K_g (x - x_g), -F, F)  after t_N,

with x* the cubic Hermite interpolant of the claimed states and rates, K linear between K_k and K_{k+1}. If `check`
accepts, then with E(t) = {x*(t) + L(t) y : |y| <= 1} and G = {x_g + L_g y : |y| <= 1} of the certificate, every motion
that is in E(t) at some t of [start, t_N] stays in E until t_N, is then in G, never leaves G, and comes and stays as
close to x_g as reported; and in E and G no state exceeds its limit.

PROOF. *Funnel.* In y, d/dt |y|^2 = 2 y'L^-1 (f - x*' - L'y). Let L = L(s), s in [-1, 1] the time of one interval,
det L > 0 and D > 0. Then q = -2 c y' adj(L) (a + b u - D (x*' + L'y)), with a constant c > 0, is -d/dt |y|^2 times a
positive function. On the sphere |y| = 1 one of three cases holds: |u_lin| <= F and u = u_lin, or u_lin >= F and u = F,
or u_lin <= -F and u = -F. For each, q is a polynomial p(s, y) up to a remainder r (sine, cosine and every rounding
enclosed), and the certificate gives p = sum_j B_j(s) p_j(y) in Bernstein polynomials with, modulo |y|^2 = 1,

    p_j = z'G_j z + sum_i (sigma_i g_i)_j + rest_j,    G_j > 0,    sigma_i = sum_a B_a(s) z'S_ia z,    S_ia > 0,

g_i >= 0 the inequalities of the case. B_j >= 0 and sum_j B_j = 1, so that q >= min_j inf rest_j - r = margin > 0 on the
case. So |y| decreases wherever |y| = 1: no motion leaves E (its right side is Lipschitz in x, its intervals join
without a gap).
*Goal.* The same with y = l z, |z| = 1, l in [0, 1] in the place of s, and q divided by l^2: the remainder of q is
r l^2 + d l, where d bounds what does not vanish with l (x_g is a rounded multiple of pi). |y| decreases wherever
l > d / margin. QED

Every number of a file is an exact double in hexadecimal notation. Digests show where a file was changed; the theorem
does not rest on them.
"""

from rtcd_jax.certificate.check.claim import PLANTS, Claim, Plant
from rtcd_jax.certificate.check.command import SECONDS, main, within
from rtcd_jax.certificate.check.exact import (
    PI,
    PI_ERROR,
    Damaged,
    Q,
    Refused,
    Undecided,
    alternating,
    near,
    printable,
    require,
    root_up,
    up,
)
from rtcd_jax.certificate.check.file import Node, digest, parse, read_bytes, read_claim, read_interval
from rtcd_jax.certificate.check.funnel import Interval, Motion, funnel_obligations, motion, require_bounds
from rtcd_jax.certificate.check.goal import Shell, goal_field, goal_obligations
from rtcd_jax.certificate.check.matrix import cofactors
from rtcd_jax.certificate.check.squares import (
    GramCertificate,
    Obligation,
    bernstein,
    is_positive,
    is_positive_definite,
    margin,
    monomials,
    reduced,
)
from rtcd_jax.certificate.check.taylor import Space, Taylor, economize, peak, polynomial, sine_and_cosine, terms_of
from rtcd_jax.certificate.check.verdict import FORMAT, VERSION, Report, check, check_file, sentence, volumes_of
