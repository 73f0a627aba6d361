"""Planes through points: random triplets and their inliers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlaneEquations:
    """H planes, the points x with normal . x = offset.

    Attributes:
        normals: [H, 3] unit normals.
        offsets: [H] signed distances of the planes from the origin.
    """

    normals: Array
    offsets: Array

    def __len__(self) -> int:
        return len(self.offsets)

    def distances(self, points: Array) -> Array:
        """[H, N] signed distances of points [N, 3]."""
        return self.normals @ points.T - self.offsets[:, None]

    def select(self, index: NDArray[np.int64]) -> PlaneEquations:
        """The planes at `index`."""
        return PlaneEquations(self.normals[index], self.offsets[index])


@dataclass(frozen=True)
class FramedPlanes:
    """Planes with the heights of the frames around them.

    Attributes:
        planes: H planes.
        frames: [H] how far the frame stands out from the glass, world units.
    """

    planes: PlaneEquations
    frames: Array

    def __len__(self) -> int:
        return len(self.frames)

    def select(self, index: NDArray[np.int64]) -> FramedPlanes:
        """Those at `index`."""
        return FramedPlanes(self.planes.select(index), self.frames[index])


def joined(parts: Sequence[FramedPlanes]) -> FramedPlanes:
    """All planes of several sets."""
    normals = np.concatenate([part.planes.normals for part in parts])
    offsets = np.concatenate([part.planes.offsets for part in parts])
    return FramedPlanes(PlaneEquations(normals, offsets), np.concatenate([part.frames for part in parts]))


def in_plane_axes(planes: PlaneEquations) -> tuple[Array, Array]:
    """Two directions [H, 3] each that are perpendicular to the normals and to one another; unit vectors."""
    first = np.cross(planes.normals, np.eye(3)[np.argmin(np.abs(planes.normals), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(planes.normals, first)


def random_planes(points: Array, count: int, rng: np.random.Generator) -> PlaneEquations:
    """Planes through random triplets of points [N, 3]; up to `count`, since flat triplets are dropped.

    Args:
        points: [N, 3] at least three positions.
        count: number of triplets.
        rng: source of randomness.
    """
    a, b, c = points[(len(points) * rng.random((3, count))).astype(np.int64)]
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    # A triplet close to a line says nothing about the tilt of a plane around that line.
    spread = np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1)
    usable = area > 0.1 * np.maximum(spread, np.finfo(np.float64).tiny)
    normals = normals[usable] / area[usable, None]
    return PlaneEquations(normals, np.einsum("hd,hd->h", normals, a[usable]))


def support(planes: PlaneEquations, points: Array, *, distance: float) -> Array:
    """[H] share of the points within `distance` of each plane."""
    near: Array = (np.abs(planes.distances(points)) <= distance).mean(axis=1)
    return near
