"""Matches joined into tracks, each a point in space: a real one, or one that is seen in a mirror."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glassplat.suggest.matching import Observations, Pairs

Array = NDArray[np.float64]

MOST_OFF = 0.005
"""Of an observation from its point, in image diagonals."""
LEAST_ANGLE = np.radians(1.5)
"""Between two sight lines on a point; with less its distance is a guess."""


@dataclass(frozen=True)
class Tracks:
    """Points that were triangulated.

    Attributes:
        points: [T, 3] in the world.
        track: [O] number of the point that an observation shows; -1 for none.
    """

    points: Array
    track: NDArray[np.int64]


def triangulated(seen: Observations, direct: Pairs) -> Tracks:
    """The points that matches lead to, each seen in two views or more.

    Args:
        seen: all observations.
        direct: [D, 2] pairs of observations of one place.
    """
    track = np.full(len(seen.view), -1, dtype=np.int64)
    points: list[Array] = []
    for members in _joined(seen.view, direct):
        found = _point(seen, members)
        if found is not None:
            point, kept = found
            track[kept] = len(points)
            points.append(point)
    return Tracks(np.array(points).reshape(-1, 3), track)


def _joined(view: NDArray[np.int64], pairs: Pairs) -> list[NDArray[np.int64]]:
    """Observations joined by pairs; what would put two of one view together is left out."""
    parent: dict[int, int] = {}
    groups: dict[int, dict[int, int]] = {}

    def root(one: int) -> int:
        while parent[one] != one:
            parent[one] = parent[parent[one]]
            one = parent[one]
        return one

    for one, other in pairs.tolist():
        for each in (one, other):
            if each not in parent:
                parent[each], groups[each] = each, {int(view[each]): each}
        large, small = root(one), root(other)
        if large == small or groups[large].keys() & groups[small].keys():
            continue
        if len(groups[large]) < len(groups[small]):
            large, small = small, large
        groups[large].update(groups.pop(small))
        parent[small] = large
    return [np.array(list(group.values())) for group in groups.values() if len(group) > 1]


def _point(seen: Observations, members: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]] | None:
    """The point nearest to the sight lines, and those observations that agree on one; None where there is none."""
    while len(members) > 1:
        point = nearest_point(seen.centers_of(members), seen.rays[members])
        away = seen.distances(np.broadcast_to(point, (len(members), 3)), members)
        if away.max() < MOST_OFF * seen.diagonal:
            rays = seen.rays[members]
            return (point, members) if (rays @ rays.T).min() < np.cos(LEAST_ANGLE) else None
        members = np.delete(members, away.argmax())
    return None


def nearest_point(centers: Array, rays: Array) -> Array:
    """[3] the point nearest to lines through centers [V, 3] along unit rays [V, 3]."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    return np.asarray(np.linalg.solve(across.sum(axis=0) + 1e-12 * np.eye(3), np.einsum("vij,vj->i", across, centers)))
