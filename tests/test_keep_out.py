"""Sets to keep out of through the pipeline: the motion's knots, ellipsoids, held-out motions, and what is stored."""

import json
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from rtcd_jax.analysis.disturb.scenarios import Loops
from rtcd_jax.config.load import load, parse, resolved
from rtcd_jax.elite.closed_loop import outside_limits, runge_kutta, simulate
from rtcd_jax.elite.elite import Elite
from rtcd_jax.elite.simulators import dynamics_of
from rtcd_jax.evaluation import make_evaluate
from rtcd_jax.genome import initial_genome
from rtcd_jax.numerics.ellipsoid import Ellipsoids
from rtcd_jax.problem import make_problem
from rtcd_jax.run.dry import understood
from rtcd_jax.run.format import arrays_of, record_of
from rtcd_jax.types import Status
from tests.paths import CONFIGS

SHARE = 0.9
SLOW = {"normal": [0, 1], "offset": 3.3}
BALL = {"center": [0, 4.3], "semi_axes": [1, 0.6]}
WIDE = {"center": [0, 4.3], "semi_axes": [np.inf, 0.6]}
COUPLED = {"normal": [1, 0.05, 0, 0], "offset": 0.37}
"""Of which the first three cut into the pendulum's motion, whose speed goes up to 4.04 rad/s, and the last one into the
cart-pole's, which goes up to 0.43."""


def _problem(name: str, *sets):
    data = resolved(load(CONFIGS / f"{name}.yaml"))
    data["task"]["keep_out"] = list(sets)
    data["trajectory"]["limit_share"] = SHARE
    return make_problem(parse(data))


@cache
def _evaluated(name: str, stated: str):
    problem = _problem(name, yaml.safe_load(stated))
    evaluate = jax.jit(make_evaluate(problem))
    one = evaluate(jnp.asarray(initial_genome(problem))[None], jax.random.key(0))
    return problem, jax.tree.map(lambda leaf: leaf[0], one)


CASES = pytest.mark.parametrize(
    ("name", "stated"),
    [
        pytest.param(name, yaml.safe_dump(stated), marks=mark)
        for name, stated, mark in (
            ("pendulum_rtcd", SLOW, pytest.mark.thorough),
            ("pendulum_rtcd", BALL, pytest.mark.thorough),
            ("pendulum_rtcd", WIDE, pytest.mark.slow),
            ("cartpole_rtcd", COUPLED, pytest.mark.slow),
        )
    ],
)


@CASES
def test_the_motion_keeps_its_share_of_the_room_and_the_ellipsoids_the_rest(name, stated):
    """The set cuts into the motion that is free: the knots come up to the share, an ellipsoid up to the set itself."""
    problem, evaluation = _evaluated(name, stated)
    assert evaluation.status == Status.OK
    (each,), policy = problem.keep_out, evaluation.funnel.policy
    near = each.shrunk(SHARE).clearance(np.asarray(policy.trajectory.xs).T)
    assert 0 <= near.min() < 1e-3
    sets = Ellipsoids.about(jnp.asarray(policy.trajectory.xs.T), jnp.asarray(np.moveaxis(policy.values, 0, -1)))
    shares = np.sqrt(evaluation.funnel.levels) / np.asarray(each.radii_clear(sets))
    assert 0.3 < shares.max() < 1


@CASES
def test_held_out_motions_never_enter(name, stated):
    """From the rims of all ellipsoids, by another integrator in shorter steps."""
    problem, evaluation = _evaluated(name, stated)
    elite = Elite.of(arrays_of(problem, evaluation), _record(problem, evaluation))
    assert elite.keep_out == problem.keep_out
    inside = np.array(yaml.safe_load(stated).get("center", 1e3 * np.sign(elite.x_goal + 1)))
    states = np.stack([inside, elite.x_goal])
    assert outside_limits(elite, states).tolist() == [True, False]
    loops = Loops.of([elite], [np.zeros((len(elite.u), 2, elite.x_goal.size))])
    assert jax.jit(Loops.inside)(loops, jnp.asarray(states.T)).tolist() == [False, True]
    knots, x = elite.sample(1500, np.random.default_rng(3))
    shares = np.sqrt([elite.value(k, x[[i]])[0] / elite.rho[k] for i, k in enumerate(knots)])
    x = elite.x[knots] + 0.999 * (x - elite.x[knots]) / shares[:, None]
    f = dynamics_of(elite)
    outcome = simulate(elite, f, runge_kutta(f, float(elite.time[1]) / 20), knots, x)
    assert not outcome.left_limits.any()
    assert outcome.failed.mean() < 0.01


def _record(problem, evaluation):
    return json.loads(json.dumps(record_of(problem, evaluation), default=lambda value: np.asarray(value).tolist()))


def test_without_sets_nothing_is_stored_or_told_of_them():
    problem = _problem("pendulum_rtcd")
    assert problem.keep_out == ()
    assert not any(line.startswith("keep out") for line in understood(problem))


def test_a_dry_run_tells_the_sets_in_the_states_names():
    lines = [line for line in understood(_problem("pendulum_rtcd", SLOW, WIDE)) if line.startswith("keep out")]
    assert lines == ["keep out   +1 theta_dot > 3.3", "keep out   ((theta_dot - 4.3) / 0.6)^2 < 1"]
