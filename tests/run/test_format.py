"""The stable result format says what an evaluation holds, in the names and shapes that others read."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from rtcd_jax.config.load import config_hash
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.records import write_elite
from rtcd_jax.run.format import arrays_of, epsilon, evaluation_of, record_of
from rtcd_jax.run.optimize import summary
from rtcd_jax.run.reevaluation import Reported
from rtcd_jax.system.files import plain
from rtcd_jax.volume import VOLUMES
from tests import pipeline
from tests.pipeline import same

pytestmark = pytest.mark.thorough  # a real evaluation

KNOTS = 51


def _row(index: int):
    return jax.tree.map(lambda leaf: leaf[index], pipeline.evaluated())


@pytest.fixture(scope="module")
def arrays():
    return arrays_of(pipeline.problem(), _row(pipeline.RTCD))


@pytest.fixture(scope="module")
def record():
    return record_of(pipeline.problem(), _row(pipeline.RTCD))


def test_what_is_stored_is_read_back(arrays, record):
    """Also as the types say it: what goes on with a stored elite is compiled for arrays of JAX's shapes and kinds."""
    evaluation, rates = _row(pipeline.RTCD), np.ones((KNOTS - 1, 2, 2, 2))
    again = evaluation_of(pipeline.problem(), {**arrays, "S_rates": rates}, plain(record))
    motion, stored = again.funnel.policy.trajectory, evaluation.funnel.policy.trajectory
    for name in ("us", "xs", "cost", "defect", "iterations"):
        assert same(getattr(motion, name), getattr(stored, name))
    assert same(again.funnel.policy.value_rates, rates)
    assert same(again.candidate, evaluation.candidate)
    np.testing.assert_allclose(list(again.volumes.named.values()), list(evaluation.volumes.named.values()), rtol=1e-12)


def test_the_policy_of_the_record_is_the_candidate_s():
    """Where the search chose it; else the configuration's, as everywhere in this box."""
    evaluation, fixed = _row(pipeline.RTCD), {"input_weight": 1.0, "authority": 1.0, "discount": 0.0}
    chosen = dataclasses.replace(evaluation.candidate, policy={"authority": jnp.asarray(0.25)})
    assert record_of(pipeline.problem(), evaluation)["policy"] == fixed
    searched = dataclasses.replace(evaluation, candidate=chosen)
    assert plain(record_of(pipeline.problem(), searched)["policy"]) == {**fixed, "authority": 0.25}


@pytest.mark.parametrize(
    ("trials", "statements", "confidence"), [(64, 360, 0.99), (24_000, 360, 0.99), (1, 1, 0.5), (300, 40, 0.9)]
)
def test_epsilon_is_clopper_and_pearsons_bound_for_every_statement(trials, statements, confidence):
    """scipy's exact one-sided bound for no failure in `trials`, each statement with its share of the doubt."""
    doubt = (1 - confidence) / statements
    exact = scipy.stats.beta.ppf(1 - doubt, 1, trials)
    bound = epsilon(np.full(51, trials), confidence, statements)
    assert bound == pytest.approx(exact, rel=1e-10)
    assert scipy.stats.binom.cdf(0, trials, bound) == pytest.approx(doubt, rel=1e-9)
    two_sided = scipy.stats.binomtest(0, trials).proportion_ci(1 - 2 * doubt, "exact")
    assert bound == pytest.approx(two_sided.high, rel=1e-9)


def test_epsilon_is_that_of_the_knot_with_the_fewest_trials():
    assert epsilon(np.array([2000, 50, 2000]), 0.99, 40) == epsilon(np.array([50, 50, 50]), 0.99, 40)
    assert epsilon(np.array([2000, 0, 2000]), 0.99, 40) == 1


