"""The funnel that an elite's certificate proves, as the exported monitors evaluate it."""

from dataclasses import dataclass
from typing import final

import numpy as np
from jaxtyping import Float


@final
@dataclass(frozen=True, eq=False)
class ProvedFunnel:
    """E(t) = {x*(t) + L(t) y : |y| <= 1} of a certificate; without pieces nothing is proved.

    Piece i begins at `begins`[i], in knots, and L = sum_j `axes`[i, j] s^j there, with s from -1 to 1 until the next
    one begins. The last piece is the goal's region, for all time. `claim` is the SHA-256 of the certificate's claim.
    """

    begins: Float[np.ndarray, " pieces"]
    axes: Float[np.ndarray, "pieces 4 n n"]
    claim: str = ""

    @classmethod
    def none(cls, n: int) -> "ProvedFunnel":
        """Where there is no certificate, of a robot with n states."""
        return cls(np.zeros(0), np.zeros((0, 4, n, n)))

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
