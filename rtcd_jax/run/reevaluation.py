"""The second, more thorough evaluation of elites and initial candidate, from which alone numbers are reported.

One fixed key in every run: a candidate has the same numbers in every run. Further keys say by how much the estimate of
the best and of the initial candidate varies; MJX follows held-out samples of all of them to the goal as well.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, Generic, NamedTuple, TypeVar, final

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rtcd_jax.evaluation import compare_with_mjx, elite_budget, elite_key, over_tasks, resample
from rtcd_jax.problem import Problem
from rtcd_jax.reset import closed
from rtcd_jax.search.archive import Records
from rtcd_jax.system.cluster import Cluster
from rtcd_jax.system.console import Console
from rtcd_jax.system.errors import UserError
from rtcd_jax.types import Evaluation, Status, TaskEvaluations
from rtcd_jax.validation import PhysicsComparison

TOLERANCE = 1e-6
"""Largest difference of MJX and the closed form, in radii of the ellipsoid; rounding alone leaves less than 1e-9."""

Job = tuple[Evaluation, jax.Array, int]
"""A candidate, its random numbers, and its held-out samples at each knot."""
Result = TypeVar("Result")
Record = TypeVar("Record", Evaluation, TaskEvaluations)


def parts_of(evaluation: Records) -> list[Evaluation]:
    """A candidate's evaluation on each of its tasks."""
    if not isinstance(evaluation, TaskEvaluations):
        return [evaluation]
    return [row(evaluation.tasks, task) for task in range(len(evaluation.tasks.status))]


@final
class Reported(NamedTuple):
    """A candidate as it is stored: its evaluation, those under further keys, and MJX beside the closed form."""

    evaluation: Evaluation
    others: Sequence[Evaluation]
    physics: PhysicsComparison | None
    refinement: Mapping[str, Any] | None = None


@final
class Reevaluation:
    """Its programs compile beside the search's own, from when this is made. All methods raise Preempted.

    Rollouts ask for S at the knots alone: a policy's `value_rates` are left out of the programs. Of several tasks each
    is evaluated alone, by the same programs.
    """

    def __init__(self, problem: Problem, cluster: Cluster, population: Records, console: Console):
        self._problem, self._elites, self._key = problem, problem.config.elites, elite_key()
        if isinstance(population, TaskEvaluations):  # one candidate's on all tasks are a population, too
            one = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), population.tasks)
        else:
            one = population
        self._cluster, self._console = cluster, console
        self._checks = problem.config.search.generations
        self._budget = elite_budget(problem)
        blank = _with_rates(one, None)
        self._resample = _OnDevices(partial(resample, problem, elite_budget), cluster, blank)
        if self._elites.mjx_states:
            compare = lambda evaluation, key, _: compare_with_mjx(problem, evaluation, key)  # noqa: E731
            self._compare = _OnDevices(compare, cluster, blank)

    def sample(self, evaluations: Sequence[Record]) -> list[Record]:
        """Each with its funnels sampled again, all by the same random numbers."""
        parts = [part for evaluation in evaluations for part in parts_of(evaluation)]
        jobs = [(part, self._key, self._budget.samples_per_knot) for part in parts]
        results = self._resample(jobs, self._tell("funnels sampled again", len(jobs)))
        rates = [part.funnel.policy.value_rates for part in parts]
        sampled = [_with_rates(result, each) for result, each in zip(results, rates, strict=True)]
        tasks = max(1, len(self._problem.tasks))
        return [self._whole(sampled[k : k + tasks]) for k in range(0, len(sampled), tasks)]

    def _whole(self, parts: Sequence[Evaluation]) -> Any:
        """The inverse of `parts_of`, on the host."""
        if not self._problem.tasks:
            return parts[0]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *parts)
        whole = over_tasks(stacked, self._problem.config.search.over_tasks)
        if self._problem.reset is not None:
            key = jax.random.fold_in(self._key, self._elites.keys + 1)
            whole = closed(self._problem, whole, key, self._budget.samples_per_knot)
        return jax.device_get(whole)

    def report(self, elites: Sequence[Evaluation], initial: Evaluation) -> tuple[list[Reported], Reported]:
        """What is stored of the elites, best first, and of the initial candidate.

        Raises:
            UserError: MJX and the closed form differ.
        """
        candidates = [*elites, initial]
        physics = self.compared(candidates)
        others: list[Sequence[Evaluation]] = [[] for _ in candidates]
        others[0], others[-1] = self.repeated([elites[0], initial])
        *reported, last = map(Reported, candidates, others, physics)
        return reported, last

    def repeated(self, evaluations: Sequence[Evaluation]) -> list[list[Evaluation]]:
        """Each under the further keys, with the held-out samples of the first rounds alone: by more of them the levels
        vary less, so that the spread is rather overestimated.
        """
        count = self._elites.keys
        keys = [jax.random.fold_in(self._key, index) for index in range(count)]
        jobs = [(evaluation, key, self._budget.funnel.trials) for evaluation in evaluations for key in keys]
        results = self._resample(jobs, self._tell("funnels sampled by further keys", len(jobs)))
        return [results[k * count : (k + 1) * count] for k in range(len(evaluations))]

    def compared(self, evaluations: Sequence[Evaluation]) -> list[PhysicsComparison | None]:
        """MJX beside the closed form; None for what has no funnel."""
        comparisons: list[PhysicsComparison | None] = [None] * len(evaluations)
        if not self._elites.mjx_states:
            return comparisons
        rows = [k for k, evaluation in enumerate(evaluations) if int(evaluation.status) == Status.OK]
        key = jax.random.fold_in(self._key, self._elites.keys)
        jobs = [(evaluations[k], key, self._elites.mjx_states) for k in rows]
        for k, comparison in zip(rows, self._compare(jobs, self._tell("funnels under MJX", len(jobs))), strict=True):
            require_equal_physics(comparison)
            comparisons[k] = comparison
        return comparisons

    def raise_if_preempted(self) -> None:
        """Raises Preempted if the run was asked to stop; all processes call it alike."""
        self._checks += 1
        self._cluster.raise_if_preempted(self._checks)

    def _tell(self, what: str, count: int) -> Callable[[int], None]:
        def tell(done: int) -> None:
            self.raise_if_preempted()
            if done:
                self._console.message(f"{what}: {done} of {count}")

        return tell


