"""Sets to keep out of in certificates: what is proved of them, and what both checkers refuse."""

import copy
import json

import jax.numpy as jnp
import numpy as np
import pytest

from rtcd_jax.certificate import check
from rtcd_jax.certificate.falsify.simulation import Motions
from rtcd_jax.certificate.prove.certify import certify_elite
from rtcd_jax.certificate.prove.closed_loop import _touched
from rtcd_jax.certificate.prove.field import floats
from rtcd_jax.certificate.standing import standing_of
from rtcd_jax.elite.elite import Elite
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.numerics.keep_out import sets_of
from rtcd_jax.system.errors import UserError
from tests.certificate import swing
from tests.certificate.folder import folder_with
from tests.certificate.second import first_verdict, program, second_verdict
from tests.certificate.test_check import leaves, resealed

SETS = [
    {"center": [3.0, 5.0], "semi_axes": [0.5, 1.5]},
    {"normal": [-1.0, 0.1], "offset": -2.6},
    {"center": [3.9, 0.0], "semi_axes": [0.3, None]},
]
"""A disk above the goal, a slanted wall before it, and a strip of angles behind it, which is near the first knot."""
WALL, STRIP = 1, 2


def _elite(sets=SETS):
    arrays, record = swing.elite()
    return arrays, {**record, "keep_out": copy.deepcopy(sets)}


@pytest.fixture(scope="module")
def certified(tmp_path_factory):
    """A run folder whose elite 000 is proved to keep out of the sets."""
    folder = folder_with(tmp_path_factory.mktemp("kept_out"), *_elite())
    certify_elite(folder, "000", "proved", lambda step: None)
    return folder


@pytest.fixture
def content(certified):
    return json.loads((certified / "certificates" / "000.json").read_text())


@pytest.fixture(scope="module")
def second():
    return program()


def _same_verdict(second, path, content):
    verdict = first_verdict(content)
    assert second_verdict(second, path, content) == verdict
    return verdict


@pytest.mark.thorough
def test_both_checkers_prove_that_the_sets_are_not_entered(second, tmp_path, content):
    verdict = _same_verdict(second, tmp_path / "x.json", content)
    assert verdict.code == 0
    assert (
        " and ((theta - 3) / 0.5)^2 + ((theta_dot - 5) / 1.5)^2 >= 1 and -1 theta + 0.1 theta_dot <= -2.6 and "
        "((theta - 3.9) / 0.3)^2 >= 1 all the while."
    ) in verdict.words


@pytest.mark.thorough
def test_the_ellipsoids_keep_out_and_come_near(content):
    """On their rims, sampled densely: the proof gives hardly anything away."""
    claim = check.read_claim(check.Node("claim", content["claim"]))
    turn = np.linspace(0, 2 * np.pi, 2000)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    nearest = np.inf
    for each in content["funnel"]:
        interval = check.read_interval(check.Node("funnel", each), claim)
        if interval.start == 0:
            rim = floats(claim.x[interval.knot])[:, None] + floats(interval.first) @ circle
            nearest = np.minimum(nearest, [one.clearance(rim).min() for one in sets_of(SETS, swing.UPRIGHT[None])])
    assert np.all(nearest > 0)
    assert np.min(nearest) < 0.01


@pytest.mark.parametrize("stated", SETS)
def test_the_level_that_touches_is_that_of_the_sampled_funnel(stated):
    """Computed apart; the plane that it touches has the set on one side and the ellipsoid on the other."""
    (each,) = sets_of([stated], swing.UPRIGHT[None])
    arrays, _ = swing.elite()
    sets = Ellipsoids.about(jnp.asarray(arrays["x"].T), jnp.asarray(np.moveaxis(arrays["S"], 0, -1)))
    levels = np.asarray(each.radii_clear(sets)) ** 2
    for x, s, level in zip(arrays["x"], arrays["S"], levels, strict=True):
        found, normal = _touched(each, x, s)
        assert found == pytest.approx(level, rel=1e-9)
        reach = normal @ x + np.sqrt(level * normal @ np.linalg.solve(s, normal))
        if "center" in stated:
            axes = np.array([np.inf if axis is None else axis for axis in stated["semi_axes"]])
            finite = np.isfinite(axes)
            assert np.all(normal[~finite] == 0)
            edge = normal @ stated["center"] - np.linalg.norm(normal * np.where(finite, axes, 0))
        else:
            edge = stated["offset"]
        assert reach == pytest.approx(edge, rel=1e-9)


# What is refused ------------------------------------------------------------------------------------------------------


def _offset(value):
    return lambda content: content["claim"]["keep_out"][WALL].update(offset=float(value).hex())


def _drop(content):
    del content["funnel"][2]["sides"]


def _half_a_set(content):
    content["claim"]["keep_out"][WALL] = {"normal": content["claim"]["keep_out"][WALL]["normal"]}


def _turned_round(content):
    side = content["funnel"][3]["sides"][0]
    side[0] = [(-float.fromhex(a)).hex() for a in side[0]]


