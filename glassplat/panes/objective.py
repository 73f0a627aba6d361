"""The objective of a pane's plane: how well edges, outline, points and frame fit it.

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

from glassplat.kernels.plane_search import Edges, follow_edges
from glassplat.panes.masks import (
    UNKNOWN_WEIGHT,
    FramedPlanes,
    PaneView,
    PlaneEquations,
    Rectangle,
    cameras_of,
    in_plane_axes,
    mask_agreement,
    meet,
    min_area_rectangle,
    support,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNEVEN_FRAME = 0.15
"""By how much the height of a frame may differ from place to place, as a share of it."""


@dataclass(frozen=True)
class EdgeMatches:
    """Mask edges of V views, followed over H planes into each other.

    Attributes:
        distances: [H, V, P] how far edge point p lands from the edge in view v, in image diagonals, positive on the
            pane; scaled so that a doubt of one pixel in both views counts alike on every plane and in every pair.
        shifts: [H, V, P] the part of that distance which a frame hides, per world unit of its height.
        compared: [H, V, P] whether there is anything to compare: the edge point lands inside of the image of another
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
        """[H, V, P] distances that frames [H] of some height leave unexplained, in units of the tolerance."""
        hidden = frames[:, None, None] * self.shifts
        # A frame is not equally high all round.
        return (self.distances - hidden) / np.sqrt(tolerance**2 + (UNEVEN_FRAME * hidden) ** 2)


