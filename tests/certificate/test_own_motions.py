"""Certificates about own motions: robots whose numbers are constant, each with its funnel about its own center."""

import copy
import gzip
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Q
from rtcd_jax.certificate.falsify.falsify import Part, summed
from rtcd_jax.certificate.falsify.simulation import Motions
from rtcd_jax.certificate.prove.backward import tiers_of
from rtcd_jax.certificate.prove.centers import Nodes, shifts_at
from rtcd_jax.certificate.prove.certify import certify_elite
from rtcd_jax.certificate.prove.closed_loop import claim_of, hermite, with_digests
from rtcd_jax.certificate.prove.field import floats
from rtcd_jax.certificate.prove.uncertainty import bounds_of
from rtcd_jax.config.schema import UncertaintyConfig
from rtcd_jax.elite.elite import Elite
from rtcd_jax.export.proof import ProvedFunnel
from rtcd_jax.system.errors import UserError
from tests.certificate import swing
from tests.certificate.folder import folder_with
from tests.certificate.test_check import refusal, resealed

BOX = UncertaintyConfig(design={"mass": 0.05, "length": 0.03}, input=0.02, center="moving")
W = 0.02
STORED = Path(__file__).parent / "files" / "own_motions.json.gz"
NAMES = ("l", "m")
"""Of the uncertain numbers, as claims have them."""


def elite():
    return Elite.of(*swing.elite())


def read(record):
    """The claim of a record, about the whole motion."""
    whole = with_digests({**record, "start": [0, (0.0).hex()], "push": (0.0).hex()})
    return check.read_claim(check.Node("claim", whole))


@pytest.fixture(scope="module")
def record():
    return claim_of(elite(), bounds_of(elite(), BOX))


@pytest.fixture(scope="module")
def claim(record):
    return read(record)


def robot(claim, p):
    """The numbers of the robot at a point p of the cube, as `swing.rate` takes them."""
    numbers = dict(swing.PARAMETERS)
    for name, place in zip(NAMES, p, strict=True):
        low, high = map(float, claim.parameters[name])
        numbers[name] = (low + high) / 2 + place * (high - low) / 2
    return numbers


# Centers --------------------------------------------------------------------------------------------------------------


def own_motion(claim, p):
    """c [N+1 n] of a robot at the knots, by an integrator of its own."""
    x, rates, gains, dt = floats(claim.x), floats(claim.rates), floats(claim.K), float(claim.dt)
    knots = [x[0]]
    for k, u in enumerate(floats(claim.u)):

        def slope(t, state, k=k, u=u):
            nominal, _ = hermite(t / dt, dt, x[k], rates[k, 0], x[k + 1], rates[k, 1])
            gain = gains[k] + t / dt * (gains[k + 1] - gains[k])
            return swing.rate(state, np.clip(u - gain @ (state - nominal), -2.5, 2.5), robot(claim, p))

        knots.append(solve_ivp(slope, (0, dt), knots[-1], rtol=1e-10, atol=1e-12).y[:, -1])
    return np.array(knots)


def test_centers_are_those_of_the_motions_of_robots_inside_the_box(claim):
    """Up to a hundredth of how far these are from x*, at a robot that was not fitted."""
    inside = np.array([0.6, -0.7])
    away = own_motion(claim, inside) - floats(claim.x)
    shifts, _ = shifts_at(claim.shifts, inside[None])
    assert np.linalg.norm(away) > 1e-3
    assert np.linalg.norm(away - shifts[:, :, 0]) < 0.01 * np.linalg.norm(away)