MOVED = {
    "a wall in the goal region": (_offset(-2.8), "certificate.goal.axes", "the set claim.keep_out[1] is not kept out"),
    "a wall at the goal": (_offset(-3.5), "certificate.goal.axes", "the set claim.keep_out[1] is not kept out"),
    "a strip in the first ellipsoids": (
        lambda c: c["claim"]["keep_out"][STRIP]["center"].__setitem__(0, (3.89).hex()),
        "certificate.funnel[0]", "the set claim.keep_out[2] is not kept out of",
    ),
    "a side turned round": (
        _turned_round, "certificate.funnel[3]", "the set claim.keep_out[0] is not kept out of",
    ),
    "a side of nothing": (
        lambda c: c["goal"]["sides"].__setitem__(0, [["0x0.0p+0", "0x0.0p+0"]]),
        "certificate.goal.axes", "the set claim.keep_out[0] is not kept out of",
    ),
    "a side along a strip": (
        lambda c: c["funnel"][1]["sides"][1][0].__setitem__(1, "0x1.0p-30"),
        "certificate.funnel[1].sides[1]", "must be zero where the ellipsoid has no end",
    ),
    "a side that is not there": (_drop, "certificate.funnel[2]", "has unknown keys or lacks some: sides"),
    "a side too few": (
        lambda c: c["goal"]["sides"].pop(), "certificate.goal.sides", "has 1 entries, must have 2",
    ),
    "half a set": (_half_a_set, "certificate.claim.keep_out[1]", "must have the keys normal, offset"),
    "no sets": (lambda c: c["claim"].update(keep_out=[]), "certificate.claim.keep_out", "has 0 entries, must have"),
    "a semi axis of zero": (
        lambda c: c["claim"]["keep_out"][0]["semi_axes"].__setitem__(1, "0x0.0p+0"),
        "certificate.claim.keep_out[0].semi_axes[1]", "must be > 0",
    ),
}  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("case", MOVED)
def test_both_refuse_what_is_not_kept_out_of_at_its_place(second, tmp_path, content, case):
    change, place, reason = MOVED[case]
    change(content)
    verdict = _same_verdict(second, tmp_path / "x.json", resealed(content))
    assert verdict.code == 1
    assert verdict.words.startswith(f"{place}: {reason}")


@pytest.mark.slow
def test_both_say_the_same_of_every_number_of_the_sets_and_sides(second, tmp_path, content):
    """Changed a little or much: none is idle, and some changes are harmless."""
    paths = [path for path in leaves(content) if {"keep_out", "sides"} & set(path[:3]) and "sha256" not in path]
    codes = []
    for path in paths:
        for factor in (1.001, 0.5, -1.0, 3.0):
            changed = copy.deepcopy(content)
            parent = changed
            for key in path[:-1]:
                parent = parent[key]
            if not isinstance(parent[path[-1]], str) or float.fromhex(parent[path[-1]]) == 0:
                continue
            parent[path[-1]] = (factor * float.fromhex(parent[path[-1]])).hex()
            codes.append(_same_verdict(second, tmp_path / "x.json", resealed(changed)).code)
    assert 0.1 < np.mean(codes) < 0.9


@pytest.mark.thorough
def test_a_certificate_is_an_elites_with_these_sets_alone(certified):
    path = certified / "certificates" / "000.json"
    assert standing_of(path, Elite.of(*_elite())).verdict == "proved"
    for others in ([], SETS[:2], [SETS[0], {**SETS[1], "offset": -2.61}, SETS[2]]):
        found = standing_of(path, Elite.of(*_elite(others)))
        assert found.verdict == "of another elite"
        assert f"keep_out has 3 sets there, {len(others)} in the elite, and these are not the same" in found.reason


@pytest.mark.thorough
def test_falsification_sees_a_set_that_was_moved_into_the_funnel(content):
    random = np.random.default_rng(0)
    assert Motions(content).follow(300, 20, random).share_of_limit.max() < 1
    _offset(-2.9)(content)
    assert Motions(resealed(content)).follow(300, 20, random).share_of_limit.max() > 1


@pytest.mark.thorough
def test_no_funnel_is_proved_about_a_motion_that_enters_a_set(tmp_path):
    """The wall cuts the first interval off: the proof begins behind it."""
    cut = {"normal": [1.0, 0.0], "offset": 3.25}
    folder = folder_with(tmp_path / "cut", *_elite([cut]))
    outcome = certify_elite(folder, "000", "proved", lambda step: None)
    assert outcome is not None
    assert 0 < outcome.start < 0.05


def test_value_functions_are_not_optimized_beside_sets(tmp_path):
    folder = folder_with(tmp_path / "optimized", *_elite())
    with pytest.raises(UserError, match=r"--optimize_value: .* has sets to keep out of \(task.keep_out\)"):
        certify_elite(folder, "000", "proved", lambda step: None, optimize_value=True)
