"""Certificates that bear a box of robots, disturbances, errors and old measurements; and files of version 1."""

import copy
import gzip
import json
import random
from pathlib import Path

import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.check import Q, Refused
from rtcd_jax.certificate.falsify.falsify import Part, summed
from rtcd_jax.certificate.falsify.simulation import Motions
from rtcd_jax.certificate.prove.certify import certify_elite
from rtcd_jax.certificate.prove.field import ControlPoints, rate
from rtcd_jax.certificate.standing import standing, standing_of
from rtcd_jax.cli import main as cli
from rtcd_jax.elite.elite import Elite
from tests.certificate import swing
from tests.certificate.folder import folder_with
from tests.certificate.loops import Simulated, ball, floats
from tests.certificate.test_check import nudged, refusal, resealed
from tests.certificate.test_theorems import anywhere, shown

pytestmark = pytest.mark.thorough  # proofs

VERSION_1 = Path(__file__).parent / "files" / "version1.json.gz"
"""Of the elite of `swing.py`, by a checker that knew no other version."""
MARGIN_THEN, INLET_THEN = 0.8240586116152051, 9.592102479145328
VERSION_2 = Path(__file__).parent / "files" / "version2_age.json.gz"
"""Of the last interval of that elite with an age of 0.5 ms, before old measurements counted to first order."""
MARGIN_OF_2 = 0.04141926240071001

BOX = """
uncertainty:
  design: {mass: 0.03, length: 0.02}
  input_limit: 0.02
  input: 0.05
  noise: [0.001, 0.002]
"""


@pytest.fixture(scope="module")
def bearing(tmp_path_factory):
    """A run folder whose elite is certified under all kinds of uncertainty but old measurements."""
    folder = folder_with(tmp_path_factory.mktemp("bearing"), *swing.elite())
    (folder / "box.yaml").write_text(BOX)
    outcome = certify_elite(folder, "000", "proved", lambda step: None, uncertainty=folder / "box.yaml")
    assert outcome is not None
    assert outcome.whole
    return folder


@pytest.fixture(scope="module")
def borne_text(bearing):
    return (bearing / "certificates" / "000.json").read_text()


@pytest.fixture
def borne(borne_text):
    return json.loads(borne_text)


# Version 1 ------------------------------------------------------------------------------------------------------------


def test_a_file_of_version_1_has_the_verdict_that_it_had(content):
    """And an elite without uncertainty, proved anew in version 2, has the same goal region and no smaller a funnel."""
    old = json.loads(gzip.decompress(VERSION_1.read_bytes()))
    then, now = check.check(old), check.check(content)
    assert then.margin == pytest.approx(MARGIN_THEN, rel=1e-7)
    assert then.volumes["inlet"] == INLET_THEN
    assert now.volumes["goal"] == then.volumes["goal"]
    assert now.volumes["inlet"] >= then.volumes["inlet"]
    assert np.allclose(now.rest, then.rest, rtol=1e-5, atol=0)
    old["claim"]["parameters"]["m"] = nudged(old["claim"]["parameters"]["m"], 0.5)
    assert refusal(resealed(old))


def test_a_file_of_version_1_proves_its_elite(tmp_path):
    file = tmp_path / "000.json"
    content = gzip.decompress(VERSION_1.read_bytes())
    file.write_bytes(content)
    arrays, record = swing.elite()
    for name, stored in json.loads(content)[
        "claim"
    ].items():  # bit by bit: another machine's integrator rounds otherwise
        if name in ("x", "u", "K", "x_goal", "K_goal"):
            value = np.reshape(floats(stored), arrays[name].shape)
            np.testing.assert_allclose(value, arrays[name], rtol=1e-9)
            arrays[name] = value
    assert standing_of(file, Elite.of(arrays, record)).proved
    heavier = {**record, "parameters": {**record["parameters"], "m": 0.7}}
    assert "parameters.m = 0.6 there, 0.7 in the elite" in standing_of(file, Elite.of(arrays, heavier)).reason


# Disturbances on both sides of known thresholds -----------------------------------------------------------------------


def falls(radius, w, cubic=0):
    """Whether |x| = radius is shown to shrink under x' = -x + cubic x^3 + w z for both signs of w; x = radius z."""
    signs = [
        anywhere(check.polynomial(1, {(0, 2): _exact(radius), (0, 4): _exact(-cubic * radius**3), (0, 1): _exact(-v)}))
        for v in (w, -w)
    ]
    return all(shown(each, 2) is not None for each in signs)