def test_nodes_have_the_nominal_robot_first_and_every_combination():
    nodes = Nodes.of({"b": (1.0, 3.0), "a": (2.0, 2.0), "c": (0.0, 4.0)})
    assert not nodes.points[0].any()
    assert {tuple(point) for point in nodes.points} == {(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    assert np.all(nodes.numbers["b"][:, 0] == 2 + nodes.points[:, 0])
    assert np.all(nodes.numbers["c"][:, 0] == 2 + 2 * nodes.points[:, 1])
    assert np.all(nodes.numbers["a"] == 2)


def test_without_an_uncertain_number_there_are_no_shifts():
    moving, common = (UncertaintyConfig(input=W, center=center) for center in ("moving", "common"))
    assert claim_of(elite(), bounds_of(elite(), moving)) == claim_of(elite(), bounds_of(elite(), common))


def test_more_numbers_than_polynomials_bear_are_refused_before_the_proof():
    assert tiers_of(4, 2)[-1].further
    assert len(tiers_of(4, 3)) < len(tiers_of(4, 2))
    with pytest.raises(UserError, match=r"own motions with 5 uncertain numbers and 4 states.*common"):
        tiers_of(4, 5)


# Models ---------------------------------------------------------------------------------------------------------------


def value(polynomial, s, y, p):
    at = np.array([s, *y, *p])
    return sum(float(c) * np.prod(at ** np.array(e)) for e, c in check.terms_of(polynomial))


def interval_of(claim, orders):
    """The second interval with an ellipsoid that turns."""

    def exact(rows):
        return [[check.rational(float(c)) for c in row] for row in rows]

    first, last = [[0.1, 0.0], [0.05, 0.3]], [[0.12, 0.01], [0.02, 0.33]]
    bend = [exact(np.full((2, 2), 0.003)), exact(np.full((2, 2), -0.002))]
    return check.Interval(1, Q(0), Q(1), exact(first), exact(last), bend, orders, {}, [])


@pytest.mark.thorough
@pytest.mark.parametrize("orders", [(5, 5, 1, 1, 1), (5, 5, 1, 2, 2), (5, 7, 2, 1, 2)])
def test_models_enclose_the_decrease_of_every_robot(claim, orders):
    """q is -y'L^-1 D (x' - c_p' - L'y) det L at x = c_p + L y, times one positive number."""
    interval = interval_of(claim, orders)
    data, (_, q) = check.motion(claim, interval), check.funnel_models(claim, interval, "interval")["free+"]
    lower, changed = check.economized(q.p, claim.n, orders[3:])
    dice, pairs = np.random.default_rng(0), []
    for _ in range(100):
        s, y, p = dice.uniform(-1, 1), dice.normal(size=2), dice.uniform(-1, 1, 2)
        y /= np.linalg.norm(y)

        def now(entries, s=s, y=y, p=p):
            return np.array([value(each, s, y, p) for each in entries])

        axes, turn = (np.array([now(row) for row in each]) for each in (data.axes, data.axes_rate))
        center, drift = now(data.center), now(data.rate) + now(data.shift_rate)
        u = float(data.input) + W - now(data.gain) @ (center - now(data.state) + axes @ y)
        numbers = robot(claim, p)
        moved = swing.rate(center + axes @ y, u, numbers) - drift - turn @ y
        inertia = numbers["m"] * numbers["l"] ** 2
        pairs.append((-inertia * np.linalg.det(axes) * (y @ np.linalg.solve(axes, moved)), value(q.p, s, y, p)))
        assert abs(pairs[-1][1] - value(lower, s, y, p)) <= float(changed) + 1e-12
    exact, found = np.array(pairs).T
    factor = exact @ found / (exact @ exact)
    assert factor > 0
    assert np.all(np.abs(factor * exact - found) <= 1.5 * float(q.r + q.d))


def test_lower_degrees_change_a_polynomial_by_no_more_than_their_bound():
    dice = np.random.default_rng(1)
    exponents = [(a, b, 0, c, d) for a in range(2) for b in range(3) for c in range(5) for d in range(4)]
    p = check.polynomial(4, {e: Q(int(dice.integers(1, 9)), 7) for e in exponents})
    for degrees in ((1, 1), (2, 1), (0, 3), (4, 3)):
        lower, changed = check.economized(p, 2, degrees)
        assert all(e[3] <= degrees[0] and e[4] <= degrees[1] for e, _ in check.terms_of(lower))
        assert (changed == 0) == (degrees == (4, 3))
        for _ in range(200):
            y = dice.normal(size=2)
            at = dice.uniform(-1, 1), y / np.linalg.norm(y), dice.uniform(-1, 1, 2)
            assert abs(value(p, *at) - value(lower, *at)) <= float(changed) + 1e-12


# Files ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda shift: shift["x"][0].__setitem__(0, (1e-3).hex()), "must be zero: all robots begin about x"),
        (lambda shift: shift["powers"].update(g=1), "must be of l, m"),
        (lambda shift: shift["powers"].clear(), "must be of l, m"),
        (lambda shift: shift["powers"].update(m=4), "must be an integer from 1 to 3"),
        (lambda shift: shift["rates"].pop(), "has 3 entries, must have 4"),
    ],
)
def test_shifts_that_are_none_are_refused(record, change, reason):
    wrong = copy.deepcopy(record)
    change(wrong["shifts"][0])
    parts = [with_digests({key: part[key] for key in ("powers", "x", "rates")}) for part in wrong["shifts"]]
    with pytest.raises(check.Refused, match=reason):
        read({**wrong, "shifts": parts})


