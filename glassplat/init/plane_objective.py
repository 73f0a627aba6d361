"""What tells for and against a plane: edges, outline, points, frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glassplat.init.annotation import PaneView
from glassplat.init.consistency import UNKNOWN_WEIGHT
from glassplat.init.edges import edge_matches
from glassplat.init.plane_moves import pane_centers
from glassplat.init.ransac import FramedPlanes, PlaneEquations, support

Array = NDArray[np.float64]

COARSE, MIDDLE, FINE = 0.01, 0.004, 0.002
"""Distances, in image diagonals, at which the loss of two mask edges that do not meet is one half."""
POINTS_WEIGHT = 0.1
"""Weight of the points on a plane against the mask edges: they decide what the edges leave open."""
OUTLINE_WEIGHT, OUTLINE_TOLERANCE = 0.1, 0.2
"""Weight of a rectangular outline against the mask edges, and the sine at which its loss is one half."""
USUAL_FRAME, FRAME_WEIGHT = 0.02, 0.01
"""Height of a frame over its glass that is not unlikely, scene extents, and the weight of that against the edges."""
EDGES = 600
"""Edge points that are followed, in all views together."""


@dataclass(frozen=True)
class Terms:
    """Residuals of H planes under the Geman-McClure loss.

    Attributes:
        residuals: [H, M] in units of their tolerances.
        weights: [H, M] of their losses.
        rest: [H] the part of the cost that has no residual.
    """

    residuals: Array
    weights: Array
    rest: Array

    @property
    def cost(self) -> Array:
        """[H] weighted sum of the losses r^2 / (1 + r^2)."""
        squared = self.residuals**2
        return self.rest + (self.weights * squared / (1 + squared)).sum(axis=1)


@dataclass(frozen=True)
class Objective:
    """Everything known about one pane.

    Attributes:
        views: annotated views of the pane, at least two.
        points: [N, 3] points along its edge; there may be none.
        extent: radius of the capture in world units.
        distance: of a point from its plane at which its loss is one half, world units.
    """

    views: Sequence[PaneView]
    points: Array
    extent: float
    distance: float

    def support(self, planes: PlaneEquations) -> Array:
        """[H] share of the points near each plane; 0 where there are no points."""
        if not len(self.points):
            return np.zeros(len(planes))
        return support(planes, self.points, distance=self.distance)

    def anchors(self, planes: PlaneEquations) -> Array:
        """[H, 3] a point near the middle of the pane on each plane."""
        return pane_centers(planes, self.views)

    def reach(self, planes: PlaneEquations) -> Array:
        """[H] median distance of the cameras from the middle of the pane."""
        eyes = np.stack([view.center for view in self.views])
        away: Array = np.median(np.linalg.norm(self.anchors(planes)[:, None] - eyes, axis=2), axis=1)
        return away

    def terms(self, planes: FramedPlanes, tolerance: float, *, edges: int = EDGES) -> Terms:
        """The residuals of H planes.

        Args:
            planes: hypotheses.
            tolerance: distance of mask edges at which the loss is one half, in image diagonals; at least a pixel is
                taken, because a mask drawn in pixels says no more than that.
            edges: number of edge points in all views together.
        """
        tolerance = max(tolerance, *(1 / view.diagonal for view in self.views))
        matches = edge_matches(planes.planes, self.views, edges_per_view=max(edges // len(self.views), 1))
        hypotheses = len(planes)
        known = matches.compared.sum(axis=(0, 2))
        unknown = UNKNOWN_WEIGHT * (matches.turns.shape[1] * (len(self.views) - 1) - known)
        each = 1 / np.maximum(known + unknown, 1)
        met = matches.residuals(planes.frames, tolerance).swapaxes(0, 1).reshape(hypotheses, -1)
        away = planes.planes.distances(self.points) / self.distance
        frames = planes.frames[:, None] / (USUAL_FRAME * self.extent)
        residuals = (met, matches.turns / OUTLINE_TOLERANCE, away, frames)
        of_turns, of_points = OUTLINE_WEIGHT / matches.turns.shape[1], POINTS_WEIGHT / max(len(self.points), 1)
        weights = (each, of_turns, of_points, FRAME_WEIGHT)
        spread = [
            np.broadcast_to(np.reshape(weight, (-1, 1)), block.shape)
            for weight, block in zip(weights, residuals, strict=True)
        ]
        return Terms(np.concatenate(residuals, axis=1), np.concatenate(spread, axis=1), unknown * each)