def _exact(value):
    return Q(*float(value).as_integer_ratio())


def test_a_disturbed_line_stays_within_its_disturbance():
    assert falls(1.01, 1.0)
    assert not falls(0.99, 1.0)


def test_a_disturbed_cubic_field_has_the_interval_between_its_roots():
    """x' = -x + x^3 + w: between the two positive roots of r - r^3 = w."""
    w = 0.2
    small, large = sorted(r.real for r in np.roots([1, 0, -1, w]) if r.real > 0)
    assert falls(1.01 * small, w, 1)
    assert falls(0.99 * large, w, 1)
    assert not falls(0.99 * small, w, 1)
    assert not falls(1.01 * large, w, 1)


# Robots ---------------------------------------------------------------------------------------------------------------


def wide(content):
    """A claim with a wide box, and its first interval."""
    claim = check.read_claim(check.Node("claim", content["claim"]))
    parameters = {"m": (Q(1, 2), Q(7, 10)), "l": (Q(3, 10), Q(1, 2)), "b": (Q(0), Q(1, 5)), "g": claim.parameters["g"]}
    claim = claim._replace(parameters=parameters)
    return claim, check.read_interval(check.Node("interval", content["funnel"][0]), claim)


def numeric(polynomial, s, y):
    return sum(float(c) * s ** e[0] * np.prod(np.power(y, e[1 : len(y) + 1])) for e, c in check.terms_of(polynomial))


def decrease(claim, interval, s, y, numbers):
    """q of one robot, where its input is free."""
    data = check.motion(claim, interval)
    axes, slope = (
        np.array([[numeric(entry, s, y) for entry in row] for row in each]) for each in (data.axes, data.axes_rate)
    )
    state, speed, gain = (np.array([numeric(each, s, y) for each in v]) for v in (data.state, data.rate, data.gain))
    u = float(data.input) - gain @ axes @ y
    moving = rate(claim.robot, numbers, (state + axes @ y)[:, None], u)[:, 0] - speed - slope @ y
    middle = {name: float(low + high) / 2 for name, (low, high) in claim.parameters.items()}
    at_center = np.array([[numeric(entry, 0.0, y) for entry in row] for row in data.axes])
    scale = 2 / (middle["m"] * middle["l"] ** 2 * np.linalg.det(at_center))
    return -scale * numbers["m"] * numbers["l"] ** 2 * np.linalg.det(axes) * (y @ np.linalg.solve(axes, moving))


def test_no_robot_of_the_box_is_worse_than_all_control_points(content):
    claim, interval = wide(content)
    todo = check.funnel_obligations(claim, interval, "interval")
    free = {name: each for name, each in todo.items() if name.startswith("free")}
    assert len(free) == 2 * 3 * 2, "affine in m and b, quadratic in l"
    error = float(next(iter(free.values())).error)
    dice = np.random.default_rng(0)
    for _ in range(20):
        s, y = dice.uniform(-1, 1), dice.normal(size=2)
        y /= np.linalg.norm(y)
        least = min(numeric(each.p, s, y) for each in free.values())
        for _ in range(50):
            numbers = {name: dice.uniform(float(low), float(high)) for name, (low, high) in claim.parameters.items()}
            assert decrease(claim, interval, s, y, numbers) >= least - error - 1e-9


def test_corners_of_the_box_are_not_enough():
    """m l^2 - 4/5 m l with m in [1, 2], l in [3/10, 1/2]: least at l = 2/5, which no corner shows."""
    space = check.Space(1, 0, 0, 2)
    mass, length = space.between(Q(1), Q(2), 0).p, space.between(Q(3, 10), Q(1, 2), 1).p
    moment = mass * length
    points = check.control_points(moment * length - moment * Q(4, 5), 1)
    points = {place: float(numeric(p, 0.0, (0,))) for place, p in points.items()}
    values = [m * r * r - 0.8 * m * r for m in np.linspace(1, 2, 11) for r in np.linspace(0.3, 0.5, 21)]
    assert points.keys() == {"0,0", "0,1", "0,2", "1,0", "1,1", "1,2"}
    assert min(points.values()) <= min(values) < min(points[place] for place in ("0,0", "0,2", "1,0", "1,2"))


