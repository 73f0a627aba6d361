"""How far a pane goes in its plane: as far as mirror images are seen in it, and from there to its frame."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from glassplat.scene.eye import Eye
from glassplat.suggest.matching import Observations
from glassplat.suggest.mirror_matches import Plane

Array = NDArray[np.float64]
Grey = Callable[[int], NDArray[np.uint8]]

OUTLIERS = 1.0
"""Per cent of the crossings beyond each side that do not count."""
FARTHEST = 1.0
"""Of the search for a frame, in half sides beyond the crossings."""
STEPS = 48
SAMPLES = 64
MOST_VIEWS = 16
CALM = 0.5
"""Of the middle difference between views inside of the pane, from which on a line lies on its plane, as frames do."""
FEWEST_VIEWS = 3


def crossings(plane: Plane, seen: Observations, virtual: NDArray[np.int64]) -> Array:
    """[N, 3] where the sight lines of observations cross a plane."""
    centers, rays = seen.centers_of(virtual), seen.rays[virtual]
    slope = rays @ plane.normal
    away = -plane.heights(centers) / np.where(np.abs(slope) < 1e-9, 1e-9, slope)
    return np.asarray(centers + away[:, None] * rays)


def pane_axes(plane: Plane, eyes: Sequence[Eye]) -> Array:
    """[2, 3] unit directions in a plane: level and upright, as photographs are held, for most panes are."""
    up = -np.mean([eye.rotation[1] for eye in eyes], axis=0)
    level = np.cross(up, plane.normal)
    if np.linalg.norm(level) < 0.2 * np.linalg.norm(up):  # A pane that lies: along the photographs' lower edges.
        level = np.mean([eye.rotation[0] for eye in eyes], axis=0)
        level = level - (level @ plane.normal) * plane.normal
    level = level / np.linalg.norm(level)
    return np.stack([level, np.cross(plane.normal, level)])


def pane_corners(plane: Plane, seen: Observations, virtual: NDArray[np.int64], grey: Grey) -> Array:
    """[4, 3] corners of a rectangle around what is seen mirrored, in order round it.

    Things on the plane look the same from everywhere once the photographs are laid on it; what is seen through it or
    mirrored in it does not. Each side goes out to the first line that looks the same, where there is one near.

    Args:
        plane: of the pane.
        seen: all observations.
        virtual: numbers of those that show mirror images.
        grey: reads the grey picture [H, W] of a view, in the size of its camera.
    """
    axes = pane_axes(plane, seen.eyes)
    places = crossings(plane, seen, virtual)
    middle = places.mean(axis=0)
    flat = (places - middle) @ axes.T
    low, high = np.percentile(flat, [OUTLIERS, 100 - OUTLIERS], axis=0)
    views, counts = np.unique(seen.view[virtual], return_counts=True)
    chosen = views[np.argsort(-counts, kind="stable")][:MOST_VIEWS]
    pictures = [(seen.eyes[view], grey(int(view))) for view in chosen]

    def difference(u: Array, v: Array) -> float:
        return _difference(middle + u[:, None] * axes[0] + v[:, None] * axes[1], pictures)

    low, high = _grown(low, high, difference)
    sides = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    return np.asarray(middle + sides @ axes)


def _grown(low: Array, high: Array, difference: Callable[[Array, Array], float]) -> tuple[Array, Array]:
    """The rectangle with each side moved out to the first line on which views agree."""
    half = (high - low) / 2
    share = np.linspace(0, 1, SAMPLES)
    lines = np.linspace(0.1, 0.9, 9)
    level = low[0] + share * 2 * half[0]
    inside = float(np.median([difference(level, np.full(SAMPLES, low[1] + at * 2 * half[1])) for at in lines]))
    sides = np.stack([low, high])
    for axis in (0, 1):
        along = np.stack([low, high])[0, 1 - axis] + share * 2 * half[1 - axis]
        for end, sign in ((0, -1.0), (1, 1.0)):
            for step in np.linspace(0, FARTHEST * half[axis], STEPS):
                across = np.full(SAMPLES, (low, high)[end][axis] + sign * step)
                places = (across, along) if axis == 0 else (along, across)
                if difference(*places) < CALM * inside:
                    sides[end, axis] = across[0]
                    break
    return sides[0], sides[1]


def _difference(points: Array, pictures: Sequence[tuple[Eye, NDArray[np.uint8]]]) -> float:
    """How much views differ in what they show at points of the plane [P, 3], the middle one, in grey values."""
    values = np.full((len(pictures), len(points)), np.nan)
    for row, (eye, picture) in enumerate(pictures):
        held = eye.holds(points)
        column, line = np.floor(eye.project(points[held])).astype(np.int64).T
        values[row, held] = picture[line, column]
    enough = (~np.isnan(values)).sum(axis=0) >= FEWEST_VIEWS
    if enough.mean() < 0.5:
        return np.inf
    return float(np.median(np.nanstd(values[:, enough], axis=0)))
