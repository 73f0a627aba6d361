"""The objective for a pane's plane: the fit of edges, outline, points and frame.

On the pane's own plane, the mask's edge in one view lands on the edge in every other. Two effects disturb this, and
both follow from the geometry:

- A frame protrudes from the glass by some height. For a camera within the pane's outline, the edge is where the glass
  meets the frame, which is on the plane. A camera beyond an edge sees the glass end at the top of the frame instead.
  For a camera at height h above the plane and distance a beyond the edge's line, a frame of height d hides d a / h.
- A pixel covers more of the plane in a view from far away or at a grazing angle, so its edge is less accurate there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from glassplat.errors import count_noun
from glassplat.kernels.plane_search import Edges, follow_edges
from glassplat.panes.masks import (
    UNKNOWN_WEIGHT,
    FramedPlanes,
    PaneView,
    Rectangle,
    cameras_of,
    in_plane_axes,
    intersect_rays,
    mask_agreement,
    min_area_rectangle,
)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNEVEN_FRAME = 0.15
"""Variation of the height of a frame along its pane's outline, as a share of the height."""


@dataclass(frozen=True)
class EdgeMatches:
    """Mask edges of V views, mapped into each other over H planes.

    Attributes:
        distances: [H, V, P] distances of mapped edge point p from the edge in view v, in image diagonals, positive on
            the pane. They are scaled so that an error of a pixel in both views weighs equally on all planes and pairs.
        shifts: [H, V, P] part of that distance caused by a frame, per world unit of its height.
        compared: [H, V, P] true if the edge point lands inside the image of another view. Other distances are 0.
        misalignments: [H, P] deviation of the edge at point p from the directions of a rectangular pane's sides: the
            sine of twice the angle.
        sources: [P] the view that edge point p comes from.
    """

    distances: Array
    shifts: Array
    compared: Mask
    misalignments: Array
    sources: NDArray[np.int64]

    def residuals(self, frames: Array, tolerance: float) -> Array:
        """[H, V, P] distances not explained by frames of heights [H], in units of the tolerance."""
        hidden = frames[:, None, None] * self.shifts
        # The height of a frame varies along the outline.
        return (self.distances - hidden) / np.sqrt(tolerance**2 + (UNEVEN_FRAME * hidden) ** 2)


