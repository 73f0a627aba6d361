"""Do the masks of several views agree about a plane, and on which plane do they agree best?

A plane maps every pixel of one view to a pixel of another. On the pane's own plane the mask of the
first view lands on the mask of the second; on any other plane parallax pulls them apart. Outside of
an image nothing is known, so that a mask which leaves its image is no contradiction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from glassplat.init.annotation import PaneView
from glassplat.init.ransac import PlaneEquations

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

EDGE_TOLERANCES = (0.01, 0.004, 0.002)
"""Distances, in image diagonals, beyond which two edges are no longer taken for the same; from coarse to fine."""
POINTS_WEIGHT = 0.02
"""Weight of the inliers against the mask edges: they decide only what the edges leave open."""
UNKNOWN_WEIGHT = 0.05
"""Weight of what leaves the other image, against planes on which hardly anything can be compared."""


def meet(planes: PlaneEquations, origin: Array, directions: Array) -> tuple[Array, Mask]:
    """Points [H, P, 3] where rays meet planes, and whether that is in front of their origin.

    Args:
        planes: H planes.
        origin: [3] where all rays start.
        directions: [P, 3] their directions.
    """
    slope = planes.normals @ directions.T
    height = planes.offsets - planes.normals @ origin
    along = height[:, None] / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
    hit = along > 0
    return origin + np.where(hit, along, 0)[..., None] * directions, hit


def mask_agreement(planes: PlaneEquations, views: Sequence[PaneView], *, pixels_per_view: int = 400) -> Array:
    """[H] how well the masks agree on each plane: intersection over union, pooled over pairs of views.

    Args:
        planes: hypotheses.
        views: annotated views of one pane, at least two.
        pixels_per_view: number of rays that are followed from each view.
    """
    both, either, unknown = np.zeros(len(planes)), np.zeros(len(planes)), np.zeros(len(planes))
    for source in views:
        pixels = source.grid(pixels_per_view)
        on_pane = source.covers(pixels, np.ones(len(pixels), dtype=bool))
        points, hit = meet(planes, source.center, source.directions(pixels))
        # A plane behind the camera cannot hold a pane that the camera sees.
        either += (on_pane & ~hit).sum(axis=1) * (len(views) - 1)
        for target in views:
            if target is not source:
                landed, held = target.project(points)
                held &= hit
                covered = target.covers(landed, held)
                both += (covered & on_pane).sum(axis=1)
                either += (held & (covered | on_pane)).sum(axis=1)
                unknown += (hit & on_pane & ~held).sum(axis=1)
    return both / np.maximum(either + UNKNOWN_WEIGHT * unknown, 1)


def edge_distances(plane: PlaneEquations, views: Sequence[PaneView], *, edges_per_view: int) -> Array:
    """[R] how far, in image diagonals, the mask edge of each view lands from the edge in each other view.

    Signed, positive where it lands on the pane; 0 for edge points that land outside of an image.
    """
    points, hits, sources = [], [], []
    for number, source in enumerate(views):
        edge = source.edge[:: max(len(source.edge) // edges_per_view, 1)]
        found, hit = meet(plane, source.center, source.directions(edge))
        points.append(found[0])
        hits.append(hit[0])
        sources.append(np.full(len(edge), number))
    world, known, source_of = np.concatenate(points), np.concatenate(hits), np.concatenate(sources)

    distances = np.zeros((len(views), len(world)))
    for number, target in enumerate(views):
        landed, held = target.project(world)
        held &= known & (source_of != number)
        distances[number, held] = target.edge_distance(landed[held]) / target.diagonal
    return distances[source_of != np.arange(len(views))[:, None]]


@dataclass(frozen=True)
class RefinedPlane:
    """A plane on which mask edges coincide.

    Attributes:
        plane: one plane.
        cost: mean loss of edges and inliers, in [0, 1]; comparable between planes of the same views.
    """

    plane: PlaneEquations
    cost: float


def refined_plane(
    plane: PlaneEquations,
    views: Sequence[PaneView],
    inliers: Array,
    *,
    extent: float,
    distance: float,
    edges_per_view: int = 100,
) -> RefinedPlane:
    """The plane near `plane` on which the mask edges of all views coincide best.

    Tilt and offset minimise the distances between edges under the Geman-McClure loss r^2 / (1 + r^2),
    at ever finer tolerance. That loss ignores what is far off, and it must: where something stands
    before the pane, a post or a plant, the mask's edge is not the pane's and matches no other view.

    Args:
        plane: one plane to start from.
        views: annotated views of the pane.
        inliers: [N, 3] points on the plane, at least one.
        extent: radius of the capture in world units.
        distance: inlier distance in world units.
        edges_per_view: number of edge points followed from each view.
    """
    normal = plane.normals[0]
    tangents = np.linalg.svd(normal[None])[2][1:]
    centroid = inliers.mean(axis=0)
    anchor = centroid - plane.distances(centroid[None])[0, 0] * normal

    def moved(parameters: Array) -> PlaneEquations:
        tilted = normal + parameters[:2] @ tangents
        tilted = tilted / np.linalg.norm(tilted)
        return PlaneEquations(tilted[None], np.array([tilted @ anchor + parameters[2] * extent]))

    def residuals(parameters: Array, tolerance: float) -> Array:
        candidate = moved(parameters)
        edges = edge_distances(candidate, views, edges_per_view=edges_per_view) / tolerance
        points = candidate.distances(inliers)[0] / distance
        return np.concatenate([edges, np.sqrt(POINTS_WEIGHT * len(edges) / len(points)) * points])

    parameters, cost = np.zeros(3), 1.0
    for tolerance in EDGE_TOLERANCES:
        solution = least_squares(
            residuals, parameters, args=(tolerance,), loss=_geman_mcclure, x_scale=0.01, max_nfev=30
        )
        parameters, cost = solution.x, 2 * solution.cost / len(solution.fun)
    return RefinedPlane(moved(parameters), cost)


def _geman_mcclure(squared: Array) -> Array:
    """[3, R] loss of squared residuals, and its first and second derivative."""
    rest = 1 / (1 + squared)
    return np.stack([squared * rest, rest**2, -2 * rest**3])
