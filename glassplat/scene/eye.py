"""A camera in NumPy: where it sees points, and what its pixels look along."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from glassplat.scene.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Eye:
    """A pinhole camera.

    Attributes:
        rotation: [3, 3] of `cam_from_world`.
        center: [3] in the world.
        intrinsics: [4] fx, fy, cx, cy in pixels.
        size: [2] width and height in pixels.
    """

    rotation: Array
    center: Array
    intrinsics: Array
    size: Array

    @staticmethod
    def of(camera: Camera) -> Eye:
        """The same camera."""
        pose = camera.cam_from_world.detach().cpu().double().numpy()
        return Eye(
            rotation=pose[:3, :3],
            center=-pose[:3, :3].T @ pose[:3, 3],
            intrinsics=np.array([camera.fx, camera.fy, camera.cx, camera.cy], dtype=np.float64),
            size=np.array([camera.width, camera.height], dtype=np.float64),
        )

    @property
    def diagonal(self) -> float:
        """Of the image, in pixels."""
        return float(np.hypot(*self.size))

    def in_camera(self, points: Array) -> Array:
        """[..., 3] world points in the camera's axes, +z forward."""
        return np.asarray((points - self.center) @ self.rotation.T)

    def pixels(self, in_camera: Array) -> Array:
        """[..., 2] of points [..., 3] in the camera's axes; those behind it are mirrored, as the formula has it."""
        fx, fy, cx, cy = self.intrinsics
        depth = np.where(np.abs(in_camera[..., 2]) < 1e-12, 1e-12, in_camera[..., 2])
        return np.stack([fx * in_camera[..., 0] / depth + cx, fy * in_camera[..., 1] / depth + cy], axis=-1)

    def project(self, points: Array) -> Array:
        """[..., 2] pixels of world points [..., 3]."""
        return self.pixels(self.in_camera(points))

    def rays(self, pixels: Array) -> Array:
        """[..., 3] unit world directions through pixels [..., 2], which may lie outside of the image."""
        fx, fy, cx, cy = self.intrinsics
        x, y = (pixels[..., 0] - cx) / fx, (pixels[..., 1] - cy) / fy
        world = np.stack([x, y, np.ones_like(x)], axis=-1) @ self.rotation
        return np.asarray(world / np.linalg.norm(world, axis=-1, keepdims=True))

    def holds(self, points: Array, margin: float = 0.0) -> NDArray[np.bool_]:
        """[...] which world points lie in the image, or up to `margin` of its sides beside it."""
        in_camera = self.in_camera(points)
        pixels = self.pixels(in_camera)
        room = margin * self.size
        return np.asarray(
            (in_camera[..., 2] > 0) & (pixels >= -room).all(axis=-1) & (pixels < self.size + room).all(axis=-1)
        )
