"""The search for a pane's plane: hypotheses from points, judged and refined by the masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from glassplat.init.annotation import PaneView
from glassplat.init.consistency import edge_cost, edge_distances, geman_mcclure, mask_agreement
from glassplat.init.ransac import PlaneEquations, random_planes, support

Array = NDArray[np.float64]

COARSE, MIDDLE, FINE = 0.01, 0.004, 0.002
"""Distances, in image diagonals, at which the loss of two mask edges that do not meet is one half."""
POINTS_WEIGHT = 0.1
"""Weight of the inliers against the mask edges: they decide only what the edges leave open."""
SUPPORT_WEIGHT = 0.1
"""Weight of a hypothesis' inliers against the agreement of the masks: it decides where parallax is too small to."""
NEARBY_TILT, NEARBY_SHIFT, NEARBY_COUNT = 0.03, 0.01, 500
"""Spread (radians, scene extents) and number of the planes that are tried around the best hypothesis."""


@dataclass(frozen=True)
class Search:
    """Size of a plane search.

    Attributes:
        extent: radius of the capture in world units.
        distance: inlier distance in world units.
        hypotheses: number of planes drawn through triplets of points.
        refined: number of the best of them that are refined.
    """

    extent: float
    distance: float
    hypotheses: int = 1000
    refined: int = 4


def best_plane(
    points: Array, weights: Array, views: Sequence[PaneView], search: Search, rng: np.random.Generator
) -> PlaneEquations:
    """The plane on which the masks of all views coincide best.

    RANSAC draws hypotheses; the agreement of the masks ranks those with the most inliers; the
    leading ones are refined. At fine tolerance the loss has many local minima where posts or plants
    hide parts of the pane, so planes all around the best one are tried as well.

    Args:
        points: [N, 3] candidates, at least three.
        weights: [N] positive weights.
        views: annotated views of the pane, at least two.
        search: how far to go.
        rng: source of randomness.

    Raises:
        ValueError: the candidates span no plane.
    """
    drawn = random_planes(points, weights, search.hypotheses, rng)
    if len(drawn) == 0:
        raise ValueError(f"its {len(points)} candidate points lie on one line")
    supports = support(drawn, points, weights, distance=search.distance)
    supported = np.argsort(-supports, kind="stable")[: max(search.hypotheses // 4, search.refined)]
    scores = mask_agreement(drawn.select(supported), views) + SUPPORT_WEIGHT * supports[supported]
    leading = drawn.select(supported[np.argsort(-scores, kind="stable")[: search.refined]])
    start = _best_refined(leading, points, views, search, tolerances=(COARSE, MIDDLE))

    anchor = _inliers(start, points, search.distance).mean(axis=0)
    finest = 1 / min(view.diagonal for view in views)  # A mask drawn in pixels says no more than that.
    shift = NEARBY_SHIFT * search.extent
    around = planes_nearby(start, anchor, NEARBY_COUNT, tilt=NEARBY_TILT, shift=shift, rng=rng)
    costs = edge_cost(around, views, tolerance=max(MIDDLE, finest))
    leading = around.select(np.argsort(costs, kind="stable")[: search.refined])
    return _best_refined(leading, points, views, search, tolerances=(max(MIDDLE, finest), max(FINE, finest)))


def _best_refined(
    planes: PlaneEquations, points: Array, views: Sequence[PaneView], search: Search, *, tolerances: Sequence[float]
) -> PlaneEquations:
    """The one plane, of all given ones after refinement, on which the mask edges coincide best."""
    refined = []
    for number in range(len(planes)):
        plane = planes.select(np.array([number]))
        refined.append(refined_plane(plane, views, _inliers(plane, points, search.distance), search, tolerances))
    candidates = PlaneEquations(
        np.concatenate([plane.normals for plane in refined]), np.concatenate([plane.offsets for plane in refined])
    )
    best = np.argmin(edge_cost(candidates, views, tolerance=tolerances[-1]))
    return candidates.select(np.array([best]))


def _inliers(plane: PlaneEquations, points: Array, distance: float) -> Array:
    """[M, 3] the points within `distance` of one plane; the nearest three where there are fewer."""
    away = np.abs(plane.distances(points)[0])
    return points[away <= max(distance, np.partition(away, 2)[2])]


def refined_plane(
    plane: PlaneEquations, views: Sequence[PaneView], inliers: Array, search: Search, tolerances: Sequence[float]
) -> PlaneEquations:
    """The plane near `plane` on which the mask edges of all views coincide best.

    Tilt and offset minimise the distances between edges under the Geman-McClure loss, at ever finer
    tolerance. That loss ignores what is far off, and it must: where something stands before the
    pane, the mask's edge is not the pane's and matches no other view.

    Args:
        plane: one plane to start from.
        views: annotated views of the pane.
        inliers: [N, 3] points on the plane, at least one.
        search: scale of the scene.
        tolerances: distances at which the loss is one half, in image diagonals.
    """
    anchor = inliers.mean(axis=0)

    def residuals(parameters: Array, tolerance: float) -> Array:
        moved = _moved(plane, anchor, parameters[None] * [1, 1, search.extent])
        edges = edge_distances(moved, views, edges_per_view=100)[0].ravel() / tolerance
        points = moved.distances(inliers)[0] / search.distance
        return np.concatenate([edges, np.sqrt(POINTS_WEIGHT * len(edges) / len(points)) * points])

    parameters = np.zeros(3)
    for tolerance in tolerances:
        parameters = least_squares(
            residuals, parameters, args=(tolerance,), loss=geman_mcclure, x_scale=0.01, max_nfev=30
        ).x
    return _moved(plane, anchor, parameters[None] * [1, 1, search.extent])


def planes_nearby(
    plane: PlaneEquations, anchor: Array, count: int, *, tilt: float, shift: float, rng: np.random.Generator
) -> PlaneEquations:
    """One plane and `count` random ones around it.

    Args:
        plane: one plane.
        anchor: [3] point about which the tilts turn.
        count: number of further planes.
        tilt: standard deviation of the two tilts, radians.
        shift: standard deviation of the shift along the normal, world units.
        rng: source of randomness.
    """
    steps = rng.standard_normal((count, 3)) * [tilt, tilt, shift]
    return _moved(plane, anchor, np.vstack([np.zeros(3), steps]))


def _moved(plane: PlaneEquations, anchor: Array, steps: Array) -> PlaneEquations:
    """One plane after each of [H, 3] small moves: two tilts about the point nearest to `anchor`, and a shift."""
    normal = plane.normals[0]
    tangents = np.linalg.svd(normal[None])[2][1:]
    foot = anchor - plane.distances(anchor[None])[0] * normal
    normals = normal + steps[:, :2] @ tangents
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return PlaneEquations(normals, normals @ foot + steps[:, 2])
