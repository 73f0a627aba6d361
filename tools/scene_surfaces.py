"""Shapes and textures of the reflective scenes, made in NumPy: meshes with normals, and images of solid patterns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]

WAVES = 48
CHECKER_SIZE = 0.2
"""Side of the checkerboard squares of the ground, world units."""
INK = np.array([[0.08, 0.22, 0.45], [0.62, 0.25, 0.10], [0.80, 0.70, 0.42], [0.12, 0.36, 0.20], [0.72, 0.72, 0.70]])
"""Palette of textures, linear reflectances [5, 3]."""


@dataclass(frozen=True)
class Triangles:
    """A mesh with smooth normals.

    Attributes:
        positions: [V, 3], world units.
        normals: [V, 3], unit, outwards.
        coordinates: [V, 2] texture coordinates in [0, 1].
        faces: [F, 3] indices, counter-clockwise seen from outside.
    """

    positions: Array
    normals: Array
    coordinates: Array
    faces: NDArray[np.int64]


def disc(radius: float, z: float, segments: int = 256) -> Triangles:
    """A horizontal disc about the z axis that faces up; its texture spans the square around it."""
    angle = 2 * np.pi * np.arange(segments) / segments
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    flat = np.concatenate([np.zeros((1, 2)), rim])
    positions = np.concatenate([radius * flat, np.full((segments + 1, 1), z)], axis=1)
    normals = np.broadcast_to([0.0, 0.0, 1.0], positions.shape)
    around = np.arange(segments)
    faces = np.stack([np.zeros(segments, dtype=np.int64), 1 + around, 1 + (around + 1) % segments], axis=1)
    return Triangles(positions, normals, (flat + 1) / 2, faces)


def torus(major: float, minor: float, tilt_deg: float, rings: int = 320, segments: int = 160) -> Triangles:
    """A torus about the origin whose axis leans from +z by `tilt_deg`, towards -y.

    Args:
        major: radius of the circle that the tube follows, world units.
        minor: radius of the tube.
        tilt_deg: angle between the axis of the torus and +z.
        rings: vertices around the axis.
        segments: vertices around the tube.
    """
    around, tube = np.meshgrid(
        2 * np.pi * np.arange(rings) / rings, 2 * np.pi * np.arange(segments) / segments, indexing="ij"
    )
    normals = np.stack([np.cos(tube) * np.cos(around), np.cos(tube) * np.sin(around), np.sin(tube)], axis=-1)
    centers = major * np.stack([np.cos(around), np.sin(around), np.zeros_like(around)], axis=-1)
    cosine, sine = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    lean = np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])
    coordinates = np.stack([around, tube], axis=-1) / (2 * np.pi)
    ring, segment = np.meshgrid(np.arange(rings), np.arange(segments), indexing="ij")
    next_ring, next_segment = (ring + 1) % rings, (segment + 1) % segments
    here, along = ring * segments + segment, next_ring * segments + segment
    across, opposite = ring * segments + next_segment, next_ring * segments + next_segment
    faces = np.concatenate([np.stack([here, along, opposite], -1), np.stack([here, opposite, across], -1)], axis=0)
    return Triangles(
        positions=(centers + minor * normals).reshape(-1, 3) @ lean.T,
        normals=normals.reshape(-1, 3) @ lean.T,
        coordinates=coordinates.reshape(-1, 2),
        faces=faces.reshape(-1, 3),
    )


def torus_depth(major: float, minor: float, tilt_deg: float) -> float:
    """Depth of the lowest point of `torus` below the origin, world units."""
    return major * float(np.sin(np.radians(tilt_deg))) + minor


def star_shaped(radius_along: Callable[[Array], Array], rings: int = 320, segments: int = 160) -> Triangles:
    """A closed surface about the origin that every ray from there hits exactly once.

    Args:
        radius_along: distance [...] of the surface in unit directions [..., 3]; smooth, for the sake of the normals.
        rings: vertices around +z.
        segments: vertices from pole to pole.
    """
    azimuth, polar = np.meshgrid(
        2 * np.pi * np.arange(rings + 1) / rings, np.pi * np.arange(segments + 1) / segments, indexing="ij"
    )
    directions = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    positions = directions * radius_along(directions)[..., None]
    corner = (np.arange(rings)[:, None] * (segments + 1) + np.arange(segments)).ravel()
    beside, below = corner + segments + 1, corner + 1
    faces = np.concatenate([np.stack([corner, below, beside + 1], -1), np.stack([corner, beside + 1, beside], -1)])
    return Triangles(
        positions=positions.reshape(-1, 3),
        normals=_star_normals(positions.reshape(-1, 3), radius_along),
        coordinates=np.stack([azimuth / (2 * np.pi), polar / np.pi], axis=-1).reshape(-1, 2),
        faces=faces,
    )


def _star_normals(positions: Array, radius_along: Callable[[Array], Array]) -> Array:
    """Unit normals [V, 3]: the gradient of |p| - radius(p / |p|), by central differences."""

    def excess(points: Array) -> Array:
        distances = np.linalg.norm(points, axis=-1)
        return distances - radius_along(points / distances[..., None])

    slopes = np.stack([excess(positions + offset) - excess(positions - offset) for offset in 1e-4 * np.eye(3)], -1)
    return np.asarray(slopes / np.linalg.norm(slopes, axis=-1, keepdims=True))


def placed(triangles: Triangles, turn: Array, offset: Array) -> Triangles:
    """The mesh rotated by `turn` [3, 3] about the origin, then moved by `offset` [3]."""
    return replace(triangles, positions=triangles.positions @ turn.T + offset, normals=triangles.normals @ turn.T)


def solid_noise(points: Array, frequency: float, seed: int, waves: int = WAVES) -> Array:
    """Smooth 3D noise [...] in about [0, 1] at points [..., 3].

    A solid pattern has neither seams nor poles on any surface.

    Args:
        points: positions in world units.
        frequency: typical waves per world unit.
        seed: random seed of the pattern.
        waves: number of summed waves; fewer are faster, but less uniform.
    """
    generator = np.random.default_rng(seed)
    vectors = generator.normal(scale=2 * np.pi * frequency / np.sqrt(3), size=(waves, 3))
    phases = generator.uniform(0, 2 * np.pi, waves)
    total = np.zeros(points.shape[:-1])
    for vector, phase in zip(vectors, phases, strict=True):
        total += np.cos(points @ vector + phase)
    return 0.5 + total / np.sqrt(8 * waves)


def ground_texture(
    radius: float, size: int, *, checker_size: float = CHECKER_SIZE, seed: int = 1
) -> NDArray[np.float32]:
    """Linear reflectance [size, size, 3] of the disc: a checkerboard of two patterns."""
    line = radius * (2 * (np.arange(size) + 0.5) / size - 1)
    x, y = np.meshgrid(line, line)
    points = np.stack([x, y, np.zeros_like(x)], axis=-1)
    light = (np.floor(x / checker_size) + np.floor(y / checker_size)) % 2 == 0
    patches = _patches(points, frequency=1.2, seed=seed)
    grain = 0.8 + 0.4 * solid_noise(points, frequency=9.0, seed=seed + 1)[..., None]
    shade = np.where(light[..., None], 0.35 + 0.65 * patches, 0.12 + 0.3 * patches[..., ::-1])
    return np.clip(shade * grain, 0.02, 0.9).astype(np.float32)


def ball_texture(size: int, *, seed: int = 3) -> NDArray[np.float32]:
    """Linear reflectance [size, 2 size, 3] of a matte ball: coloured patches with a fine grain."""
    azimuth = 2 * np.pi * (np.arange(2 * size) + 0.5) / (2 * size)
    polar = (np.pi * (np.arange(size) + 0.5) / size)[:, None]
    points = np.stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar) + 0 * azimuth], -1
    )
    grain = 0.7 + 0.6 * solid_noise(points, frequency=7.0, seed=seed + 1)[..., None]
    return np.clip(_patches(points, frequency=0.9, seed=seed) * grain, 0.02, 0.9).astype(np.float32)


def _patches(points: Array, *, frequency: float, seed: int) -> Array:
    """Patches in the colours of `INK` [..., 3] with sharp borders, at points [..., 3]."""
    level = solid_noise(points, frequency, seed)
    return INK[np.clip((level * len(INK)).astype(int), 0, len(INK) - 1)]