def _promises(random: np.random.Generator, knots: int, rounds: int, candidates: int, samples: int, runs: int):
    """For each of `runs` searches, whether the chosen candidate's epsilon is false.

    One knot of every candidate fails with a probability just above the bound, which rounds with failures hardly lower;
    the first clean round ends them. The candidate that then fails most is chosen: it has the largest funnel.
    """
    confidence = 0.5
    bound = epsilon(np.full(knots, samples), confidence, rounds * candidates)
    false = 0
    for _ in range(runs):
        chosen = 0.0
        for _ in range(candidates):
            p = np.full(knots, 1e-9)
            p[0] = 1.02 * bound
            for _ in range(rounds):
                if np.all(random.uniform(size=knots) < (1 - p) ** samples):
                    chosen = max(chosen, p[0])
                    break
                p[0] *= 0.9995
        false += chosen > bound
    return false / runs, 1 - confidence


@pytest.mark.parametrize(("knots", "rounds", "candidates"), [(11, 40, 1), (3, 40, 9), (51, 1, 9)])
def test_the_best_candidates_epsilon_is_false_no_more_often_than_promised(knots, rounds, candidates):
    """Whatever the number of knots, after many rounds and a choice among candidates by their own numbers."""
    rate, doubt = _promises(np.random.default_rng(0), knots, rounds, candidates, samples=100, runs=400)
    assert rate <= doubt


def test_the_arrays_have_the_documented_names_and_shapes(arrays):
    n, m = 2, 1
    shapes = {
        "time": (KNOTS,), "x": (KNOTS, n), "u": (KNOTS - 1, m), "K": (KNOTS, m, n), "S": (KNOTS, n, n),
        "rho": (KNOTS,), "trials": (KNOTS,), "Q": (n, n), "R": (m, m), "K_goal": (m, n), "x_goal": (n,), "u_max": (m,),
        "volumes_sum": (), "volumes_integral": (), "volumes_inlet": (), "volumes_geometric_mean": (),
        "volumes_goal": (),
        "volumes_push": (), "volumes_per_knot": (KNOTS,), "pushes": (KNOTS, m), "genome": (5,),
    }  # fmt: skip
    assert {name: array.shape for name, array in arrays.items()} == shapes


def test_the_arrays_fit_together(arrays):
    """Gains are R^-1 B' S, volumes those of (S, rho), the goal's LQR is the last one, the clock has equal steps."""
    mass, length, *_ = pipeline.CANDIDATES[pipeline.RTCD]
    b = np.array([[0.0], [1 / (mass * length**2)]])
    gains = np.linalg.solve(arrays["R"], b.T @ arrays["S"])
    np.testing.assert_allclose(arrays["K"], gains, rtol=1e-10)
    np.testing.assert_array_equal(arrays["K_goal"], arrays["K"][-1])
    np.testing.assert_allclose(arrays["volumes_per_knot"], np.pi * arrays["rho"] / np.sqrt(np.linalg.det(arrays["S"])))
    np.testing.assert_allclose(arrays["volumes_sum"], arrays["volumes_per_knot"].sum())
    impulses = mass * length**2 * np.sqrt(arrays["rho"] / arrays["S"][:, 1, 1])
    np.testing.assert_allclose(arrays["pushes"][:, 0], impulses)
    np.testing.assert_allclose(arrays["volumes_push"], impulses.min())
    np.testing.assert_allclose(np.diff(arrays["time"]), arrays["time"][1], rtol=1e-9)
    assert arrays["time"][0] == 0
    np.testing.assert_allclose(arrays["x"][[0, -1]], [[0, 0], arrays["x_goal"]], atol=1e-9)
    np.testing.assert_allclose(np.diag(arrays["Q"]), pipeline.CANDIDATES[pipeline.RTCD][2:4], rtol=1e-12)
    assert np.all(np.abs(arrays["u"]) <= arrays["u_max"])


