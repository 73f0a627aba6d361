"""A flat outline in space by a few parameters: a rectangle, or any polygon in a plane."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

RECTANGLE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
"""Corners in half sides, one after the other round it."""


class PaneShape(Protocol):
    """What is fitted to marks: corners in one plane, moved by steps of a few numbers."""

    @property
    def frame(self) -> Array:
        """[3, 3] rows: two axes in the plane, and its normal."""
        ...

    @property
    def freedom(self) -> int:
        """How many numbers move it; the first two tilt its plane, in radians."""
        ...

    def corners(self) -> Array:
        """[K, 3] in the world, in order round the outline."""
        ...

    def stepped(self, step: Array) -> PaneShape:
        """The shape after a step."""
        ...


@dataclass(frozen=True)
class RectanglePane:
    """A rectangle: tilt, turn, centre and two half sides."""

    axes: Array
    center: Array
    half_sizes: Array

    @property
    def frame(self) -> Array:
        """[3, 3] along the first side, along the second, normal."""
        return self.axes

    @property
    def freedom(self) -> int:
        """Three to turn it, three to shift it, two for its sides."""
        return 8

    def corners(self) -> Array:
        """[4, 3]."""
        return np.asarray(self.center + (RECTANGLE * self.half_sizes) @ self.axes[:2])

    def stepped(self, step: Array) -> RectanglePane:
        """Shifts are in units of the longer half side, sides grow by factors."""
        return RectanglePane(
            axes=_turned(self.axes, step[:3]),
            center=self.center + self.half_sizes.max() * step[3:6] @ self.axes,
            half_sizes=self.half_sizes * np.exp(np.clip(step[6:8], -1, 1)),
        )


@dataclass(frozen=True)
class PolygonPane:
    """Corners anywhere in a plane."""

    axes: Array
    center: Array
    places: Array
    """[K, 2] corners along the first two axes, from the centre."""

    @property
    def frame(self) -> Array:
        """[3, 3] two axes in the plane, normal."""
        return self.axes

    @property
    def freedom(self) -> int:
        """Two to tilt it, one along its normal, two for each corner."""
        return 3 + 2 * len(self.places)

    def corners(self) -> Array:
        """[K, 3]."""
        return np.asarray(self.center + self.places @ self.axes[:2])

    def stepped(self, step: Array) -> PolygonPane:
        """Lengths are in units of the polygon's reach."""
        reach = float(np.linalg.norm(self.places, axis=1).max())
        return replace(
            self,
            axes=_turned(self.axes, np.append(step[:2], 0.0)),
            center=self.center + reach * step[2] * self.axes[2],
            places=self.places + reach * step[3:].reshape(-1, 2),
        )


def polygon_pane(corners: Array) -> PolygonPane:
    """The polygon in the plane that lies closest to points [K, 3].

    Raises:
        ValueError: they lie on a line.
    """
    center = corners.mean(axis=0)
    _, sizes, axes = np.linalg.svd(corners - center)
    if sizes[1] < 1e-6 * sizes[0]:
        raise ValueError("the corners lie on one line; expected an outline that spans an area")
    axes = axes * np.array([[1.0], [1.0], [np.linalg.det(axes)]])
    return PolygonPane(axes, center, (corners - center) @ axes[:2].T)


def rectangle_pane(polygon: PolygonPane) -> RectanglePane:
    """The rectangle closest to a polygon of four corners, which may be far from one."""
    a, b, c, d = polygon.places
    along, across = (b - a + c - d) / 2, (d - a + c - b) / 2
    # The direction on which both pairs of sides agree best, the second pair turned back by a right angle.
    turn = 1.0 if along[0] * across[1] - along[1] * across[0] > 0 else -1.0
    direction = along + turn * np.array([across[1], -across[0]])
    first = direction / np.linalg.norm(direction)
    second = turn * np.array([-first[1], first[0]])
    axes = np.stack([first @ polygon.axes[:2], second @ polygon.axes[:2], turn * polygon.axes[2]])
    half_sizes = np.maximum([along @ first / 2, across @ second / 2], 1e-3 * np.abs(polygon.places).max())
    return RectanglePane(axes, polygon.center + polygon.places.mean(axis=0) @ polygon.axes[:2], half_sizes)


def _turned(axes: Array, angles: Array) -> Array:
    """Axes turned about themselves by small angles, radians."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(angles).as_matrix().T @ axes)
