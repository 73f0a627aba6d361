"""Keeping discs on one surface: their distances along a pixel's ray, and their normals (2DGS, Section 4.2)."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.data.dataset import View
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
    inner = slice(1, -1), slice(1, -1)
    from_depth = _normals_in_camera(frame.layers["depth"], view.camera)
    to_camera = view.camera.cam_from_world[:3, :3].T.to(frame.layers["normal"])
    blended = (frame.layers["normal"][inner] @ to_camera).unbind(-1)
    agreement = sum(a * b for a, b in zip(blended, from_depth, strict=True))
    return (frame.layers["alpha"][inner] - agreement).mean()


def depth_map_normals(depth: Tensor, camera: Camera) -> Tensor:
    """Unit normals [H - 2, W - 2, 3] of a depth map [H, W], world axes, towards the camera; zero where it is empty."""
    normals = torch.stack(_normals_in_camera(depth, camera), dim=-1)
    return normals @ camera.cam_from_world[:3, :3].to(depth)


def _normals_in_camera(depth: Tensor, camera: Camera) -> tuple[Tensor, Tensor, Tensor]:
    """The same in camera axes, one image per coordinate: in that layout every operation runs over a contiguous one."""
    x = (torch.arange(camera.width, device=depth.device) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, device=depth.device) + 0.5 - camera.cy) / camera.fy
    points = depth * x.to(depth), depth * y.to(depth)[:, None], depth
    a_x, a_y, a_z = (p[1:-1, 2:] - p[1:-1, :-2] for p in points)
    d_x, d_y, d_z = (p[2:, 1:-1] - p[:-2, 1:-1] for p in points)
    # In a frame with x to the right, y down and z forward, down x along points to the camera.
    n_x, n_y, n_z = d_y * a_z - d_z * a_y, d_z * a_x - d_x * a_z, d_x * a_y - d_y * a_x
    squared = n_x * n_x + n_y * n_y + n_z * n_z
    inverse = torch.where(squared > 0, squared, torch.inf).rsqrt()
    return n_x * inverse, n_y * inverse, n_z * inverse