def edge_matches(planes: FramedPlanes, views: Sequence[PaneView], *, edges_per_view: int) -> EdgeMatches:
    """Maps the mask edge of each view into every other view.

    Args:
        planes: H hypotheses.
        views: V annotated views of one pane.
        edges_per_view: number of edge points taken from each view.
    """
    thinned = [slice(None, None, max(len(view.edge) // edges_per_view, 1)) for view in views]
    points = [view.edge[chosen] for view, chosen in zip(views, thinned, strict=True)]
    across = [view.outward[chosen] for view, chosen in zip(views, thinned, strict=True)]
    edges = Edges(
        np.repeat(np.arange(len(views)), [len(found) for found in points]),
        np.concatenate([view.directions(found) for view, found in zip(views, points, strict=True)]),
        np.concatenate([view.line_plane_normals(*found) for view, *found in zip(views, points, across, strict=True)]),
    )
    found = follow_edges(planes.normals, planes.offsets, cameras_of(views), edges, [view.distance for view in views])
    misalignments = _side_misalignments(planes, found.outward)
    return EdgeMatches(found.distances, found.shifts, found.compared, misalignments, edges.sources)


def _side_misalignments(planes: FramedPlanes, outward: Array) -> Array:
    """[H, P] sine of twice the angle between directions in the plane and the nearest side of the pane.

    Its sign is relative to the dominant direction of the edges, whatever the axes of the plane: a sign that flips after
    a small move would invalidate the numerical derivatives.
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
"""Minimum and maximum depth at which panes are searched for, in units of the distance between the annotated cameras."""
LEAST_RAY_COSINE = 0.1
"""Cosine between a plane's normal and a ray through the mask below which a random plane is dropped."""


def planes_through_masks(views: Sequence[PaneView], count: int, rng: np.random.Generator) -> FramedPlanes:
    """Up to `count` random planes without frames, each through a pixel of a mask and facing that camera.

    Depths are log-uniform, normals uniform on the hemisphere; planes at grazing angles are dropped.

    Args:
        views: annotated views of the pane, at least two from different positions.
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
    usable = np.abs(towards) > LEAST_RAY_COSINE
    points = centers[source] + depths[:, None] * rays
    offsets = np.einsum("hd,hd->h", normals, points)
    return FramedPlanes(normals[usable], offsets[usable], np.zeros(int(usable.sum())))


def sample_nearby(
    planes: FramedPlanes, anchors: Array, count: int, *, tilt: float, shift: Array | float, rng: np.random.Generator
) -> FramedPlanes:
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


def move_planes(planes: FramedPlanes, anchors: Array, steps: Array) -> FramedPlanes:
    """Each plane after a small move [H, 3]: two tilts about the point nearest to its anchor [H, 3], and a shift."""
    normals, (first, second) = planes.normals, in_plane_axes(planes)
    heights = np.einsum("hd,hd->h", normals, anchors) - planes.offsets
    feet = anchors - heights[:, None] * normals
    tilted = normals + steps[:, :1] * first + steps[:, 1:2] * second
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    return replace(planes, normals=tilted, offsets=np.einsum("hd,hd->h", tilted, feet) + steps[:, 2])


COARSE_TOLERANCE, MIDDLE_TOLERANCE, FINE_TOLERANCE = TOLERANCES = (0.01, 0.004, 0.002)
"""Distances between mask edges, in image diagonals, at which their loss is one half."""
POINTS_WEIGHT = 0.1
"""Weight of the points on a plane relative to the mask edges; they decide where the edges are ambiguous."""
OUTLINE_WEIGHT, OUTLINE_TOLERANCE = 0.1, 0.2
"""Weight of a rectangular outline relative to the mask edges, and the sine at which its loss is one half."""
USUAL_FRAME, FRAME_WEIGHT = 0.02, 0.01
"""Typical height of a frame above its glass in scene extents, and the weight of this prior relative to the edges."""
EDGE_POINTS = 600
"""Number of edge points over all views together."""
FULLY_SAMPLED_PANES = 4
"""Number of coplanar panes up to which each has `EDGE_POINTS` edge points; more panes share the same total."""
OVERLAP_PIXELS = 600
"""Number of pixels mapped to compare masks, over all views together."""


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
    """Evidence for the plane of one pane.

    Attributes:
        views: annotated views of the pane, at least two.
        points: [N, 3] points along its edge, possibly none.
        extent: radius of the capture in world units.
        distance: of a point from the plane at which its loss is one half, world units.
    """

    views: Sequence[PaneView]
    points: Array
    extent: float
    distance: float

    def inlier_share(self, planes: FramedPlanes) -> Array:
        """[H] share of the points near each plane; 0 if there are no points."""
        if not len(self.points):
            return np.zeros(len(planes))
        return np.asarray((np.abs(planes.distances(self.points)) <= self.distance).mean(axis=1))

    def agreement(self, planes: FramedPlanes) -> Array:
        """[H] agreement of the masks on each plane (`mask_agreement`)."""
        return mask_agreement(planes, self.views, pixels_per_view=max(OVERLAP_PIXELS // len(self.views), 1))

    def anchors(self, planes: FramedPlanes) -> Array:
        """[H, 3] a point near the middle of the pane on each plane, from the middles of the masks."""
        centers, weight_sums = np.zeros((len(planes), 3)), np.zeros(len(planes))
        for view in self.views:
            points, hit = intersect_rays(planes, view.center, view.directions(view.middle))
            # A view at a grazing angle places the middle far away.
            rays = points[:, 0] - view.center
            squared = np.maximum(np.einsum("hd,hd->h", rays, rays), np.finfo(np.float64).tiny)
            weights = np.where(hit[:, 0], 1 / squared, 0)
            centers += weights[:, None] * points[:, 0]
            weight_sums += weights
        return centers / np.maximum(weight_sums, np.finfo(np.float64).tiny)[:, None]

    def camera_distance(self, planes: FramedPlanes) -> Array:
        """[H] median distance of the cameras from the middle of the pane."""
        centers = np.stack([view.center for view in self.views])
        away: Array = np.median(np.linalg.norm(self.anchors(planes)[:, None] - centers, axis=2), axis=1)
        return away

    def terms(self, planes: FramedPlanes, tolerance: float, *, edges: int = EDGE_POINTS) -> Terms:
        """The residuals of H planes.

        Args:
            planes: hypotheses.
            tolerance: distance of mask edges at which the loss is one half, in image diagonals; at least one pixel is
                used, because masks are no more accurate.
            edges: number of edge points in all views together.
        """
        tolerance = max(tolerance, *(1 / view.diagonal for view in self.views))
        matches = edge_matches(planes, self.views, edges_per_view=max(edges // len(self.views), 1))
        hypotheses = len(planes)
        known = matches.compared.sum(axis=(1, 2))
        unknown = UNKNOWN_WEIGHT * (matches.misalignments.shape[1] * (len(self.views) - 1) - known)
        edge_weight = 1 / np.maximum(known + unknown, 1)
        edge_residuals = matches.residuals(planes.frames, tolerance).reshape(hypotheses, -1)
        point_residuals = planes.distances(self.points) / self.distance
        frames = planes.frames[:, None] / (USUAL_FRAME * self.extent)
        residuals = (edge_residuals, matches.misalignments / OUTLINE_TOLERANCE, point_residuals, frames)
        outline_weight = OUTLINE_WEIGHT / matches.misalignments.shape[1]
        point_weight = POINTS_WEIGHT / max(len(self.points), 1)
        weights = (edge_weight, outline_weight, point_weight, FRAME_WEIGHT)
        weight_blocks = [
            np.broadcast_to(np.reshape(weight, (-1, 1)), block.shape)
            for weight, block in zip(weights, residuals, strict=True)
        ]
        return Terms(np.concatenate(residuals, axis=1), np.concatenate(weight_blocks, axis=1), unknown * edge_weight)


def _mean(values: Sequence[Array]) -> Array:
    """The mean of arrays, element by element."""
    return np.asarray(np.mean(values, axis=0))


@dataclass(frozen=True)
class JointObjective:
    """Evidence for the common plane of several panes, whose frames are equally high; each pane has the same weight.

    Attributes:
        parts: evidence for each pane, at least one.
    """

    parts: Sequence[Objective]

    @property
    def extent(self) -> float:
        """Radius of the capture in world units."""
        return self.parts[0].extent

    def agreement(self, planes: FramedPlanes) -> Array:
        """[H] agreement of the masks on each plane, averaged over the panes."""
        return _mean([part.agreement(planes) for part in self.parts])

    def anchors(self, planes: FramedPlanes) -> Array:
        """[H, 3] a point near the middle of all panes on each plane."""
        return _mean([part.anchors(planes) for part in self.parts])

    def camera_distance(self, planes: FramedPlanes) -> Array:
        """[H] median distance of the cameras from the middle of a pane, averaged over the panes."""
        return _mean([part.camera_distance(planes) for part in self.parts])

    def terms(self, planes: FramedPlanes, tolerance: float, *, edges: int = EDGE_POINTS) -> Terms:
        """The residuals of H planes, as `Objective.terms`; with `edges` points for each pane, or fewer for many."""
        each = edges * min(len(self.parts), FULLY_SAMPLED_PANES) // len(self.parts)
        terms = [part.terms(planes, tolerance, edges=each) for part in self.parts]
        return Terms(
            np.concatenate([term.residuals for term in terms], axis=1),
            np.concatenate([term.weights for term in terms], axis=1) / len(terms),
            _mean([term.rest for term in terms]),
        )


OUTLINE_PIXELS = 4000
"""Number of pixels of each view; those of the mask are projected onto the plane."""
MAP_CELLS = 128
"""Number of grid cells along the longer side of the map of the plane."""
GRAZING_COSINE = 0.06
"""Cosine to the normal below which a pixel is too large on the plane to locate the border."""
SMALLEST_PART = 0.05
"""Share of the largest connected part below which a part is an error in a mask."""
LEAST_AGREEING_SHARE = 0.34
"""Minimum share, of the views of a point, that show the pane there; others may be occluded."""


def pane_rectangle(plane: FramedPlanes, views: Sequence[PaneView], axes: Array) -> Rectangle:
    """The smallest rectangle, on one plane, around the region of the pane in the masks.

    The paper's Appendix A bounds the inliers of the plane fit. Here the masks' pixels are projected onto the plane
    instead: points on a frame are few, and a corner without any would be cut off.

    Args:
        plane: one plane.
        views: annotated views of the pane.
        axes: [2, 3] orthonormal directions in the plane, in which the rectangle is expressed; its origin is the point
            of the plane nearest to the world's origin.

    Raises:
        ValueError: no part of the plane shows the pane in enough views.
    """
    foot = plane.normals[0] * plane.offsets[0]
    points = np.concatenate([_pixels_on_plane(plane, view) for view in views])
    points = points[_shows_pane(points, views, plane.normals[0])]
    if len(points) < 3:
        raise ValueError(
            f"the masks agree on where the pane is in {count_noun(len(points), 'pixel')}; expected at least three"
        )
    corners = (points - foot) @ axes.T
    low, high = corners.min(axis=0), corners.max(axis=0)
    cell = (high - low).max() / MAP_CELLS
    u, v = (np.arange(a - cell, b + 2 * cell, cell) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1)
    inside = _shows_pane((foot + grid @ axes).reshape(-1, 3), views, plane.normals[0])
    return min_area_rectangle(grid[_without_specks(inside.reshape(grid.shape[:2]))])


def _pixels_on_plane(plane: FramedPlanes, view: PaneView) -> Array:
    """[P, 3] points of the plane that are seen through the pixels of a mask."""
    pixels = view.pixel_grid(OUTLINE_PIXELS)
    directions = view.directions(pixels[view.covers(pixels)])
    points, hit = intersect_rays(plane, view.center, directions)
    return points[0, hit[0]]


def _shows_pane(points: Array, views: Sequence[PaneView], normal: Array) -> Mask:
    """[P] bool: points [P, 3] of the plane at which enough of the views that contain them show the pane."""
    shown, inside_count = np.zeros(len(points)), np.zeros(len(points))
    for view in views:
        pixels, inside = view.project(points)
        rays = points - view.center
        inside &= np.abs(rays @ normal) > GRAZING_COSINE * np.linalg.norm(rays, axis=1)
        inside = view.is_unoccluded(pixels, inside)
        shown += view.covers(pixels, inside)
        inside_count += inside
    return (shown > 0) & (shown >= LEAST_AGREEING_SHARE * inside_count)


def _without_specks(inside: Mask) -> Mask:
    from scipy import ndimage

    parts, count = ndimage.label(inside)
    sizes = np.bincount(parts.ravel(), minlength=count + 1)
    sizes[0] = 0
    return np.asarray((sizes >= max(SMALLEST_PART * sizes.max(), 1))[parts])
