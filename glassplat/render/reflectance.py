"""Where a camera's rays meet the planes, and how strongly they reflect there."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.scene.camera import Camera
from glassplat.scene.plane import Planes


class PixelGrid(NamedTuple):
    """Rays of a camera with unit camera z, as separable pixel coordinates.

    The ray of pixel (row, column) is (x[column], y[row], 1) in the camera frame, so the product of
    any world vector with every ray is an affine map over the image.
    """

    x: Tensor
    y: Tensor
    rotation: Tensor

    @staticmethod
    def of(camera: Camera) -> PixelGrid:
        """The grid of a camera's pixel centres."""
        pose = camera.cam_from_world
        columns = torch.arange(camera.width, dtype=pose.dtype, device=pose.device)
        rows = torch.arange(camera.height, dtype=pose.dtype, device=pose.device)
        return PixelGrid((columns + 0.5 - camera.cx) / camera.fx, (rows + 0.5 - camera.cy) / camera.fy, pose[:3, :3])

    def dot(self, vectors: Tensor) -> Tensor:
        """Products [K, H, W] of world vectors [K, 3] with every ray."""
        a, b, c = (vectors @ self.rotation.T).unbind(-1)
        along_rows = b[:, None] * self.y + c[:, None]
        return a[:, None, None] * self.x + along_rows[:, :, None]

    def lengths(self) -> Tensor:
        """Lengths [H, W] of the rays."""
        return torch.sqrt(self.x * self.x + (self.y * self.y + 1)[:, None])


def nearest_hits(planes: Planes, camera: Camera) -> Tensor:
    """Hit masks [K, H, W] bool: H_k of TR-Gaussians, Section III-A2.

    A pixel belongs to at most one plane: where rectangles overlap in the image the nearest wins.
    Not differentiable (piecewise constant).
    """
    if len(planes) == 0:
        return torch.zeros(0, camera.height, camera.width, dtype=torch.bool, device=camera.cam_from_world.device)
    with torch.no_grad():
        grid = PixelGrid.of(camera)
        normals = planes.normals
        to_center = planes.centers - camera.center
        facing = grid.dot(normals)
        distance = (to_center * normals).sum(-1)
        depth = distance[:, None, None] / facing
        inside = depth > 0
        for axis, half_size in zip(planes.axes(), planes.half_sizes.unbind(-1), strict=True):
            offset = depth * grid.dot(axis) - (to_center * axis).sum(-1)[:, None, None]
            inside &= offset.abs() <= half_size[:, None, None]
        if len(planes) < 2:
            return inside
        depth = torch.where(inside, depth, torch.full_like(depth, torch.inf))
        nearest = depth.argmin(dim=0)
        return inside & (torch.arange(len(planes), device=depth.device)[:, None, None] == nearest)


def schlick_strength(planes: Planes, camera: Camera) -> Tensor:
    """Raw reflection strength [K, H, W] by Schlick's approximation (TR-Gaussians, Eq. 6).

        R = R0 + (1 - R0) (1 - |n . d|)^5,   d the unit view direction

    Differentiable in the planes' normals and base reflectances.
    """
    grid = PixelGrid.of(camera)
    cosines = grid.dot(planes.normals).abs() / grid.lengths()
    base = planes.base_reflectances[:, None, None]
    grazing = 1 - cosines.clamp(max=1.0)
    squared = grazing * grazing
    return base + (1 - base) * squared * squared * grazing


def constant_strength(planes: Planes, camera: Camera) -> Tensor:
    """Strength [K, H, W] that ignores the angle: R = R0 (the ablation without Fresnel)."""
    return planes.base_reflectances[:, None, None].expand(len(planes), camera.height, camera.width)
