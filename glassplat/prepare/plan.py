"""A capture seen from above, as an SVG: cameras, measured points, panes."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from glassplat.data.dataset import View
from glassplat.data.point_cloud import PointCloud
from glassplat.scene.eye import Eye
from glassplat.scene.plane import Planes

Array = NDArray[np.float64]

SIZE = (640, 440)
MARGIN = 14
MOST_POINTS = 4000
"""Drawn; of more every second or third is."""
OUTLIERS = 4.0
"""Points are shown up to this share, in percent, at each end: a few lie anywhere."""
RECTANGLE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
HEADING = 11.0
"""Pixels of a camera's stroke, which points where it looks."""


def plan(views: Sequence[View], points: PointCloud, behind: NDArray[np.bool_], planes: Planes | None) -> str:
    """The SVG.

    Args:
        views: cameras, in the order in which they are joined by a line.
        points: measured places.
        behind: [N] which of them lie behind panes.
        planes: panes, if any are known.
    """
    eyes = [Eye.of(view.camera) for view in views]
    axes = _from_above(eyes)
    centers = np.stack([eye.center for eye in eyes]) @ axes.T
    places = points.positions.cpu().double().numpy() @ axes.T
    panes = [] if planes is None else [corners @ axes.T for corners in _corners(planes)]
    on_page = _fitting(places, np.concatenate([centers, *panes]))
    colors = points.colors.cpu().numpy()
    drawn = [
        *_points(on_page(places), colors, behind),
        *(_line(on_page(pane[[0, 1, 2, 3, 0]]), "#ffd24a", 2) for pane in panes),
        _line(on_page(centers), "#3a76b8", 1),
        *_headings(eyes, axes, on_page),
    ]
    width, height = SIZE
    return f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}">{"".join(drawn)}</svg>'


def _from_above(eyes: Sequence[Eye]) -> Array:
    """[2, 3] to the right and down in the plan, of world points; down is where cameras look on average."""
    up = -np.mean([eye.rotation[1] for eye in eyes], axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    ahead = np.mean([eye.rotation[2] for eye in eyes], axis=0)
    ahead -= up * (ahead @ up)
    if np.linalg.norm(ahead) < 1e-3:  # They look all around.
        ahead = np.cross(up, eyes[0].rotation[0])
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    return np.stack([np.cross(ahead, up), -ahead])


def _corners(planes: Planes) -> list[Array]:
    """[4, 3] of each pane, one after the other round it."""
    centers, sizes = (one.detach().cpu().double().numpy() for one in (planes.centers, planes.half_sizes))
    tangents, bitangents = (axis.detach().cpu().double().numpy() for axis in planes.axes())
    sides = np.stack([tangents * sizes[:, :1], bitangents * sizes[:, 1:]], axis=1)
    return [center + RECTANGLE @ side for center, side in zip(centers, sides, strict=True)]


def _fitting(places: Array, always: Array) -> Callable[[Array], Array]:
    """From places in the plan to pixels."""
    reach = np.percentile(places, [OUTLIERS, 100 - OUTLIERS], axis=0) if len(places) else always[:0].reshape(0, 2)
    all_of_it = np.concatenate([reach, always])
    low, high = all_of_it.min(axis=0), all_of_it.max(axis=0)
    scale = float(((np.array(SIZE) - 2 * MARGIN) / np.maximum(high - low, 1e-9)).min())
    middle = (low + high) / 2
    return lambda one: np.asarray((one - middle) * scale + np.array(SIZE) / 2)


def _points(pixels: Array, colors: NDArray[np.generic], behind: NDArray[np.bool_]) -> list[str]:
    every = max(1, -(-len(pixels) // MOST_POINTS))
    inside = np.all((pixels >= 0) & (pixels <= np.array(SIZE)), axis=1).reshape(-1)
    shown = [int(row) for row in np.flatnonzero(inside)[::every]]
    return [_dot(pixels[row], "#ff4fd8" if behind[row] else _hex(colors[row])) for row in shown]


def _dot(place: Array, color: str) -> str:
    return f'<circle cx="{place[0]:.1f}" cy="{place[1]:.1f}" r="1.3" fill="{color}"/>'


def _hex(color: NDArray[np.generic]) -> str:
    red, green, blue = (int(one) for one in color)
    return f"#{red:02x}{green:02x}{blue:02x}"


def _line(pixels: Array, color: str, width: float) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
    return f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="{width}"/>'


def _headings(eyes: Sequence[Eye], axes: Array, on_page: Callable[[Array], Array]) -> list[str]:
    strokes = []
    for eye in eyes:
        begin = on_page((eye.center @ axes.T)[None])[0]
        heading = axes @ eye.rotation[2]
        strokes.append(_line(np.stack([begin, begin + HEADING * heading]), "#7cc0ff", 1.5))
        strokes.append(f'<circle cx="{begin[0]:.1f}" cy="{begin[1]:.1f}" r="2.6" fill="#5aa9ff"/>')
    return strokes
