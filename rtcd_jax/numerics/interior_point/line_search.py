"""The filter line search of Waechter and Biegler, with a forced step in the place of their restoration phase."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from rtcd_jax.numerics import kkt
from rtcd_jax.numerics.interior_point.boxes import Boxed, log_sum, total
from rtcd_jax.numerics.interior_point.inequalities import misfits
from rtcd_jax.numerics.interior_point.iterate import Iterate, where
from rtcd_jax.numerics.interior_point.model import Model
from rtcd_jax.numerics.interior_point.problem import Settings
from rtcd_jax.numerics.keep_out import Set


class Direction(NamedTuple):
    """A Newton step: its longest length inside the boxes, the merit's slope along it, and whether it can be used."""

    step: kkt.Step
    longest: Float[Array, " P"]
    descent: Float[Array, " P"]
    usable: Bool[Array, " P"]
    slacks: Float[Array, "inner c P"] | None = None

    def point(
        self, it: Iterate, length: Float[Array, " P"]
    ) -> tuple[Float[Array, "knots n P"], Float[Array, "intervals m P"], Float[Array, " P"]]:
        """xs, us and h at a length."""
        step = self.step
        return it.xs + length * step.dxs, it.us + length * step.dus, it.h + length * step.dh


class Search(NamedTuple):
    """What came of it: the length, whether it is taken (forced: against the filter), the point's values, the filter."""

    length: Float[Array, " P"]
    taken: Bool[Array, " P"]
    forced: Bool[Array, " P"]
    defects: Float[Array, "N n P"]
    cost: Float[Array, " P"]
    filter: Float[Array, "F 2 P"]
    filtered: Int[Array, " P"]
    rejections: Int[Array, " P"]


class _Trial(NamedTuple):
    defects: Float[Array, "N n P"]
    cost: Float[Array, " P"]
    finite: Bool[Array, " P"]
    augment: Bool[Array, " P"]


class _Filter(NamedTuple):
    """What a trial is compared with: violation and merit where the step begins, and the filter's entries."""

    violation: Float[Array, " P"]
    merit: Float[Array, " P"]
    start: Float[Array, " P"]
    entries: Float[Array, "F 2 P"]
    rounding: tuple  # of violation and merit

    @classmethod
    def of(cls, it: Iterate, slacks: Boxed, sets: tuple[Set, ...]) -> "_Filter":
        merit = it.cost - it.barrier * log_sum(slacks)
        eps = float(jnp.finfo(it.cost.dtype).eps)
        rounding = 10 * eps * it.defects[..., 0].size, 10 * eps * jnp.abs(merit)
        violation = total(jnp.abs(it.defects))
        if it.inequalities is not None:
            merit -= it.barrier * total(jnp.log(it.inequalities.slacks))
            violation += total(jnp.abs(misfits(sets, it.inequalities.slacks, it.xs)))
        return cls(violation, merit, jnp.maximum(1.0, it.violation_start), it.filter, rounding)

    def judge(
        self,
        length: Float[Array, " P"],
        descent: Float[Array, " P"],
        violation: Float[Array, " P"],
        merit: Float[Array, " P"],
    ) -> tuple[Bool[Array, " P"], Bool[Array, " P"]]:
        """Whether a trial is accepted, and whether the filter then gets an entry."""
        by_violation, by_merit = self.rounding
        steep = jnp.where(descent < 0, -descent, 0.0)
        switching = (descent < 0) & (length * steep**2.3 > self.violation**1.1)
        switching = switching & (self.violation <= 1e-4 * self.start)  # (19)
        armijo = merit <= self.merit + 1e-4 * length * descent + by_merit  # (20)
        feasible = violation <= (1 - 1e-5) * self.violation + by_violation
        better = feasible | (merit <= self.merit - 1e-5 * self.violation + by_merit)  # (18)
        free = jnp.all((violation <= self.entries[:, 0]) | (merit <= self.entries[:, 1] + by_merit), 0)
        accepted = (violation <= 10 * self.start) & free & jnp.where(switching, armijo, better)
        return accepted, ~(switching & armijo)

    def with_entry(self, add: Bool[Array, " P"], filtered: Int[Array, " P"]) -> Float[Array, "F 2 P"]:
        """The filter's entries, with the present point's in the oldest place where `add`: (22)."""
        slots = self.entries.shape[0]
        slot = (jnp.arange(slots)[:, None] == filtered % slots) & add
        entry = jnp.stack([(1 - 1e-5) * self.violation, self.merit - 1e-5 * self.violation])
        return jnp.where(slot[:, None], entry, self.entries)


def line_search(
    model: Model, s: Settings, it: Iterate, slacks: Boxed, direction: Direction, parameters: PyTree
) -> Search:
    """Backtrack to the first length that the filter accepts: algorithm A-5.

    After four failures in a row the filter is emptied and the last, short step taken.
    """
    compared, usable = _Filter.of(it, slacks, model.problem.keep_out), direction.usable

    def attempt(length):
        xs, us, h = direction.point(it, length)
        defects, cost = model.simulate(xs, us, h, parameters)
        violation = total(jnp.abs(defects))
        merit = cost - it.barrier * log_sum(model.slacks(model.values(xs, us, h)))
        if it.inequalities is not None:
            reached = it.inequalities.slacks + length * direction.slacks
            merit -= it.barrier * total(jnp.log(reached))
            violation += total(jnp.abs(misfits(model.problem.keep_out, reached, xs)))
        accepted, augment = compared.judge(length, direction.descent, violation, merit)
        finite = jnp.isfinite(merit) & jnp.isfinite(violation)
        return finite & accepted, _Trial(defects, cost, finite, augment)

    def backtrack(state):
        count, length, accepted, trial = state
        length = jnp.where(accepted | (count == 0), length, length * s.backtracking)
        good, fresh = attempt(length)
        return count + 1, length, accepted | good, where(accepted, trial, fresh)

    none = jnp.zeros_like(usable)
    begin = (0, direction.longest, ~usable | it.solved, _Trial(it.defects, it.cost, none, none))
    _, length, accepted, trial = jax.lax.while_loop(
        lambda state: (state[0] < s.trials) & jnp.any(~state[2]), backtrack, begin
    )
    accepted = accepted & usable
    rejections = jnp.where(accepted, 0, it.rejections + usable)
    forced = usable & ~accepted & (rejections >= 4) & trial.finite
    add = accepted & trial.augment
    return Search(
        length=length,
        taken=accepted | forced,
        forced=forced,
        defects=trial.defects,
        cost=trial.cost,
        filter=jnp.where(forced, jnp.inf, compared.with_entry(add, it.filtered)),
        filtered=jnp.where(forced, 0, it.filtered + add),
        rejections=jnp.where(forced, 0, rejections),
    )
