"""Rotations and mirror matrices."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.scene.transfer import constant

LEAST_SINE = 1e-6
"""Of the angle between two directions that still tell which way is up."""


def rotation_from_quat(quats: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] in `wxyz` order, normalised here."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(*quats.shape[:-1], 3, 3)


def quat_product(left: Tensor, right: Tensor) -> Tensor:
    """Quaternions [..., 4], `wxyz`, of the rotations by `right` followed by `left`."""
    left_real, left_vector = left[..., :1], left[..., 1:]
    right_real, right_vector = right[..., :1], right[..., 1:]
    real = left_real * right_real - (left_vector * right_vector).sum(-1, keepdim=True)
    crossed = torch.linalg.cross(left_vector, right_vector)
    return torch.cat([real, left_real * right_vector + right_real * left_vector + crossed], dim=-1)


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """`cam_from_world` [4, 4], float32, of an upright camera at `eye` that looks at `target`, OpenCV axes.

    Args:
        eye: [3] camera centre, world units.
        target: [3] what is in the middle of the picture.
        up: [3] away from the ground, of any length.

    Raises:
        ValueError: the camera stands where it looks, or looks straight up or down.
    """
    eye, target, up = (vector.detach().to("cpu", torch.float64) for vector in (eye, target, up))
    forward = torch.nn.functional.normalize(target - eye, dim=0)
    right = torch.linalg.cross(forward, torch.nn.functional.normalize(up, dim=0))
    if not float(right.norm()) > LEAST_SINE:
        raise ValueError(
            f"a camera at {eye.tolist()} cannot look at {target.tolist()} with {up.tolist()} upwards; expected another "
            "place, and a direction that is not that of the view"
        )
    right = torch.nn.functional.normalize(right, dim=0)
    rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ eye
    return pose.float()


def mirror_matrices(centers: Tensor, normals: Tensor) -> Tensor:
    """Householder reflections [K, 4, 4] about planes through `centers` with unit `normals`.

    Maps a world point x to x - 2 ((x - c) . n) n (TR-Gaussians, Eq. 8). Its own inverse.
    Differentiable in both arguments.

    Args:
        centers: [K, 3] a point on each plane, world frame.
        normals: [K, 3] unit normals; the sign does not matter.
    """
    outer = normals[:, :, None] * normals[:, None, :]
    linear = torch.eye(3, dtype=normals.dtype, device=normals.device) - 2 * outer
    offset = 2 * (centers * normals).sum(-1, keepdim=True) * normals
    top = torch.cat([linear, offset[:, :, None]], dim=2)
    bottom = constant((0.0, 0.0, 0.0, 1.0), normals.dtype, normals.device)
    return torch.cat([top, bottom.expand(normals.shape[0], 1, 4)], dim=1)
