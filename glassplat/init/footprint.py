"""The part of a plane that is the pane, as the masks show it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from glassplat.init.annotation import PaneView
from glassplat.init.consistency import meet
from glassplat.init.ransac import PlaneEquations
from glassplat.init.rectangle import Rectangle, min_area_rectangle

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

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


def _pixels_on_plane(plane: PlaneEquations, view: PaneView, count: int = 4000) -> Array:
    """[P, 3] where the plane is seen through the pixels of a mask."""
    pixels = view.grid(count)
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
