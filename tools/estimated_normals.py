"""Simulated normals of a monocular estimator: the true normals with an error that varies slowly over the image.

The typical failure of networks on mirrors, whose reflections they treat as geometry, is not simulated.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom

Array = NDArray[np.floating]

WAVES = 4
"""Number of random rotations along each side of an image, with smooth interpolation between them."""
BLUR = 1 / 100
"""Standard deviation of the blur of normals, as a share of the image width: networks smooth edges."""


def estimated_normals(normals: Array, coverage: Array, error_deg: float, random: np.random.Generator) -> Array:
    """Simulated estimate of normals for one photograph.

    Args:
        normals: [S, S, 3] true unit normals in camera axes; zero on the background.
        coverage: [S, S] share of each pixel that is covered by the scene.
        error_deg: mean angle between the true and the estimated normals.
        random: generator of the error.

    Returns:
        [S, S, 3] unit normals; zero where less than half of a pixel is covered.
    """
    turned = rotated(normals, smooth_turns(normals.shape[0], math.radians(error_deg), random))
    blurred = gaussian_filter(turned * coverage[..., None], (BLUR * len(normals), BLUR * len(normals), 0))
    lengths = np.linalg.norm(blurred, axis=-1, keepdims=True)
    return np.where(coverage[..., None] >= 0.5, blurred / np.maximum(lengths, 1e-9), 0.0)


def smooth_turns(size: int, error_rad: float, random: np.random.Generator) -> Array:
    """Rotation vectors [S, S, 3] that turn the directions of an image by `error_rad` on average."""
    coarse = random.standard_normal((WAVES, WAVES, 3))
    field = zoom(coarse, (size / WAVES, size / WAVES, 1), order=3, mode="nearest", grid_mode=True)
    # Two of three components turn a direction, and the length of two normal numbers is sqrt(pi / 2) on average.
    return field * error_rad / (field.std() * math.sqrt(math.pi / 2))


def rotated(vectors: Array, turns: Array) -> Array:
    """Vectors [..., 3] rotated by rotation vectors [..., 3] (Rodrigues)."""
    angle = np.linalg.norm(turns, axis=-1, keepdims=True)
    axis = turns / np.maximum(angle, 1e-12)
    along = (axis * vectors).sum(axis=-1, keepdims=True) * axis
    return vectors * np.cos(angle) + np.cross(axis, vectors) * np.sin(angle) + along * (1 - np.cos(angle))
