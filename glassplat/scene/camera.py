"""A pinhole camera with OpenCV axes: +x right, +y down, +z forward, pixel centres at +0.5."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from glassplat.scene.pose import look_at
from glassplat.scene.transfer import constant, moved


@dataclass(frozen=True)
class Camera:
    """One pinhole view of the world.

    Attributes:
        cam_from_world: [4, 4] rigid transform, world to camera. A mirrored camera is left-handed
            (determinant -1); its upper 3x3 block is orthogonal all the same.
        fx, fy, cx, cy: intrinsics in pixels.
        width, height: image size in pixels.
    """

    cam_from_world: Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @staticmethod
    def look_at(
        eye: Tensor | Sequence[float],
        target: Tensor | Sequence[float],
        *,
        up: Tensor | Sequence[float],
        fov_rad: float = math.radians(50),
        width: int = 960,
        height: int = 640,
    ) -> Camera:
        """An upright camera at `eye` that looks at `target`, with square pixels and the principal point in the middle.

        Args:
            eye: [3] camera centre, world units.
            target: [3] what is in the middle of the picture.
            up: [3] away from the ground; (0, -1, 0) in most captures.
            fov_rad: vertical field of view, radians.
            width: of the image, pixels.
            height: of the image, pixels.

        Raises:
            ValueError: the camera stands where it looks, or looks straight up or down.
        """
        pose = look_at(*(torch.as_tensor(vector, dtype=torch.float64) for vector in (eye, target, up)))
        focal = height / 2 / math.tan(fov_rad / 2)
        return Camera(pose, focal, focal, width / 2, height / 2, width, height)

    @property
    def intrinsics(self) -> Tensor:
        """[4] tensor (fx, fy, cx, cy)."""
        matrix = self.cam_from_world
        return constant((self.fx, self.fy, self.cx, self.cy), matrix.dtype, matrix.device)

    @property
    def center(self) -> Tensor:
        """[3] camera centre in the world."""
        return -self.cam_from_world[:3, :3].T @ self.cam_from_world[:3, 3]

    def to(self, device: torch.device | str) -> Camera:
        """The same camera on another device."""
        pose = moved(self.cam_from_world, device)
        return self if pose is self.cam_from_world else replace(self, cam_from_world=pose)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera over another pixel grid that spans the same image."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy, width=width, height=height
        )

    def ray_directions(self) -> Tensor:
        """[H, W, 3] unit world-space directions through the pixel centres."""
        matrix = self.cam_from_world
        x = (torch.arange(self.width, dtype=matrix.dtype, device=matrix.device) + 0.5 - self.cx) / self.fx
        y = (torch.arange(self.height, dtype=matrix.dtype, device=matrix.device) + 0.5 - self.cy) / self.fy
        in_camera = torch.stack(
            [x.expand(self.height, -1), y[:, None].expand(-1, self.width), torch.ones_like(x).expand(self.height, -1)],
            dim=-1,
        )
        in_world = in_camera @ matrix[:3, :3]
        return in_world / in_world.norm(dim=-1, keepdim=True)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel positions [P, 2] and depths [P] (camera z) of world points [P, 3]."""
        in_camera = points @ self.cam_from_world[:3, :3].T + self.cam_from_world[:3, 3]
        depth = in_camera[:, 2]
        safe = torch.where(depth.abs() < 1e-12, torch.full_like(depth, 1e-12), depth)
        u = self.fx * in_camera[:, 0] / safe + self.cx
        v = self.fy * in_camera[:, 1] / safe + self.cy
        return torch.stack([u, v], dim=-1), depth
