"""Small moves of planes, and planes drawn at random through the pixels of masks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from glassplat.init.annotation import PaneView
from glassplat.init.consistency import meet
from glassplat.init.ransac import PlaneEquations, in_plane_axes

Array = NDArray[np.float64]

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
    eyes = np.stack([view.center for view in views])
    apart = float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).mean())
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
    points = eyes[source] + depths[:, None] * rays
    return PlaneEquations(normals[usable], np.einsum("hd,hd->h", normals, points)[usable])


def pane_centers(planes: PlaneEquations, views: Sequence[PaneView]) -> Array:
    """[H, 3] a point near the middle of the pane on each plane, from the middles of the masks."""
    found, seen = np.zeros((len(planes), 3)), np.zeros(len(planes))
    for view in views:
        row, column = np.nonzero(view.mask)
        middle = np.array([[np.median(column) + 0.5, np.median(row) + 0.5]])
        points, hit = meet(planes, view.center, view.directions(middle))
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
    return moved(planes.select(index), anchors[index], steps.reshape(-1, 3))


def moved(planes: PlaneEquations, anchors: Array, steps: Array) -> PlaneEquations:
    """Each plane after a small move [H, 3]: two tilts about the point nearest to its anchor [H, 3], and a shift."""
    normals, (first, second) = planes.normals, in_plane_axes(planes)
    heights = np.einsum("hd,hd->h", normals, anchors) - planes.offsets
    feet = anchors - heights[:, None] * normals
    tilted = normals + steps[:, :1] * first + steps[:, 1:2] * second
    tilted /= np.linalg.norm(tilted, axis=1, keepdims=True)
    return PlaneEquations(tilted, np.einsum("hd,hd->h", tilted, feet) + steps[:, 2])
