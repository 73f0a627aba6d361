"""A room of points with mirrors in it, seen by cameras: matches without any pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from glassplat.scene.eye import Eye
from glassplat.suggest.matching import Observations
from glassplat.suggest.mirror_matches import MirrorMatches, Plane
from glassplat.suggest.tracks import Tracks, triangulated

Array = NDArray[np.float64]
SIZE = np.array([400.0, 300.0])
FEATURE = 0.04
"""Reach of a feature in space."""
EXTENT = 2.0


def eye_at(center: Array, target: Array) -> Eye:
    """A camera that looks at a target, upright with +z up."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return Eye(rotation, center, np.array([300.0, 300.0, 200.0, 150.0]), SIZE)


def eyes_around(rng: np.random.Generator, count: int, target: Sequence[float], *, side: float = 1.0) -> list[Eye]:
    """Cameras before y = 0, or on both sides of it with `side` 0, that look at a target and beside it."""
    centers = rng.uniform([-1.5, 0.6, -0.6], [1.5, 2.0, 0.6], (count, 3))
    if side == 0:
        centers[::2, 1] *= -1
    return [eye_at(center, np.array(target) + rng.normal(0, 0.3, 3)) for center in centers]


def things(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Points [P, 3] before y = 0, and points beside them that tell a direction."""
    points = rng.uniform([-2.0, 0.3, -1.0], [2.0, 3.0, 1.0], (count, 3))
    away = rng.normal(size=(count, 3))
    return points, points + FEATURE * away / np.linalg.norm(away, axis=1, keepdims=True)


class Room:
    """Observations of points and of what mirrors, or other symmetries, make of them."""

    def __init__(self, eyes: Sequence[Eye], rng: np.random.Generator, noise: float = 0.3) -> None:
        self.eyes, self.rng, self.noise = eyes, rng, noise
        self.rows: list[tuple[int, Array, float, float]] = []
        self.direct: list[tuple[int, int]] = []
        self.mirrored: list[tuple[int, int]] = []

    def see(self, point: Array, tip: Array, allowed: NDArray[np.bool_]) -> list[int]:
        """Numbers of the observations of a point by the allowed views that hold it, joined to a track."""
        numbers = []
        for view in np.flatnonzero(allowed):
            eye = self.eyes[view]
            if not eye.holds(point) or not eye.holds(tip, 0.2):
                continue
            pixel, end = eye.project(np.stack([point, tip]))
            along = end - pixel
            noisy = pixel + self.rng.normal(0, self.noise, 2)
            self.rows.append((int(view), noisy, float(np.hypot(*along)), float(np.arctan2(along[1], along[0]))))
            numbers.append(len(self.rows) - 1)
        self.direct += list(zip(numbers[1:], numbers, strict=False))
        return numbers

    def add_mirrored(self, planes: Sequence[Plane], points: Array, tips: Array) -> None:
        """Points that are seen directly from before all planes, and in each plane too."""
        centers = np.stack([eye.center for eye in self.eyes])
        for point, tip in zip(points, tips, strict=True):
            itself = self.see(point, tip, np.ones(len(centers), dtype=bool))
            for plane in planes:
                through = plane.heights(centers) * plane.heights(point) > 0
                self.link(itself, self.see(plane.mirrored(point), plane.mirrored(tip), through))

    def add_symmetric(self, plane: Plane, points: Array, tips: Array) -> None:
        """Points that stand on both sides of a plane, each seen from everywhere: a symmetric thing, no mirror."""
        everywhere = np.ones(len(self.eyes), dtype=bool)
        for point, tip in zip(points, tips, strict=True):
            one = self.see(point, tip, everywhere)
            self.link(one, self.see(plane.mirrored(point), plane.mirrored(tip), everywhere))

    def link(self, one: Sequence[int], other: Sequence[int]) -> None:
        self.mirrored += [(a, b) for a in one[:3] for b in other[:3]]

    def add_outliers(self, count: int) -> None:
        """Matches of anything with anything."""
        self.mirrored += [tuple(pair) for pair in self.rng.integers(0, len(self.rows), (count, 2)).tolist()]

    @property
    def seen(self) -> Observations:
        view, pixels, sizes, turns = (np.array(column) for column in zip(*self.rows, strict=True))
        rays = np.stack([self.eyes[number].rays(pixel) for number, pixel in zip(view, pixels, strict=True)])
        return Observations(view, pixels, sizes, turns, rays, self.eyes)

    def matches(self) -> MirrorMatches:
        seen = self.seen
        tracks: Tracks = triangulated(seen, np.array(self.direct))
        return MirrorMatches.of(seen, tracks, np.array(self.mirrored, dtype=np.int64).reshape(-1, 2))


def degrees_between(one: Array, other: Array) -> float:
    """Between two normals, whichever way they point."""
    return float(np.degrees(np.arccos(min(1.0, abs(one @ other)))))
