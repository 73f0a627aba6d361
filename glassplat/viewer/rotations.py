"""Rotations as viser has them: quaternions `wxyz`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def matrix_of(wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] of a quaternion [4] of any length."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = wxyz
    matrix: NDArray[np.float64] = Rotation.from_quat([x, y, z, w]).as_matrix()
    return matrix


def wxyz_of(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4] of a rotation [3, 3], with w >= 0."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(matrix).as_quat(canonical=True)
    return np.array([w, x, y, z])
