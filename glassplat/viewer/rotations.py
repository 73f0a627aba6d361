"""Rotations as viser has them: quaternions `wxyz`."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from glassplat.scene.pose import rotation_from_quat


def matrix_of(wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] of a quaternion [4] of any length."""
    matrix: NDArray[np.float64] = rotation_from_quat(torch.from_numpy(np.asarray(wxyz, dtype=np.float64))).numpy()
    return matrix


def wxyz_of(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4] of a rotation [3, 3], with w >= 0."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(matrix).as_quat(canonical=True)
    return np.array([w, x, y, z])
