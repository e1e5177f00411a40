"""Compiles the climb to the worst directions of a cart-pole whose mass and length are uncertain, in at most 10 GiB."""

import resource

import jax
import jax.numpy as jnp
import numpy as np

import rtcd_jax
from rtcd_jax.config.load import load, parse, resolved
from rtcd_jax.config.packaged import packaged
from rtcd_jax.evaluation import search_budget
from rtcd_jax.funnel import _Step
from rtcd_jax.genome import decode
from rtcd_jax.numerics.sphere import climb
from rtcd_jax.policy import stabilize
from rtcd_jax.problem import make_problem
from rtcd_jax.trajectory import plan
from rtcd_jax.validation import Rollouts

if __name__ == "__main__":
    rtcd_jax.prepare_jax()
    jax.config.update("jax_enable_compilation_cache", False)
    box = {"design": {"pole_mass": 0.02, "pole_length": 0.01}}
    problem = make_problem(parse(resolved(load(packaged()["cartpole_robust"])) | {"uncertainty": box}))

    def planned(genomes):
        candidates = jax.vmap(lambda genome: decode(problem, genome))(genomes)
        one = jax.tree.map(lambda leaf: leaf[0], (candidates, plan(problem, candidates)))
        return one[0], stabilize(problem, *one)

    def worst(candidate, policy, y):
        budget = search_budget(problem)
        rollouts = Rollouts.of(problem, candidate, policy, budget.funnel)
        step, opponent = _Step.at(rollouts, jnp.asarray(0)), budget.dynamics.directions.opponent
        return climb(lambda y: step.ends_alone(1.0, y, opponent), y, budget.funnel.climbs)

    known = jax.eval_shape(planned, np.zeros((1, len([v for v in problem.variables if v.free]))))
    program = jax.jit(worst).lower(*known, np.zeros((problem.plant.n, problem.config.funnel.climbers)))
    resource.setrlimit(resource.RLIMIT_AS, (10 << 30, 10 << 30))
    program.compile()
