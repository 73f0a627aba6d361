"""Camera poses are checked once, here, before anything is computed from them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from glassplat.data.errors import InputError
from glassplat.files.fields import LARGEST_COORDINATE

ORTHOGONALITY_TOLERANCE = 1e-2
"""Largest entry of R R^T - I that passes as rounding in the file."""


def rigid_pose(matrix: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """The pose [4, 4] with its rotation made exactly orthogonal, its camera centre or origin unchanged.

    Args:
        matrix: [4, 4] or [3, 4] rigid transform as read from a file.
        name: photograph, for the message.

    Raises:
        InputError: not finite or absurdly far away, not a rotation (scaled, sheared or mirrored), or of another shape.
    """
    if matrix.shape not in ((3, 4), (4, 4)):
        raise InputError(f"the pose of {name} has shape {list(matrix.shape)}; expected a 4x4 or 3x4 matrix")
    if not np.isfinite(matrix).all():
        raise InputError(f"the pose of {name} holds values that are not finite; remove this photograph from the model")
    if not (np.abs(matrix) <= LARGEST_COORDINATE).all():
        raise InputError(
            f"the pose of {name} holds the value {np.abs(matrix).max():g}; expected world units of at most "
            f"{LARGEST_COORDINATE:g}"
        )
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise InputError(f"the last row of the pose of {name} is {matrix[3].tolist()}; expected [0, 0, 0, 1]")
    pose = np.eye(4)
    pose[:3, 3] = matrix[:3, 3]
    pose[:3, :3] = _nearest_rotation(matrix[:3, :3], name)
    return pose


def _nearest_rotation(linear: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """The rotation closest to a matrix that is one up to rounding."""
    deviation = float(np.abs(linear @ linear.T - np.eye(3)).max())
    determinant = float(np.linalg.det(linear))
    if deviation > ORTHOGONALITY_TOLERANCE or determinant < 0:
        raise InputError(
            f"the pose of {name} is not rigid: its 3x3 block deviates from a rotation by {deviation:.3g} and has "
            f"determinant {determinant:.3g}; expected an orthogonal matrix of determinant 1, without scale or mirroring"
        )
    left, _, right = np.linalg.svd(linear)
    return left @ right
