"""The robots of the page: shapes from their MJCF, their bodies along the nominal motion and a disturbed one.

page.js draws them as SVG at the slider's time, from any side.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rtcd_jax.analysis.report.motion import boundary_motions
from rtcd_jax.analysis.report.reading import FunnelView
from rtcd_jax.analysis.report.traces import numbers
from rtcd_jax.plants import model_of

DIGITS = 4
"""Of lengths in meters, and of quaternions' entries."""


def robots_of(funnels: Sequence[FunnelView]) -> dict[str, Any]:
    """`view` and `reach` [m] that all have in common, and of every funnel its robot and two motions, `nominal` and
    `disturbed`: the one of those from the boundary of the first ellipsoid that uses most of the funnel.
    """
    from rtcd_jax.plants.drawing import parts_of, poses, view_of

    robots, view, reach = [], np.eye(3), 0.0
    for funnel in funnels:
        model, motions = model_of(funnel.elite.robot, funnel.elite.parameters), boundary_motions(funnel.elite)
        view, parts, moves = view_of(model), parts_of(model), []
        for number in (0, motions.widest):
            gaps = np.flatnonzero(~np.isfinite(motions.x[:, number]).all(axis=1))
            x = motions.x[: gaps[0] if gaps.size else None, number]
            places, turns = poses(model, x[:, : x.shape[1] // 2])
            frames = [_rounded(np.concatenate(pose, axis=1)) for pose in zip(places, turns, strict=True)]
            ratio = numbers(motions.ratio[: len(x), number])
            moves.append({"x": [numbers(row) for row in x], "ratio": ratio, "poses": frames})
            for part in parts:
                size = np.linalg.norm(part.points, axis=1).max() + part.radius
                reach = max(reach, float(np.linalg.norm(places[:, part.body], axis=1).max() + size))
        shapes = [part._asdict() | {"points": _rounded(part.points)} for part in parts]
        robots.append({
            "label": funnel.label, "color": funnel.color, "times": numbers(motions.time),
            "nominal": moves[0], "disturbed": moves[1], "parts": shapes,
        })  # fmt: skip
    return {"view": _rounded(view), "reach": reach, "robots": robots}


def _rounded(values: np.ndarray) -> list[Any]:
    return np.round(values, DIGITS).tolist()