def edge_matches(planes: PlaneEquations, views: Sequence[PaneView], *, edges_per_view: int) -> EdgeMatches:
    """Follows the mask edge of each view to each other view.

    Args:
        planes: H hypotheses.
        views: V annotated views of one pane.
        edges_per_view: number of edge points followed from each view.
    """
    thinned = [slice(None, None, max(len(view.edge) // edges_per_view, 1)) for view in views]
    points = [view.edge[chosen] for view, chosen in zip(views, thinned, strict=True)]
    across = [view.outward[chosen] for view, chosen in zip(views, thinned, strict=True)]
    edges = Edges(
        np.repeat(np.arange(len(views)), [len(found) for found in points]),
        np.concatenate([view.directions(found) for view, found in zip(views, points, strict=True)]),
        np.concatenate([view.sight_limits(*found) for view, *found in zip(views, points, across, strict=True)]),
    )
    found = follow_edges(planes.normals, planes.offsets, cameras_of(views), edges, [view.distance for view in views])
    return EdgeMatches(found.distances, found.shifts, found.compared, _turns(planes, found.outward), edges.sources)


def _turns(planes: PlaneEquations, outward: Array) -> Array:
    """[H, P] sine of twice the angle between directions in the plane and the nearest side of the pane.

    Its sign is that against the side across which most edges lie, whatever axes the plane has: with another sign after
    a small move there would be no slope to follow.
    """
    if not outward.shape[1]:
        return np.zeros(outward.shape[:2])
    first, second = in_plane_axes(planes)
    along, across = np.einsum("hpd,hd->hp", outward, first), np.einsum("hpd,hd->hp", outward, second)
    twofold = (along + 1j * across) ** 2
    sides = np.exp(-0.5j * np.angle((twofold**2).mean(axis=1)))
    sides *= np.where((twofold.mean(axis=1) * sides).real < 0, -1, 1)
    turned: Array = (twofold * sides[:, None]).imag
    return turned


NEAREST, FARTHEST = 0.05, 20.0
"""Depths between which panes are looked for, in units of the distance between the annotated cameras."""
MOST_OBLIQUE = 0.1
"""Cosine between a pane's normal and a ray through its mask below which no plane is drawn."""


def planes_through_masks(views: Sequence[PaneView], count: int, rng: np.random.Generator) -> PlaneEquations:
    """`count` random planes, each through a pixel of a mask and facing that camera.

    Depths are uniform in their logarithm, normals uniform on the half sphere.

    Args:
        views: annotated views of the pane, at least two from different places.
        count: number of planes.
        rng: source of randomness.
    """
    centers = np.stack([view.center for view in views])
    apart = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean())
    depths = apart * np.exp(rng.uniform(np.log(NEAREST), np.log(FARTHEST), count))
    source = rng.integers(len(views), size=count)
    rays = np.empty((count, 3))
    for number, view in enumerate(views):
        row, column = np.nonzero(view.mask)
        pick = rng.integers(len(row), size=int((source == number).sum()))
        pixels = np.stack([column[pick], row[pick]], axis=1).astype(np.float64) + 0.5
        rays[source == number] = view.directions(pixels)
    normals = rng.standard_normal((count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    towards = -np.einsum("hd,hd->h", normals, rays) / np.linalg.norm(rays, axis=1)
    normals *= np.where(towards < 0, -1, 1)[:, None]
    usable = np.abs(towards) > MOST_OBLIQUE
    points = centers[source] + depths[:, None] * rays
    return PlaneEquations(normals[usable], np.einsum("hd,hd->h", normals, points)[usable])


def pane_centers(planes: PlaneEquations, views: Sequence[PaneView]) -> Array:
    """[H, 3] a point near the middle of the pane on each plane, from the middles of the masks."""
    found, seen = np.zeros((len(planes), 3)), np.zeros(len(planes))
    for view in views:
        points, hit = meet(planes, view.center, view.directions(view.middle))
        # A view that hardly sees the plane puts its middle far away.
        rays = points[:, 0] - view.center
        squared = np.maximum(np.einsum("hd,hd->h", rays, rays), np.finfo(np.float64).tiny)
        weights = np.where(hit[:, 0], 1 / squared, 0)
        found += weights[:, None] * points[:, 0]
        seen += weights
    return found / np.maximum(seen, np.finfo(np.float64).tiny)[:, None]


def planes_nearby(
    planes: PlaneEquations, anchors: Array, count: int, *, tilt: float, shift: Array | float, rng: np.random.Generator
) -> PlaneEquations:
    """[H * (1 + count)] each plane followed by `count` random ones around it.

    Args:
        planes: H planes.
        anchors: [H, 3] points about which the tilts turn.
        count: number of further planes for each.
        tilt: standard deviation of the two tilts, radians.
        shift: [H] or one standard deviation of the shift along the normal, world units.
        rng: source of randomness.
    """
    steps = rng.standard_normal((len(planes), 1 + count, 3)) * [tilt, tilt, 1]
    steps[..., 2] *= np.broadcast_to(shift, len(planes))[:, None]
    steps[:, 0] = 0
    index = np.repeat(np.arange(len(planes)), 1 + count)
    return move_planes(planes.select(index), anchors[index], steps.reshape(-1, 3))


def move_planes(planes: PlaneEquations, anchors: Array, steps: Array) -> PlaneEquations:
    """Each plane after a small move [H, 3]: two tilts about the point nearest to its anchor [H, 3], and a shift."""
    normals, (first, second) = planes.normals, in_plane_axes(planes)
    heights = np.einsum("hd,hd->h", normals, anchors) - planes.offsets
    feet = anchors - heights[:, None] * normals
    tilted = normals + steps[:, :1] * first + steps[:, 1:2] * second
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    return PlaneEquations(tilted, np.einsum("hd,hd->h", tilted, feet) + steps[:, 2])


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
WHOLE_PARTS = 4
"""Panes in one plane that have so many each; more of them share as many."""
PIXELS = 600
"""Pixels whose rays are followed to compare masks, in all views together."""


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

    def agreement(self, planes: PlaneEquations) -> Array:
        """[H] how well the masks agree on each plane."""
        return mask_agreement(planes, self.views, pixels_per_view=max(PIXELS // len(self.views), 1))

    def anchors(self, planes: PlaneEquations) -> Array:
        """[H, 3] a point near the middle of the pane on each plane."""
        return pane_centers(planes, self.views)

    def reach(self, planes: PlaneEquations) -> Array:
        """[H] median distance of the cameras from the middle of the pane."""
        centers = np.stack([view.center for view in self.views])
        away: Array = np.median(np.linalg.norm(self.anchors(planes)[:, None] - centers, axis=2), axis=1)
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
        known = matches.compared.sum(axis=(1, 2))
        unknown = UNKNOWN_WEIGHT * (matches.turns.shape[1] * (len(self.views) - 1) - known)
        each = 1 / np.maximum(known + unknown, 1)
        met = matches.residuals(planes.frames, tolerance).reshape(hypotheses, -1)
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


@dataclass(frozen=True)
class JointObjective:
    """Everything known about several panes in one plane, behind frames of one height; each pane counts alike.

    Attributes:
        parts: what is known about each pane, at least one.
    """

    parts: Sequence[Objective]

    @property
    def extent(self) -> float:
        """Radius of the capture in world units."""
        return self.parts[0].extent

    def agreement(self, planes: PlaneEquations) -> Array:
        """[H] how well the masks agree on each plane, in the mean over the panes."""
        return self._mean([part.agreement(planes) for part in self.parts])

    def anchors(self, planes: PlaneEquations) -> Array:
        """[H, 3] a point near the middle of all panes on each plane."""
        return self._mean([part.anchors(planes) for part in self.parts])

    def reach(self, planes: PlaneEquations) -> Array:
        """[H] median distance of the cameras from the middle of a pane, in the mean over the panes."""
        return self._mean([part.reach(planes) for part in self.parts])

    def terms(self, planes: FramedPlanes, tolerance: float, *, edges: int = EDGES) -> Terms:
        """The residuals of H planes; as `Objective.terms`, with so many edge points for each pane, or fewer of many."""
        each = edges * min(len(self.parts), WHOLE_PARTS) // len(self.parts)
        terms = [part.terms(planes, tolerance, edges=each) for part in self.parts]
        return Terms(
            np.concatenate([term.residuals for term in terms], axis=1),
            np.concatenate([term.weights for term in terms], axis=1) / len(terms),
            self._mean([term.rest for term in terms]),
        )

    def _mean(self, values: Sequence[Array]) -> Array:
        mean: Array = np.mean(values, axis=0)
        return mean


OUTLINE_PIXELS = 4000  # Of the mask of each view, that are followed onto the plane.
CELLS = 128  # Along the longer side of the map of the plane.
GRAZING = 0.06  # Cosine to the normal below which a pixel covers too much of the plane to say where the pane ends.
SMALLEST_PART = 0.05  # Of the largest connected part; below it a part is an error in a mask.
AGREEMENT = 0.34  # Share of the views that must show the pane where they look; the others may be occluded.


def pane_rectangle(plane: PlaneEquations, views: Sequence[PaneView], axes: Array) -> Rectangle:
    """The smallest rectangle, on one plane, around everything that the masks call pane.

    Follows the masks' pixels to the plane instead of bounding the inliers of the plane fit, as the
    paper's Appendix A does: points on a frame are few, and a corner without any would be cut off.

    Args:
        plane: one plane.
        views: annotated views of the pane.
        axes: [2, 3] orthonormal directions in the plane, in which the rectangle is expressed;
            its origin is the point of the plane nearest to the world's.

    Raises:
        ValueError: no part of the plane is pane in enough views.
    """
    foot = plane.normals[0] * plane.offsets[0]
    seen = np.concatenate([_pixels_on_plane(plane, view) for view in views])
    seen = seen[_is_pane(seen, views, plane.normals[0])]
    if len(seen) < 3:
        raise ValueError(f"{len(seen)} mask pixels agree on where the pane is; expected at least three")
    corners = (seen - foot) @ axes.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    cell = (high - low).max() / CELLS
    u, v = (np.arange(a - cell, b + 2 * cell, cell) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    inside = _is_pane((foot + grid @ axes).reshape(-1, 3), views, plane.normals[0])
    return min_area_rectangle(grid[_without_specks(inside.reshape(grid.shape[:2]))])


def _pixels_on_plane(plane: PlaneEquations, view: PaneView) -> Array:
    """[P, 3] where the plane is seen through the pixels of a mask."""
    pixels = view.grid(OUTLINE_PIXELS)
    directions = view.directions(pixels[view.covers(pixels, np.ones(len(pixels), dtype=bool))])
    points, hit = meet(plane, view.center, directions)
    return points[0, hit[0]]


def _is_pane(points: Array, views: Sequence[PaneView], normal: Array) -> Mask:
    """[P] bool: whether enough of the views whose image holds a point [P, 3] of the plane show pane there."""
    shown, held_count = np.zeros(len(points)), np.zeros(len(points))
    for view in views:
        pixels, held = view.project(points)
        rays = points - view.center
        held &= np.abs(rays @ normal) > GRAZING * np.linalg.norm(rays, axis=1)
        held = view.tells(pixels, held)
        shown += view.covers(pixels, held)
        held_count += held
    return (shown > 0) & (shown >= AGREEMENT * held_count)


def _without_specks(inside: Mask) -> Mask:
    from scipy import ndimage

    parts, count = ndimage.label(inside)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    sizes[0] = 0
    return np.asarray((sizes >= max(SMALLEST_PART * sizes.max(), 1))[parts])
