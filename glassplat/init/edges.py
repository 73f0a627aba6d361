"""How well the outlines of a pane's masks meet on a plane.

Where a plane is the pane's, the mask's edge in one view lands on the edge in every other. Two things disturb that, and
both are known from the geometry:

- A frame stands out from the glass by some height. To a camera inside of the pane's outline the edge is where the
  glass meets the frame, which is on the plane. A camera that looks in from beyond an edge sees the glass end at the top
  of the frame instead. For a camera h above the plane and a beyond the edge's line, a frame of height d hides d a / h.
- A pixel covers more of the plane in a view from far away or at a grazing angle, and its edge is that much less exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glassplat.init.annotation import PaneView
from glassplat.init.consistency import meet
from glassplat.init.ransac import PlaneEquations, in_plane_axes

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNEVEN_FRAME = 0.15
"""By how much the height of a frame may differ from place to place, as a share of it."""
STEEPEST = 8.0
"""Largest a / h that is told apart: farther out a camera looks along the pane."""


@dataclass(frozen=True)
class EdgeMatches:
    """Mask edges of V views, followed over H planes into each other.

    Attributes:
        distances: [V, H, P] how far edge point p lands from the edge in view v, in image diagonals, positive on the
            pane; scaled so that a doubt of one pixel in both views counts alike on every plane and in every pair.
        shifts: [V, H, P] the part of that distance which a frame hides, per world unit of its height.
        compared: [V, H, P] whether there is anything to compare: the edge point lands inside of the image of another
            view. The distance is 0 where there is not.
        turns: [H, P] by how much the edge at point p is turned against the pane's sides, if it is a rectangle:
            the sine of twice the angle.
        sources: [P] the view whose mask's edge point p lies on.
    """

    distances: Array
    shifts: Array
    compared: Mask
    turns: Array
    sources: NDArray[np.int64]

    def residuals(self, frames: Array, tolerance: float) -> Array:
        """[V, H, P] distances that frames [H] of some height leave unexplained, in units of the tolerance."""
        hidden = frames[:, None] * self.shifts
        # A frame is not equally high all round.
        return (self.distances - hidden) / np.hypot(tolerance, UNEVEN_FRAME * hidden)


def edge_matches(planes: PlaneEquations, views: Sequence[PaneView], *, edges_per_view: int) -> EdgeMatches:
    """Follows the mask edge of each view to each other view.

    Args:
        planes: H hypotheses.
        views: V annotated views of one pane.
        edges_per_view: number of edge points followed from each view.
    """
    points, outward, hits, source_of = _edges_on(planes, views, edges_per_view)
    sizes, hidden = np.zeros((len(views), *hits.shape)), np.zeros((len(views), *hits.shape))
    for number, view in enumerate(views):
        sizes[number], hidden[number] = _pixel_and_frame(planes, view, points, outward)
    column = np.arange(len(source_of))
    own_size, own_hidden = sizes[source_of, :, column].T, hidden[source_of, :, column].T

    distances, compared = np.zeros_like(sizes), np.zeros(sizes.shape, dtype=bool)
    for number, target in enumerate(views):
        landed, held = target.project(points)
        compared[number] = held & hits & (source_of != number)
        distances[number, compared[number]] = target.edge_distance(landed[compared[number]]) / target.diagonal
    doubt = np.sqrt((1 + (own_size / sizes) ** 2) / 2)
    diagonals = np.array([view.diagonal for view in views])[:, None, None]
    shifts = np.where(compared, (own_hidden - hidden) / (sizes * diagonals * doubt), 0)
    return EdgeMatches(distances / doubt, shifts, compared, _turns(planes, outward), source_of)


def _turns(planes: PlaneEquations, outward: Array) -> Array:
    """[H, P] sine of twice the angle between directions in the plane and the nearest side of the pane.

    Its sign is that against the side across which most edges lie, whatever axes the plane has: with another sign after
    a small move there would be no slope to follow.
    """
    first, second = in_plane_axes(planes)
    along, across = np.einsum("hpd,hd->hp", outward, first), np.einsum("hpd,hd->hp", outward, second)
    twofold = (along + 1j * across) ** 2
    sides = np.exp(-0.5j * np.angle((twofold**2).mean(axis=1)))
    sides *= np.where((twofold.mean(axis=1) * sides).real < 0, -1, 1)
    turned: Array = (twofold * sides[:, None]).imag
    return turned


def _edges_on(
    planes: PlaneEquations, views: Sequence[PaneView], edges_per_view: int
) -> tuple[Array, Array, Mask, NDArray[np.int64]]:
    """Edge points on the planes [H, P, 3], unit directions off the pane [H, P, 3], hits [H, P], their views [P]."""
    points, outward, hits, sources = [], [], [], []
    for number, source in enumerate(views):
        chosen = slice(None, None, max(len(source.edge) // edges_per_view, 1))
        found, hit = meet(planes, source.center, source.directions(source.edge[chosen]))
        limits = source.sight_limits(source.edge[chosen], source.outward[chosen])
        along = planes.normals @ limits.T
        across = limits - along[..., None] * planes.normals[:, None]
        points.append(found)
        hits.append(hit)
        outward.append(across / np.maximum(np.linalg.norm(across, axis=2, keepdims=True), 1e-9))
        sources.append(np.full(found.shape[1], number))
    return (
        np.concatenate(points, axis=1),
        np.concatenate(outward, axis=1),
        np.concatenate(hits, axis=1),
        np.concatenate(sources),
    )


def _pixel_and_frame(planes: PlaneEquations, view: PaneView, points: Array, outward: Array) -> tuple[Array, Array]:
    """What a pixel of a view covers of the plane across an edge, and what a frame of height one hides; [H, P] each."""
    height = np.abs(planes.normals @ view.center - planes.offsets)[:, None]
    height = np.maximum(height, np.finfo(np.float64).tiny)
    beyond = np.einsum("hpd,hpd->hp", view.center - points, outward)
    depth = np.abs((points - view.center) @ view.cam_from_world[2, :3])
    pixel = depth * np.hypot(1, beyond / height) / np.sqrt(view.intrinsics[0] * view.intrinsics[1])
    return np.maximum(pixel, np.finfo(np.float64).tiny), np.clip(beyond / height, 0, STEEPEST)
