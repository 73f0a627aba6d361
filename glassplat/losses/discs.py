"""Keeping discs on one surface: their distances along a pixel's ray, and their normals (2DGS, Section 4.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.data.dataset import View
from glassplat.kernels.pane_hits.reference import ray_grid
from glassplat.render.frame import Frame
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene


def distortion(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Depth distortion L_d (2DGS, Eq. 13, in NDC as there): the image mean of sum_{i<j} w_i w_j (m_i - m_j)^2."""
    return frame.layers["distortion"].mean()


def disc_normals(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Normal consistency L_n (2DGS, Eq. 14): the image mean of sum_i w_i (1 - n_i . N).

    N is the normal of the surface that the expected depths describe, from the pixels left and right, above and below.
    Both sides have a gradient. Pixels on the image's border have no N and are left out.
    """
    from_depth = depth_map_normals(frame.layers["depth"], view.camera)
    inner = slice(1, -1), slice(1, -1)
    agreement = (frame.layers["normal"][inner] * from_depth).sum(-1)
    return (frame.layers["alpha"][inner] - agreement).mean()


def depth_map_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Unit normals [H - 2, W - 2, 3] of a depth map [H, W], world axes, towards the camera; zero where it is empty."""
    points = depth[..., None] * ray_grid(camera.intrinsics.to(depth), camera.width, camera.height)
    along = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    # In a frame with x to the right, y down and z forward, down x along points to the camera.
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, along), dim=-1)
    return normals @ camera.cam_from_world[:3, :3].to(depth)