def test_the_prover_s_control_points_are_the_field_s(content):
    """Their means by the Bernstein weights are the fields of robots inside the box."""
    claim, _ = wide(content)
    points = ControlPoints.of(claim)
    x = np.array([[0.3, 2.0], [1.0, -4.0]])
    determinant, a, b = points.field(claim.robot, x)
    assert determinant.shape == (12, 2)
    middle = {name: (float(low) + float(high)) / 2 for name, (low, high) in claim.parameters.items()}
    weights = np.kron(np.kron([0.5, 0.5], [0.25, 0.5, 0.25]), [0.5, 0.5])
    expected = rate(claim.robot, middle, x, 1.5)
    found = (np.einsum("j,njd->nd", weights, a) + 1.5 * np.einsum("j,njd->nd", weights, b)) / (weights @ determinant)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_every_input_lies_between_the_two_laws(content):
    claim = check.read_claim(check.Node("claim", content["claim"]))
    weak, strong, error, w = 2.0, 2.5, 0.3, 0.1
    claim = claim._replace(limits=(Q(2), Q(5, 2)), disturbance=Q(1, 10))
    space = check.Space(2, 2, 2)
    asked = check.Feedback(space.y(0) * Q(4), Q(16), space.poly(0))
    cases = check.cases_of(space, claim, Q(3, 10), Q(1), asked, Q(-1), Q(1))
    assert {name[:-1] for name in cases} == {"free", "high", "low"}
    assert check.are_joined(["free/0", "low-/0"])
    assert not check.are_joined(cases)
    dice = np.random.default_rng(0)
    for _ in range(300):
        y = dice.normal(size=2)
        y /= np.linalg.norm(y)
        laws = {"-": [], "+": []}
        for name, case in cases.items():
            if all(numeric(condition, 0.0, y) >= 0 for condition in case.where):
                laws[name[-1]].append(numeric(case.input, 0.0, y))
        asked = 1 + 4 * y[0] + dice.uniform(-error, error)
        limit = dice.uniform(weak, strong)
        u = np.clip(asked, -limit, limit) + dice.uniform(-w, w)
        assert min(laws["-"]) - 1e-12 <= u <= max(laws["+"]) + 1e-12


@pytest.mark.parametrize("weak", [2, 3, 4])
def test_an_uncertain_limit_has_one_free_case(content, weak):
    """Whatever the limit, u is a mean of inputs of cases that hold; and each of the cases is needed for that."""
    claim = check.read_claim(check.Node("claim", content["claim"]))
    claim = claim._replace(limits=(Q(weak), Q(4)), disturbance=Q(0))
    space = check.Space(2, 2, 2)
    asked = check.Feedback(space.y(0) * Q(5), Q(25), space.poly(0))
    cases = check.cases_of(space, claim, Q(0), Q(1, 2), asked, Q(-1), Q(1))
    ends = {"high", "low"} if weak == 4 else {"high-", "high+", "low-", "low+"}
    assert set(cases) == {"free"} | ends
    dice, needed = np.random.default_rng(0), set()
    for _ in range(1000):
        y = dice.normal(size=2)
        y /= np.linalg.norm(y)
        limit = dice.choice([weak, 4, dice.uniform(weak, 4)])
        u = np.clip(0.5 + 5 * y[0], -limit, limit)
        inputs = {
            name: numeric(case.input, 0.0, y)
            for name, case in cases.items()
            if all(numeric(condition, 0.0, y) >= 0 for condition in case.where)
        }
        assert min(inputs.values()) - 1e-12 <= u <= max(inputs.values()) + 1e-12
        for name in inputs:
            others = [each for other, each in inputs.items() if other != name]
            if not others or not min(others) - 1e-9 <= u <= max(others) + 1e-9:
                needed.add(name)
    assert needed == set(cases)


