"""Normals as a network estimates them from one photograph: the true ones, off by an error that varies slowly over it.

What networks do to mirrors, of which some are taken for what they mirror, is not imitated.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom

Array = NDArray[np.floating]

WAVES = 4
"""Turns are drawn at as many places along each side of a picture, and are smooth between them."""
BLUR = 1 / 100
"""Standard deviation of the blur of normals, of the picture's width: networks round edges off."""


def estimated_normals(normals: Array, coverage: Array, error_deg: float, random: np.random.Generator) -> Array:
    """Normals that an estimator would give for one photograph.

    Args:
        normals: [S, S, 3] true unit normals in the camera's axes; zero where nothing is.
        coverage: [S, S] share of each pixel that shows something.
        error_deg: mean angle between the true and the estimated normals.
        random: where the error comes from.

    Returns:
        [S, S, 3] unit normals; zero where less than half of a pixel is covered.
    """
    turned = rotated(normals, smooth_turns(normals.shape[0], math.radians(error_deg), random))
    blurred = gaussian_filter(turned * coverage[..., None], (BLUR * len(normals), BLUR * len(normals), 0))
    lengths = np.linalg.norm(blurred, axis=-1, keepdims=True)
    return np.where(coverage[..., None] >= 0.5, blurred / np.maximum(lengths, 1e-9), 0.0)


def smooth_turns(size: int, error_rad: float, random: np.random.Generator) -> Array:
    """Rotation vectors [S, S, 3] that turn the directions of a picture by `error_rad` on average."""
    coarse = random.standard_normal((WAVES, WAVES, 3))
    field = zoom(coarse, (size / WAVES, size / WAVES, 1), order=3, mode="nearest", grid_mode=True)
    # Two of three components turn a direction, and the length of two normal numbers is sqrt(pi / 2) on average.
    return field * error_rad / (field.std() * math.sqrt(math.pi / 2))


def rotated(vectors: Array, turns: Array) -> Array:
    """Vectors [..., 3] turned about rotation vectors [..., 3] (Rodrigues)."""
    angle = np.linalg.norm(turns, axis=-1, keepdims=True)
    axis = turns / np.maximum(angle, 1e-12)
    along = (axis * vectors).sum(axis=-1, keepdims=True) * axis
    return vectors * np.cos(angle) + np.cross(axis, vectors) * np.sin(angle) + along * (1 - np.cos(angle))
