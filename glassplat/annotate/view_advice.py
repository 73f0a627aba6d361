"""Which photograph to mark next."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from numpy.typing import NDArray

from glassplat.annotate.outline import filled
from glassplat.annotate.pane_fit import PaneFit, corner_information, tilt_deviation
from glassplat.scene.eye import Eye

Array = NDArray[np.float64]

WANTED_ANGLE = np.radians(25)
"""Between the sight lines of two photographs on a pane, from which on more adds little, and corners look different."""
MARGIN = 0.1
LEAST_CORNERS = 3
OFFERED = 3


def settling_views(fit: PaneFit, eyes: Sequence[Eye], marked: Collection[int]) -> list[tuple[int, float]]:
    """Views that would make a plane surest if their corners were marked, with the doubt in degrees after that."""
    corners = fit.shape.corners()
    found = []
    for number, eye in enumerate(eyes):
        if number in marked or eye.holds(corners, MARGIN).sum() < min(LEAST_CORNERS, len(corners)):
            continue
        found.append((number, tilt_deviation(fit.information + corner_information(eye, fit.shape))))
    return sorted(found, key=lambda pair: pair[1])[:OFFERED]


def second_views(outline: Array, view: int, eyes: Sequence[Eye], points: Array) -> list[int]:
    """Views that show what one view shows inside of an outline [K, 2], from another place; the best first.

    The measured points [P, 3] inside of the outline tell, wherever they lie.
    """
    eye = eyes[view]
    inside = filled(outline, (int(eye.size[0]), int(eye.size[1])))
    held = eye.holds(points)
    column, row = np.floor(eye.project(points[held])).astype(np.int64).T
    through = points[held][inside[row, column]]
    if not len(through):
        through = points[held] if held.any() else points
    if not len(through):
        return [number for number in range(len(eyes)) if number != view][:OFFERED]
    worth = {number: _worth(through, eye, other) for number, other in enumerate(eyes) if number != view}
    best = sorted(worth, key=lambda number: -worth[number])
    return [number for number in best if worth[number] > 0][:OFFERED]


def first_view(eyes: Sequence[Eye], points: Array) -> int:
    """The view that shows most of what was measured."""
    return int(np.argmax([eye.holds(points).sum() for eye in eyes])) if len(points) else 0


def _worth(points: Array, eye: Eye, other: Eye) -> float:
    """Share of the points that another view holds, times how different its sight of them is."""
    one, two = (points - camera.center for camera in (eye, other))
    cosine = (one * two).sum(1) / (np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1))
    angle = float(np.median(np.arccos(np.clip(cosine, -1, 1))))
    return float(other.holds(points).mean()) * min(angle, WANTED_ANGLE)