def test_older_files_have_two_free_cases(content):
    """Each with the conditions of its own law: together those of the one case."""
    claim = check.read_claim(check.Node("claim", content["claim"]))
    claim = claim._replace(limits=(Q(2), Q(4)), disturbance=Q(0))
    space = check.Space(2, 2, 2)
    asked = check.Feedback(space.y(0) * Q(5), Q(25), space.poly(0))
    one, two = (check.cases_of(space, claim, Q(0), Q(1, 2), asked, Q(-1), Q(1), joined=j) for j in (True, False))
    assert set(two) - set(one) == {"free-", "free+"}
    assert {name: two[name] for name in two.keys() & one.keys()} == {name: one[name] for name in one if name != "free"}
    late = check.cases_of(space, claim, Q(0), Q(1, 2), asked, Q(-1), Q(1), asked, joined=False)
    assert set(late) == set(two) | {f"{name}late" for name in two}
    for angle in np.linspace(0, 2 * np.pi, 100):
        y = np.array([np.cos(angle), np.sin(angle)])
        holds = {
            name: all(numeric(condition, 0.0, y) >= 0 for condition in case.where) for name, case in (one | two).items()
        }
        assert holds["free"] == (holds["free-"] or holds["free+"])


def test_the_mass_matrix_must_be_definite_for_all_robots_and_angles():
    cartpole = check.PLANTS["cartpole"].robot
    exact = {"Mc": 1.0, "Mp": 0.2, "lp": 0.2, "inertia_about_com": 0.003}
    box = {name: (_exact(value), _exact(value)) for name, value in exact.items()}
    assert check.mass_is_definite(cartpole, box)
    assert check.mass_is_definite(cartpole, box | {"Mp": (Q(1, 10), Q(3)), "lp": (Q(1, 10), Q(1))})
    # (Mc + Mp)(I + Mp lp^2) > (Mp lp)^2 holds upright as long as Mc (I + Mp lp^2) + Mp I > 0: lost at Mc < -0.055
    threshold = -0.2 * 0.003 / (0.003 + 0.2 * 0.04)
    assert check.mass_is_definite(cartpole, box | {"Mc": (_exact(threshold * 0.99),) * 2})
    assert not check.mass_is_definite(cartpole, box | {"Mc": (_exact(threshold * 1.01),) * 2})
    assert not check.mass_is_definite(cartpole, box | {"Mc": (_exact(threshold * 1.01), Q(1))})


# A whole certificate --------------------------------------------------------------------------------------------------


def test_it_says_what_it_bears(borne):
    report = check.check(borne)
    words = check.sentence(report)
    for part in (
        "for every robot 'pendulum' with m in [0.582, 0.618], l in [0.392, 0.408], b = 0.1",
        "a limit in [2.45, 2.55] N m",
        "every disturbance |w(t)| <= 0.05 N m",
        "theta +-0.001 rad, theta_dot +-0.002 rad/s",
        "comes and stays within theta +-",
        "an impulse of up to",
    ):  # fmt: skip
        assert part in words
    assert 0 < max(report.rest) < 1
    assert {case.split("/")[0][-1] for case in borne["funnel"][0]["cases"]} == {"-", "+"}


def test_no_motion_of_any_robot_leaves_and_worse_ones_do(borne):
    def followed(beyond):
        return summed([Part.of(Motions(borne, beyond).follow(400, 16, np.random.default_rng(3)))], 16)

    once = followed(1.0)
    assert once.broken == 0
    assert once.level > 0.99
    assert followed(4.0).left_funnel > 0


def test_the_elite_is_one_of_its_robots(bearing, borne):
    assert standing(bearing, "000").proved
    arrays, record = swing.elite()
    file = bearing / "certificates" / "000.json"
    for name, value in (("m", 0.61), ("l", 0.395)):
        other = {**record, "parameters": {**record["parameters"], name: value}}
        # another robot of the box; its own nominal motion has other rates
        assert "rates" in standing_of(file, Elite.of(arrays, other)).reason
    heavy = {**record, "parameters": {**record["parameters"], "m": 0.7}}
    assert "parameters.m in [0.58" in standing_of(file, Elite.of(arrays, heavy)).reason


def test_a_box_of_robots_that_only_meet_at_the_elite_is_of_another(bearing, borne, tmp_path):
    """Their inertia does not grow with the length as the elite's would."""
    term = borne["claim"]["robot"]["mass"][0][0][0]
    assert term["powers"] == {"l": 2, "m": 1}
    term.update(powers={"m": 1}, cos=(0.4**2).hex())
    file = tmp_path / "000.json"
    file.write_text(json.dumps(resealed(borne)))
    found = standing_of(file, Elite.read(bearing, "000"))
    assert found.verdict == "of another elite"
    assert "robot.mass: function 0 is another there" in found.reason


def _at(content, *path):
    for key in path:
        content = content[key]
    return content


