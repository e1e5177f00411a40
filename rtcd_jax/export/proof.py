"""The funnel that an elite's certificate proves, as the exported monitors evaluate it."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np
from jaxtyping import Float

from rtcd_jax.certificate.check import Node, parse, read_claim, read_goal, read_interval
from rtcd_jax.certificate.prove.margins import center_offset
from rtcd_jax.system.errors import UserError


@final
@dataclass(frozen=True, eq=False)
class ProvedFunnel:
    """E(t) = {x*(t) + L(t) y : |y| <= 1} of a certificate.

    Piece i begins at `begins`[i], in knots, and L = sum_j `axes`[i, j] s^j there, with s from -1 to 1 until the next
    one begins. The last piece is the goal's region, for all time, or the ellipsoid at a catch. `rates` are x*' at both
    ends of every interval. Of a certificate about own motions these are the nominal robot's ellipsoids, and `offsets`
    [pieces] bounds the |y| of other robots' centers in them.
    """

    begins: Float[np.ndarray, " pieces"]
    axes: Float[np.ndarray, "pieces 4 n n"]
    rates: Float[np.ndarray, "intervals 2 n"]
    offsets: Float[np.ndarray, " pieces"]

    @classmethod
    def read(cls, path: Path) -> "ProvedFunnel":
        """Of a certificate that the checker accepts, its exact numbers rounded."""
        content = parse(path.read_bytes())
        claim = read_claim(Node("claim", content["claim"]))
        intervals = [read_interval(Node("funnel", interval), claim) for interval in content["funnel"]]
        begins, axes, offsets = [], [], []
        for interval in intervals:
            offsets.append(center_offset(claim, interval) if claim.shifts else 0.0)
            begins.append(float(interval.knot + interval.start))
            first, last, (bend_0, bend_1) = map(_floats, (interval.first, interval.last, interval.bend))
            axes.append([(first + last) / 2 + bend_0, (last - first) / 2 + bend_1, -bend_0, -bend_1])
        caught = claim.catch is not None
        last = _floats(intervals[-1].last if caught else read_goal(Node("goal", content["goal"]), claim).axes)
        begins.append(float(len(claim.u)))
        axes.append([last, 0 * last, 0 * last, 0 * last])
        return cls(np.array(begins), np.array(axes), _floats(claim.rates), np.array([*offsets, 0.0]))

    def of_all_robots(self) -> "ProvedFunnel":
        """The same with the ellipsoids about x* that lie in every robot's.

        Raises:
            UserError: somewhere there are none.
        """
        apart = np.flatnonzero(self.offsets >= 1)
        if apart.size:
            raise UserError(
                f"the certificate is about own motions, and on interval {int(self.begins[apart[0]])} no state near x* "
                "is in every robot's funnel: export with a certificate about x* (uncertainty.center: common)"
            )
        return replace(self, axes=self.axes * (1 - self.offsets)[:, None, None, None])

    def at(self, knots: float) -> Float[np.ndarray, "n n"] | None:
        """L at a time in knots; None before the proof begins."""
        piece = int(np.searchsorted(self.begins, knots, side="right")) - 1
        if piece < 0:
            return None
        if piece == len(self.begins) - 1:
            return self.axes[piece, 0]
        begin, end = self.begins[piece : piece + 2]
        s = (2 * knots - begin - end) / (end - begin)
        return np.einsum("j,jkl->kl", s ** np.arange(4), self.axes[piece])


def _floats(values: Any) -> np.ndarray:
    """Exact numbers, nested, as doubles."""
    return np.array(values, dtype=object).astype(float)