def require_equal_physics(comparison: PhysicsComparison) -> None:
    """Raises UserError, which names the state, if MJX and the closed form differ by more than TOLERANCE."""
    if not comparison.difference <= TOLERANCE:
        start, closed_form, mjx = (
            np.array2string(np.asarray(state), precision=9, separator=", ", max_line_width=1000)
            for state in (comparison.start, comparison.closed_form, comparison.mjx)
        )
        raise UserError(
            f"MJX and the closed form differ by {float(comparison.difference):.2g} radii of the ellipsoid (must be <= "
            f"{TOLERANCE:g}): the state {start} of knot {int(comparison.knot)} is at {closed_form} by the closed form "
            f"and at {mjx} by MJX at t = {float(comparison.time):.4g} s: the MJCF or the plant's equations are wrong"
        )


def physics_line(comparisons: Sequence[PhysicsComparison]) -> str:
    """What MJX says of all candidates, in one line."""
    states = sum(int(comparison.states) for comparison in comparisons)
    failures = sum(int(comparison.failures) for comparison in comparisons)
    difference = max(float(comparison.difference) for comparison in comparisons)
    return (
        f"MJX: {states} held-out samples of {len(comparisons)} funnels followed to the goal, {failures} failed; "
        f"largest |MJX - closed form| {difference:.1g} of an ellipsoid's radius"
    )


@final
class _OnDevices(Generic[Result]):
    """`verb(evaluation, key, samples) -> result`, jitted for one candidate on every device at a time."""

    def __init__(self, verb: Callable[[Evaluation, jax.Array, Any], Result], cluster: Cluster, population: Evaluation):
        self._cluster = cluster
        pool = ThreadPoolExecutor(1)
        self._program: Future[jax.stages.Compiled] = pool.submit(self._compile, verb, population)
        pool.shutdown(wait=False)

    def _compile(
        self, verb: Callable[[Evaluation, jax.Array, Any], Result], population: Evaluation
    ) -> jax.stages.Compiled:
        def one(jobs, _):
            evaluation, key, samples = row(jobs, 0)
            result = verb(evaluation, jax.random.wrap_key_data(key), samples)
            return jax.tree.map(lambda leaf: leaf[None], result)

        blank = jax.tree.map(lambda leaf: np.zeros(leaf.shape[1:], leaf.dtype), population)
        jobs = self._split([(blank, jax.random.key(0), 1)] * len(self._cluster.devices))
        return self._cluster.shared(one).lower(jobs, ()).compile()

    def _split(self, jobs: Sequence[Job]) -> Any:
        rows = [(_with_rates(e, None), jax.random.key_data(key), np.asarray(samples)) for e, key, samples in jobs]
        return self._cluster.split(jax.tree.map(lambda *leaves: np.stack(leaves), *rows))

    def _rows(self, jobs: Any) -> Result:
        return self._cluster.gathered(self._program.result()(jobs, ()))

    def __call__(self, jobs: Sequence[Job], tell: Callable[[int], None]) -> list[Result]:
        """The jobs' results; `tell` hears how many are done before each round over the devices and after the last."""
        devices = len(self._cluster.devices)
        results: list[Result] = []
        while len(results) < len(jobs):
            tell(len(results))
            batch = [*jobs[len(results) : len(results) + devices]]
            filled = batch + batch[-1:] * (devices - len(batch))
            rows = self._cluster.interruptible(partial(self._rows, self._split(filled)))
            results += [row(rows, k) for k in range(len(batch))]
        tell(len(results))
        return results


def _with_rates(evaluation: Evaluation, rates: Any) -> Evaluation:
    where = lambda evaluation: evaluation.funnel.policy.value_rates  # noqa: E731
    return eqx.tree_at(where, evaluation, rates, is_leaf=lambda leaf: leaf is None)


def row(tree: Any, index: int) -> Any:
    """One entry of the leading axis of all leaves."""
    return jax.tree.map(lambda leaf: leaf[index], tree)
