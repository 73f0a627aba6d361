"""Panes of the tracer: flat rectangles of glass and mirrors, even or waved, single or double."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GLASS_WAVES = 6
SELF = 1e-6
"""A ray does not meet the pane from which it starts: distances below this do not count, world units."""


class Meeting(NamedTuple):
    """Where rays meet a pane, where they go on to after a reflection, and the share of the light that does."""

    points: Array
    mirrored: Array
    share: Array


@dataclass(frozen=True)
class Waves:
    """Unevenness of glass, which turns its normals: a sum of plane waves of one length.

    Attributes:
        slope_rad: root of the mean square of the angle between a normal and that of the even pane.
        length: of the waves, world units.
        seed: chooses their directions and phases.
    """

    slope_rad: float
    length: float = 0.6
    seed: int = 0

    def slopes(self, places: Array) -> Array:
        """Gradients [N, 2] of the height at places [N, 2] on the pane, world units."""
        generator = np.random.default_rng(self.seed)
        angles, phases = generator.uniform(0, 2 * np.pi, (2, GLASS_WAVES))
        along = np.stack([np.cos(angles), np.sin(angles)])
        heights = np.sin(2 * np.pi / self.length * places @ along + phases)
        return self.slope_rad * np.sqrt(2 / GLASS_WAVES) * heights @ along.T


@dataclass(frozen=True)
class SecondPane:
    """The other pane of double glazing, which mirrors as the first one does.

    Attributes:
        gap: how far behind the first one it is, seen from the side to which the normal points, world units.
        tilt_rad: by which it is turned about the pane's tangent.
    """

    gap: float
    tilt_rad: float


@dataclass(frozen=True)
class Pane:
    """A flat rectangle of glass, or a mirror on both sides.

    Attributes:
        label: its number, from 1.
        center: world units.
        normal: unit.
        tangent: unit, along the first side.
        half_sizes: half the lengths of the sides.
        refraction: refractive index; None for a mirror.
        tint: share of red, green and blue light that gets through of what is not reflected.
        waves: in the glass; None where it is even.
        second: pane of double glazing; None for a single pane.
    """

    label: int
    center: Array
    normal: Array
    tangent: Array
    half_sizes: tuple[float, float]
    refraction: float | None = 1.5
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    waves: Waves | None = None
    second: SecondPane | None = None

    @property
    def bitangent(self) -> Array:
        """Unit, along the second side."""
        return np.cross(self.normal, self.tangent)

    @property
    def base_reflectance(self) -> float:
        """Share of the light that comes back at normal incidence, of both panes of double glazing."""
        towards = -self.normal[None]
        met = self.meetings(self.center - towards, towards, np.ones(1))
        return float(sum(meeting.share[0] for meeting in met))

    def distances(self, origins: Array, directions: Array) -> Array:
        """How far [N] rays go until they meet it; infinite where they do not."""
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((self.center - origins) @ self.normal) / (directions @ self.normal)
            offset = origins + distance[:, None] * directions - self.center
            inside = (np.abs(offset @ self.tangent) <= self.half_sizes[0]) & (
                np.abs(offset @ self.bitangent) <= self.half_sizes[1]
            )
        return np.where(inside & (distance > SELF), distance, np.inf)

    def reflectances(self, cosines: Array) -> Array:
        """Share [N] of unpolarised light that comes back, by the cosine between ray and normal.

        Fresnel's law for each polarisation, r; between the two surfaces light goes to and fro, 2 r / (1 + r) in all.
        """
        if self.refraction is None:
            return np.ones_like(cosines)
        inside = np.sqrt(1 - (1 - cosines**2) / self.refraction**2)
        across = (cosines - self.refraction * inside) / (cosines + self.refraction * inside)
        along = (inside - self.refraction * cosines) / (inside + self.refraction * cosines)
        return (2 * across**2 / (1 + across**2) + 2 * along**2 / (1 + along**2)) / 2

    def normals(self, points: Array) -> Array:
        """Unit normals [N, 3] at points on it."""
        if self.waves is None:
            return np.broadcast_to(self.normal, points.shape)
        offset, axes = points - self.center, np.stack([self.tangent, self.bitangent])
        turned = self.normal - self.waves.slopes(offset @ axes.T) @ axes
        return turned / np.linalg.norm(turned, axis=1, keepdims=True)

    def meeting(self, origins: Array, directions: Array, distances: Array) -> Meeting:
        """What happens at the pane to rays that meet it after distances [N]."""
        points = origins + distances[:, None] * directions
        normals = self.normals(points)
        mirrored = directions - 2 * (directions * normals).sum(axis=1, keepdims=True) * normals
        return Meeting(points, mirrored, self.reflectances(np.abs(directions @ self.normal)))

    def meetings(self, origins: Array, directions: Array, distances: Array) -> list[Meeting]:
        """The same for each pane of double glazing; light that goes to and fro between the two is left out."""
        first = self.meeting(origins, directions, distances)
        if self.second is None:
            return [first]
        other = self.second_pane(self.second)
        to_other = ((other.center - origins) @ other.normal) / (directions @ other.normal)
        behind = other.meeting(origins, directions, to_other)
        passed = first.share * (1 - first.share) ** 2
        in_front = directions @ self.normal < 0
        return [
            first._replace(share=np.where(in_front, first.share, passed)),
            behind._replace(share=np.where(in_front, passed, first.share)),
        ]

    def second_pane(self, second: SecondPane) -> Pane:
        """The other one by itself."""
        turned = np.cos(second.tilt_rad) * self.normal + np.sin(second.tilt_rad) * self.bitangent
        return replace(self, center=self.center - second.gap * self.normal, normal=turned, second=None)