def _raise(*path, to=None, factor=1.0, add=0.0):
    def change(content):
        *parents, last = path
        node = _at(content, *parents)
        node[last] = (to if to is not None else float.fromhex(node[last]) * factor + add).hex()

    return change


LIES = {
    "a heavier robot": (_raise("claim", "parameters", "m", 1, factor=1.3), "goal"),
    "a longer robot": (_raise("claim", "parameters", "l", 1, factor=1.3), "goal"),
    "uncertain damping": (_raise("claim", "parameters", "b", 1, factor=2.0), "must have the cases"),
    "a weaker motor": (_raise("claim", "limit", 0, factor=0.5), "goal"),
    "a stronger disturbance": (_raise("claim", "disturbance", factor=8.0), "goal"),
    "a worse encoder": (_raise("claim", "noise", 1, factor=200.0), "goal"),
    "a lower rest": (_raise("goal", "rest", factor=0.5), "goal.shells[0]: starts at"),
    "no rest": (_raise("goal", "rest", to=0.0), "must have a rest > 0"),
    "a larger push": (_raise("claim", "push", factor=1.01), "may leave the funnel"),
    "another inertia": (
        _raise("claim", "robot", "mass", 0, 0, 0, "cos", factor=1.5),
        "goal",
    ),
    "no gravity": (_raise("claim", "robot", "potential", 0, "cos", factor=-1.0), "goal"),
}


@pytest.mark.parametrize("lie", LIES)
def test_what_it_does_not_bear_is_refused_with_its_place(borne, lie):
    change, reason = LIES[lie]
    change(borne)
    assert reason in refusal(resealed(borne))


def test_a_missing_case_is_refused(borne):
    cases = borne["funnel"][1]["cases"]
    del cases[next(name for name in cases if name.startswith("free-"))]
    assert "funnel[1].cases: must have the cases" in refusal(resealed(borne))


def test_the_push_margin_is_that_of_impulses_at_fine_instants(borne):
    """It is a lower bound, and within 1 % of what a grid of instants and the box's corners allow."""
    claim = check.read_claim(check.Node("claim", borne["claim"]))
    least = np.inf
    for i, each in enumerate(borne["funnel"]):
        data = check.motion(claim, check.read_interval(check.Node(f"funnel[{i}]", each), claim))
        for s in np.linspace(-1, 1, 41):
            axes = np.array([[numeric(entry, s, (0, 0)) for entry in row] for row in data.axes])
            inertia = float(claim.parameters["m"][0] * claim.parameters["l"][0] ** 2)
            least = min(least, 1 / np.linalg.norm(np.linalg.solve(axes, [0, 1 / inertia])))
    assert 0.99 * least < float(claim.push) <= least


# Old measurements -----------------------------------------------------------------------------------------------------

AGE = 0.005


@pytest.fixture(scope="module")
def delayed_text(tmp_path_factory):
    """A certificate of feedback that is up to 5 ms old."""
    folder = folder_with(tmp_path_factory.mktemp("delayed"), *swing.elite())
    (folder / "box.yaml").write_text(f"age: {AGE}")
    outcome = certify_elite(folder, "000", "proved", lambda step: None, uncertainty=folder / "box.yaml")
    assert outcome is not None
    assert outcome.whole
    return (folder / "certificates" / "000.json").read_text()


@pytest.fixture
def delayed(delayed_text):
    return json.loads(delayed_text)


def test_five_milliseconds_cost_little(delayed, content):
    """To first order a delay is a known change of the feedback; as an error of its own size it leaves no funnel."""
    report, without = check.check(delayed), check.check(content)
    assert "measured at most 0.005 s ago" in check.sentence(report)
    assert report.volumes["inlet"] > 0.8 * without.volumes["inlet"]
    claim = report.claim
    interval = check.read_interval(check.Node("interval", delayed["funnel"][0]), claim)
    assert float(first_order(claim, interval)[0]) < 0.5 * AGE * float(claim.speed)


def first_order(claim, interval):
    """`lateness` on an interval, and the zeroth order's error."""
    late = check.input_error(claim, interval.knot)
    bounds = check.funnel_delay(claim, interval, "interval")
    jumps = check.jumps_within_reach(claim, interval.knot, interval.start)
    return check.lateness(claim, late, bounds.misfit, jumps), late


