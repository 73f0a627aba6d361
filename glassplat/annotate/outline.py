"""A pane's outline as photographs show it, and filled as a mask."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from glassplat.annotate.document import Stroke
from glassplat.scene.eye import Eye

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEAR = 1e-3
"""Camera z before which an outline is cut off, as a share of its largest distance."""
FARTHEST = 1e5
"""Pixels beyond which a point of a stroke is as good as at infinity."""


def seen_outline(eye: Eye, corners: Array) -> Array:
    """[P, 2] the outline of a polygon [K, 3] in a view, cut off where it passes the camera; empty if it is behind.

    It reaches far beside the photograph there, which keeps its edges straight: 1 / `NEAR` focal lengths at most.
    """
    return eye.pixels(_before_camera(eye.in_camera(corners)))


def _before_camera(points: Array) -> Array:
    """[P, 3] a polygon's part with z of at least a little (Sutherland and Hodgman's way to cut)."""
    near = NEAR * float(np.abs(points).max())
    kept: list[Array] = []
    for here, after in zip(points, np.roll(points, -1, axis=0), strict=True):
        if here[2] >= near:
            kept.append(here)
        if (here[2] >= near) != (after[2] >= near):
            kept.append(here + (near - here[2]) / (after[2] - here[2]) * (after - here))
    return np.array(kept).reshape(-1, 3)


def filled(outline: Array, size: tuple[int, int]) -> Mask:
    """[H, W] the pixels whose centres a polygon [P, 2] holds; `size` is width and height."""
    width, height = size
    if len(outline) < 3:
        return np.zeros((height, width), dtype=bool)
    y = np.arange(height) + 0.5
    x = np.arange(width) + 0.5
    inside = np.zeros((height, width), dtype=bool)
    for one, other in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        low, high = sorted((one[1], other[1]))
        rows = np.flatnonzero((y >= low) & (y < high))
        if not len(rows):
            continue
        crossing = one[0] + (y[rows] - one[1]) / (other[1] - one[1]) * (other[0] - one[0])
        inside[rows] ^= x[None, :] >= crossing[:, None]
    return inside


def depths(eye: Eye, corners: Array) -> Array:
    """[H, W] camera z at which each pixel's ray meets the plane of a polygon; infinite where it does not."""
    center = corners.mean(axis=0)
    normal = np.linalg.svd(corners - center)[2][2]
    x, y = np.meshgrid(np.arange(int(eye.size[0])) + 0.5, np.arange(int(eye.size[1])) + 0.5)
    rays = eye.rays(np.stack([x, y], axis=-1))
    slopes = rays @ normal
    away = float((center - eye.center) @ normal) / np.where(np.abs(slopes) < 1e-9, 1e-9, slopes)
    return np.where(away > 0, away * (rays @ eye.rotation[2]), np.inf)


def with_strokes(mask: Mask, strokes: Sequence[Stroke]) -> Mask:
    """A mask after its strokes: cut takes pixels out, keep brings back those that the mask had at first."""
    found = mask.copy()
    for stroke in strokes:
        covered = painted(stroke, (mask.shape[1], mask.shape[0]))
        found = found & ~covered if stroke.effect == "cut" else found | (covered & mask)
    return found


def painted(stroke: Stroke, size: tuple[int, int]) -> Mask:
    """[H, W] what a stroke covers."""
    places = np.array(stroke.points, dtype=np.float64).reshape(-1, 2)
    if stroke.kind == "polygon":
        return filled(places, size)
    picture = Image.new("1", size)
    pencil = ImageDraw.Draw(picture)
    path = [tuple(place) for place in np.clip(places, -FARTHEST, FARTHEST)]
    if len(path) > 1:
        pencil.line(path, fill=1, width=max(1, round(2 * stroke.radius)), joint="curve")
    for x, y in path:
        pencil.ellipse((x - stroke.radius, y - stroke.radius, x + stroke.radius, y + stroke.radius), fill=1)
    return np.array(picture)
