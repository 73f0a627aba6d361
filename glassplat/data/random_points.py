"""Points for captures that come without any: random, but always the same."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from glassplat.data.capture import RawPoints

if TYPE_CHECKING:
    from glassplat.scene.camera import Camera

GREY = 128
SPHERE_COUNT = 20_000
BOX_COUNT = 100_000
BOX_HALF_SIZE = 1.3
SEED = 0
LEAST_CROSSING = 1e-2
"""Smallest eigenvalue of the mean of I - d d^T for which optical axes are taken to cross (about 6 degrees apart)."""
MOST_CAMERAS = 0.8
"""Share of the cameras that must see the crossing in front of them; fewer do in a room photographed from its middle."""
AHEAD = 3.0
"""How far ahead points are placed otherwise, in radii of the camera path."""


def points_in_box(count: int = BOX_COUNT, half_size: float = BOX_HALF_SIZE) -> RawPoints:
    """Uniform points in a cube about the origin; the default is what synthetic Blender scenes fit in."""
    positions = np.random.default_rng(SEED).uniform(-half_size, half_size, (count, 3))
    return RawPoints.from_arrays(positions, np.full((count, 3), GREY))


def points_in_view(cameras: Sequence[Camera], count: int = SPHERE_COUNT) -> RawPoints:
    """Uniform points in a ball about what the cameras look at, reaching as far as the cameras stand away."""
    centers = np.stack([camera.center.double().numpy() for camera in cameras])
    forward = np.stack([camera.cam_from_world[2, :3].double().numpy() for camera in cameras])
    target, radius = _ball(centers, forward)
    generator = np.random.default_rng(SEED)
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = radius * generator.uniform(size=(count, 1)) ** (1 / 3)
    return RawPoints.from_arrays(target + distances * directions, np.full((count, 3), GREY))


def _ball(centers: NDArray[np.float64], forward: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Centre and radius: about the crossing of the optical axes, or ahead of cameras whose axes do not cross."""
    projectors = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    mean = projectors.mean(axis=0)
    if np.linalg.eigvalsh(mean)[0] > LEAST_CROSSING:
        target = np.linalg.solve(mean, (projectors @ centers[:, :, None])[:, :, 0].mean(axis=0))
        ahead = ((target - centers) * forward).sum(axis=1)
        if np.mean(ahead > 0) > MOST_CAMERAS:
            return target, float(np.median(np.linalg.norm(centers - target, axis=1)))
    middle = centers.mean(axis=0)
    reach = AHEAD * float(np.linalg.norm(centers - middle, axis=1).max())
    return middle + reach * forward.mean(axis=0), reach