def test_a_former_feedback_is_what_the_first_order_says(delayed):
    """On simulated motions under delays that jump: phi(r) = phi(t) - (t - r) rho e up to `lateness`, where u_lin is not
    beyond the limits by more than the zeroth order's error."""
    claim = check.read_claim(check.Node("claim", delayed["claim"]))
    intervals = [check.read_interval(check.Node("f", each), claim) for each in delayed["funnel"]]
    loop, dice, step = Simulated(delayed), np.random.default_rng(0), 2.5e-4
    reach, largest = round(AGE / step), 0.0
    y = ball(40, 1)
    x = loop.nominal(0, 0.0)[:, None] + floats(delayed["funnel"][0]["first"]) @ y
    past = []
    for interval in intervals:
        k, begin, end = interval.knot, float(interval.start), float(interval.end)
        bound, zeroth = map(float, first_order(claim, interval))
        count = round((end - begin) * loop.dt / step)
        for i in range(count):
            fraction = begin + (end - begin) * i / count
            gain = (1 - fraction) * loop.K[k] + fraction * loop.K[k + 1]
            error = x - loop.nominal(k, fraction)[:, None]
            past.append(gain @ error)
            s = 2 * i / count - 1
            row = ((1 - s) * floats_of(interval.late[0]) + (1 + s) * floats_of(interval.late[1])) / 2
            asked = loop.u[k] - past[-1]
            for back in range(min(reach, len(past) - 1) + 1):
                off = np.abs(past[-1 - back] - (past[-1] - back * step * (row @ error)))
                within = np.abs(asked) <= loop.limit + zeroth
                assert np.all(off[within] <= bound)
                largest = max(largest, np.max(off[within], initial=0) / bound)
            held = np.choose(dice.integers(0, min(reach, len(past)), 40), past[-1 : -reach - 2 : -1])
            u = np.clip(loop.u[k] - held, -loop.limit, loop.limit)
            x = Simulated.step(lambda z, _, u=u: swing.rate(z, u, loop.parameters), x, 0.0, step)
    assert 0.02 < largest <= 1


def test_bounds_of_delays_bear_on_every_robot_of_a_box(delayed):
    claim = check.read_claim(check.Node("claim", delayed["claim"]))
    interval = check.read_interval(check.Node("f", delayed["funnel"][1]), claim)
    ends = {name: (low * Q(49, 50), low * Q(51, 50)) for name, (low, _) in claim.parameters.items()}
    among = check.funnel_delay(claim._replace(parameters=ends), interval, "box")
    for corner in ((0, 0, 0, 0), (1, 0, 1, 0), (0, 1, 0, 1)):
        exact = {name: (pair[i],) * 2 for i, (name, pair) in zip(corner, ends.items(), strict=True)}
        of_one = check.funnel_delay(claim._replace(parameters=exact), interval, "robot")
        assert all(float(a) > 0.999 * float(b) > 0 for a, b in zip(among, of_one, strict=True))


def floats_of(row):
    return np.array([float(each) for each in row])


DELAY_LIES = {
    "an older measurement": (_raise("claim", "age", factor=3.0), "goal"),
    "a slower feedback": (_raise("claim", "speed", factor=0.5), "the feedback may change by"),
    "a smoother feedback": (_raise("claim", "jerk", factor=0.5), "the feedback's jerk may be"),
    "a weaker reaction": (_raise("claim", "reaction", factor=0.5), "the feedback's reaction may be"),
    "no jump": (_raise("claim", "jumps", 2, factor=0.2), "the feedback's rate may jump by"),
    "another first order": (_raise("funnel", 1, "late", 0, 1, factor=-1.0), "funnel[1]"),
    "another first order at the goal": (_raise("goal", "late", 1, factor=-1.0), "goal"),
}


@pytest.mark.parametrize("lie", DELAY_LIES)
def test_delays_that_are_not_borne_are_refused_with_their_place(delayed, lie):
    change, reason = DELAY_LIES[lie]
    change(delayed)
    assert reason in refusal(resealed(delayed))


def test_laws_of_old_measurements_may_not_be_left_out(delayed):
    for name in [case for case in delayed["funnel"][1]["cases"] if "late" in case]:
        del delayed["funnel"][1]["cases"][name]
    assert "funnel[1].cases: must have the cases" in refusal(resealed(delayed))


