"""The smallest rectangle around points in a plane, by rotating calipers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rectangle:
    """A rectangle in the plane, longer side first.

    Attributes:
        center: [2] its middle.
        axis: [2] unit direction of its longer side; the other side is at +90 degrees.
        half_sizes: [2] half the length of the longer and of the shorter side.
    """

    center: Array
    axis: Array
    half_sizes: Array


def min_area_rectangle(points: Array) -> Rectangle:
    """The rectangle of least area that holds all points [P, 2].

    One of its sides lies along an edge of the convex hull (Freeman and Shapira, 1975), so it is
    enough to measure the hull along each of its edges.

    Raises:
        ValueError: the points do not span an area.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = points[ConvexHull(points).vertices]
    except (QhullError, ValueError) as error:
        raise ValueError(f"{len(points)} points do not span an area; expected at least three off one line") from error
    edges = np.roll(hull, -1, axis=0) - hull
    along = edges / np.linalg.norm(edges, axis=1, keepdims=True)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    extents = np.stack([hull @ along.T, hull @ across.T])  # [2, P, E]
    low, high = extents.min(axis=1), extents.max(axis=1)
    best = int(np.argmin(np.prod(high - low, axis=0)))

    middle, half = (high + low)[:, best] / 2, (high - low)[:, best] / 2
    center = middle[0] * along[best] + middle[1] * across[best]
    if half[0] >= half[1]:
        return Rectangle(center, along[best], half)
    return Rectangle(center, across[best], half[::-1])