def test_the_same_powers_twice_are_refused(record):
    with pytest.raises(check.Refused, match="has the same powers twice"):
        read({**record, "shifts": [*record["shifts"], record["shifts"][0]]})


@pytest.fixture
def content():
    """Of the last interval of the elite of `swing.py`."""
    return json.loads(gzip.decompress(STORED.read_bytes()))


@pytest.mark.thorough
def test_the_prover_proves_a_funnel_about_own_motions(tmp_path, content):
    folder = folder_with(tmp_path, *swing.elite())
    outcome = certify_elite(folder, "000", "proved", lambda step: None, uncertainty=BOX)
    assert outcome is not None
    assert outcome.whole
    assert outcome.volumes["outlet"] == pytest.approx(check.check(content).volumes["outlet"], rel=1e-3)


@pytest.mark.thorough
def test_the_sentence_says_whose_funnel_it_is(content):
    said = check.sentence(check.check(content))
    assert "(SI units; constant in time)" in said
    assert "in the funnel of its robot, all of one size, each about its own center" in said
    assert "A state at the center of its robot's funnel that an impulse of up to" in said


@pytest.mark.thorough
def test_no_simulated_robot_of_the_box_leaves_its_funnel(content):
    """Of ten times the box some do."""
    for beyond, lost in ((1.0, False), (10.0, True)):
        moves = Motions(content, beyond)
        found = summed([Part.of(moves.follow(300, 16, np.random.default_rng(0)))], 16)
        assert bool(found.left_funnel or found.left_limits or found.not_arrived) == lost


@pytest.mark.thorough
def test_centers_that_go_elsewhere_prove_nothing(content):
    for part in content["claim"]["shifts"]:
        part["x"] = [[(-9 * float.fromhex(c)).hex() for c in row] for row in part["x"]]
    assert "funnel" in refusal(resealed(content)) or "goal" in refusal(resealed(content))


@pytest.mark.thorough
def test_a_higher_degree_in_a_number_asks_for_more_control_points(content):
    content["funnel"][0]["orders"][3] += 1
    assert "must have the cases" in refusal(resealed(content))


# What all robots share ------------------------------------------------------------------------------------------------


def test_ellipsoids_about_the_nominal_motion_are_in_every_robot_s(content, tmp_path):
    """Up to the resolution of the bisection no larger ones are."""
    file = tmp_path / "000.json"
    file.write_text(json.dumps(content))
    funnel, claim = ProvedFunnel.read(file), check.read_claim(check.Node("claim", content["claim"]))
    shared = funnel.of_all_robots()

    def axes(ellipsoids, at):
        found = ellipsoids.at(at)
        assert found is not None
        return found

    cube = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 2), axis=-1).reshape(-1, 2)
    values, rates = shifts_at(claim.shifts, cube)
    most = 0.0
    for at in np.linspace(3, 3.999, 50):
        away, _ = hermite(at - 3, float(claim.dt), values[3], rates[3, 0], values[4], rates[3, 1])
        most = max(most, np.max(np.linalg.norm(np.linalg.solve(axes(funnel, at), away), axis=0)))
    assert 0 < most <= funnel.offsets[0] < most + 0.02
    assert np.allclose(axes(shared, 3.5), axes(funnel, 3.5) * (1 - funnel.offsets[0]))
    assert np.array_equal(axes(shared, 4.0), axes(funnel, 4.0))


def test_where_nothing_is_shared_the_export_says_so(content, tmp_path):
    for part in content["claim"]["shifts"]:
        part["x"][3:] = [[(1e3 * float.fromhex(c)).hex() for c in row] for row in part["x"][3:]]
    file = tmp_path / "000.json"
    file.write_text(json.dumps(resealed(content)))
    with pytest.raises(UserError, match=r"on interval 3 no state near x\* is in every robot's funnel"):
        ProvedFunnel.read(file).of_all_robots()