def test_the_record_says_what_the_numbers_mean(arrays, record):
    """Read back from JSON: the physics in full, the weights, the rung with its promise, the configuration."""
    found = json.loads(json.dumps(plain(record)))
    mass, length, q1, q2, r = pipeline.CANDIDATES[pipeline.RTCD]
    config = pipeline.problem().config
    physics = {"m": mass, "l": length, "b": 0.1, "g": 9.81, "torque_limit": 2.5}
    assert found["plant"] == "pendulum"
    assert found["parameters"] == pytest.approx(physics, rel=1e-12)
    assert found["design"] == pytest.approx({"mass": mass, "length": length}, rel=1e-12)
    assert found["weights"]["q"] == pytest.approx([q1, q2], rel=1e-12)
    assert found["weights"]["r"] == pytest.approx([r], rel=1e-12)
    assert found["units"]["states"] == {"theta": "rad", "theta_dot": "rad/s"}
    assert found["units"]["design"] == {"mass": "kg", "length": "m"}
    assert (found["status"], found["rung"]) == ("OK", "sampled")
    assert found["samples"] == arrays["trials"].min()
    assert found["epsilon"] == epsilon(arrays["trials"], config.funnel.confidence, 40 * 9)
    assert found["config_hash"] == config_hash(config)
    assert found["duration"] == pytest.approx(arrays["time"][-1], rel=1e-12)
    for name in ("sum", "integral", "inlet", "geometric_mean"):
        assert found["volumes"][name] == arrays[f"volumes_{name}"]
    share = arrays["volumes_per_knot"].max() / arrays["volumes_sum"]
    assert found["volumes"]["share_of_largest_knot"] == pytest.approx(share)


def test_a_result_can_be_verified(arrays, record):
    """What is stored is all that an independent simulation of the funnel needs."""
    elite = Elite.of(arrays, plain(record))
    np.testing.assert_array_equal(elite.rho, arrays["rho"])
    np.testing.assert_array_equal(elite.state_limits, pipeline.problem().state_limits)


def test_a_failed_candidate_is_stored_with_its_status(tmp_path):
    hard = _row(pipeline.HARD)
    record = record_of(pipeline.problem(), hard)
    assert record["status"] == "FUNNEL_EMPTY"
    assert record["volumes"]["sum"] == record["volumes"]["share_of_largest_knot"] == 0
    write_elite(tmp_path, "initial", arrays_of(pipeline.problem(), hard), record)
    assert json.loads((tmp_path / "initial.json").read_text())["status"] == "FUNNEL_EMPTY"


def test_the_spread_is_that_over_the_keys():
    """Standard deviation over mean of each volume."""
    evaluation = _row(pipeline.RTCD)
    volumes = evaluation.volumes
    others = [
        dataclasses.replace(
            evaluation, volumes=dataclasses.replace(volumes, named=volumes.named | {"sum": factor * volumes["sum"]})
        )
        for factor in (0.99, 1.0, 1.01)
    ]
    spread = plain(record_of(pipeline.problem(), evaluation, others))["spread"]
    assert spread["keys"] == 3
    assert spread["volumes"]["sum"] == pytest.approx(0.01, rel=1e-9)
    assert spread["volumes"]["inlet"] == pytest.approx(0, abs=1e-12)
    assert plain(record_of(pipeline.problem(), evaluation))["spread"] is None


def test_without_volumes_there_is_no_spread():
    hard = _row(pipeline.HARD)
    assert set(record_of(pipeline.problem(), hard, [hard, hard])["spread"]["volumes"].values()) == {None}


def test_the_summary_has_a_dash_where_a_number_is_none():
    hard, best = _row(pipeline.HARD), _row(pipeline.RTCD)
    initial, first = Reported(hard, [hard, hard], None), Reported(best, [best, best], None)
    lines = list(summary(pipeline.problem(), initial, first))
    total = float(best.volumes["sum"])
    assert lines[1].split() == ["sum", "0", "-", f"{total:.5g}", "0.0%", "-"]
    assert "the initial candidate has no funnel" in lines[1 + len(VOLUMES)]