def test_no_delayed_motion_leaves_and_later_ones_do(delayed):
    def followed(beyond):
        return summed([Part.of(Motions(delayed, beyond).follow(200, 16, np.random.default_rng(3)))], 16)

    assert followed(1.0).broken == 0
    assert followed(40.0).not_arrived > 0


def test_a_file_whose_old_measurements_count_by_their_speed_alone_is_decided_still():
    """As files were written first: without `jerk`, a delay is an error of the feedback."""
    old = json.loads(gzip.decompress(VERSION_2.read_bytes()))
    report = check.check(old)
    assert report.margin == pytest.approx(MARGIN_OF_2, rel=1e-7)
    assert not report.claim.first_order
    old["claim"]["speed"] = nudged(old["claim"]["speed"], -0.5)
    assert "the feedback may change by" in refusal(resealed(old))


# Configurations -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("design: {weight: 0.1}", "no number of the pendulum is 'weight'; "),
        ("input: -1", "input = -1: must be >= 0"),
        ("noise: [0.1]", "uncertainty.noise: has 1 entries, must have 2"),
        ("", "states no uncertainty"),
        ("uncertainty:", "states no uncertainty"),
        ("inptu: 1", "inptu"),
    ],
)
def test_an_uncertainty_that_is_none_is_told_in_a_line(tmp_path, capsys, text, reason):
    run = folder_with(tmp_path / "run", *swing.elite())
    (tmp_path / "box.yaml").write_text(text)
    assert cli.main(["certify", str(run), "--uncertainty", str(tmp_path / "box.yaml")]) == 2
    assert reason in capsys.readouterr().err


def test_what_the_run_bears_is_certified_unless_told_otherwise(tmp_path, monkeypatch):
    arrays, record = swing.elite()
    run = folder_with(tmp_path / "run", arrays, record | {"uncertainty": {"input": 0.05}})
    assert certify_elite(run, "000", "certified", lambda step: None) is not None
    claim = json.loads((run / "certificates" / "000.json").read_text())["claim"]
    assert float.fromhex(claim["disturbance"]) == 0.05
    assert certify_elite(run, "000", "certified", lambda step: None, uncertainty=Path("none")) is not None
    claim = json.loads((run / "certificates" / "000.json").read_text())["claim"]
    assert float.fromhex(claim["disturbance"]) == 0.0


# Mutations ------------------------------------------------------------------------------------------------------------

STATEMENT = [
    ("claim", "parameters", "m", 1), ("claim", "parameters", "m", 0), ("claim", "parameters", "l", 1),
    ("claim", "parameters", "b", 1), ("claim", "limit", 0), ("claim", "limit", 1), ("claim", "disturbance"),
    ("claim", "noise", 0), ("claim", "noise", 1), ("claim", "push"),
    ("goal", "rest"), ("claim", "robot", "mass", 0, 0, 0, "cos"), ("claim", "robot", "potential", 0, "cos"),
    ("claim", "robot", "motor", 0, 0, "cos"), ("claim", "K_goal", 1), ("claim", "u", 1), ("claim", "dt"),
]  # fmt: skip


def judged(text, rounds, seed):
    """Counts of accepted and refused; whatever is accepted must not be falsified."""
    dice, counts = random.Random(seed), {"accepted": 0, "refused": 0}
    for _ in range(rounds):
        content, path = json.loads(text), dice.choice(STATEMENT)
        factor = dice.choice([1 + 2.0**-40, 1 - 2.0**-40, 1.001, 0.999, 1.03, 0.97, 1.3, 0.7, 4.0, -1.0])
        _raise(*path, factor=factor)(content)
        if content == json.loads(text):
            continue
        with pytest.raises(Refused, match="was changed: its digest is another"):
            check.check(copy.deepcopy(content))
        try:
            check.check(resealed(content))
        except Refused:
            counts["refused"] += 1
            continue
        counts["accepted"] += 1
        found = summed([Part.of(Motions(content).follow(200, 16, np.random.default_rng(0)))], 16)
        assert found.left_funnel == found.left_limits == 0, (path, factor)
    return counts


def test_mutated_statements_are_refused_or_true(borne_text):
    counts = judged(borne_text, 12, 1)
    assert counts["refused"] > 3


@pytest.mark.slow
def test_hundreds_of_mutated_statements_are_refused_or_true(borne_text):
    counts = judged(borne_text, 400, 2)
    assert counts["refused"] > 100
    assert counts["accepted"] > 20
