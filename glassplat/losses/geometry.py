"""Where the primary Gaussians lie along a pixel's ray, and which way the surface faces."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.data.dataset import View
from glassplat.render.frame import Frame
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene

REACH = 2
"""Pixels over which depths are averaged and differentiated, to either side."""
LEAST_COVERAGE = 0.5
STEEPEST = 0.1
"""Largest change of depth across a window, as a share of the depth, that is a slope and not an edge."""


def depth_deviation_loss(frame: Frame, view: View, scene: Scene) -> Tensor:
    """Depth variance loss L_d over the hit mask (TR-Gaussians, Eq. 14).

    The image mean of H(u) sum_i |z_i - D_t(u)| w_i, the `deviation` layer, divided by the scene extent so that its
    weight does not depend on the capture's units.
    """
    return frame.layers["deviation"].mean() / scene.extent


def normal_consistency(frame: Frame, view: View, scene: Scene) -> Tensor:
    """How far the blended normals are from those of the surface that the depths describe (after 2DGS, Eq. 14).

    The image mean of alpha (1 - n . n_d): n is the layer `normal`, made unit, n_d the normal of the depth map after a
    blur. Only n has a gradient, so that the depths pull the normals and not the other way round. Pixels on an edge of
    the depth map, or with less than half coverage, do not count.
    """
    from_depth, trusted = depth_normals(frame.layers["depth"].detach(), frame.layers["alpha"].detach(), view.camera)
    blended = torch.nn.functional.normalize(frame.layers["normal"], dim=-1)
    return (trusted * frame.layers["alpha"].detach() * (1 - (blended * from_depth).sum(-1))).mean()


def depth_normals(depth: Tensor, alpha: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Normals [H, W, 3] of a depth map, world axes, facing the camera; and [H, W] 1 where they mean something, else 0.

    Args:
        depth: [H, W] along the optical axis.
        alpha: [H, W] coverage.
        camera: whose pixels they are.
    """
    camera = camera.to(depth.device)
    covered = (alpha > LEAST_COVERAGE).to(depth.dtype)
    blurred = _blurred(depth * covered) / _blurred(covered).clamp(min=1e-6)
    columns = torch.arange(camera.width, device=depth.device, dtype=depth.dtype) + 0.5
    rows = torch.arange(camera.height, device=depth.device, dtype=depth.dtype) + 0.5
    y, x = torch.meshgrid((rows - camera.cy) / camera.fy, (columns - camera.cx) / camera.fx, indexing="ij")
    points = blurred[..., None] * torch.stack([x, y, torch.ones_like(x)], dim=-1)
    along, down = torch.zeros_like(points), torch.zeros_like(points)
    along[:, REACH:-REACH] = points[:, 2 * REACH :] - points[:, : -2 * REACH]
    down[REACH:-REACH] = points[2 * REACH :] - points[: -2 * REACH]
    # In a frame with x to the right, y down and z forward, down x along points to the camera.
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, along), dim=-1)
    window = torch.nn.functional.max_pool2d
    low, high = -window(-blurred[None], 2 * REACH + 1, 1, REACH)[0], window(blurred[None], 2 * REACH + 1, 1, REACH)[0]
    whole = -window(-covered[None], 2 * REACH + 1, 1, REACH)[0]
    trusted = whole * (high - low < STEEPEST * blurred) * (normals.abs().sum(-1) > 0)
    return normals @ camera.cam_from_world[:3, :3].to(depth.dtype), trusted.to(depth.dtype)


def _blurred(image: Tensor) -> Tensor:
    """Means over windows of 2 REACH + 1 pixels."""
    return torch.nn.functional.avg_pool2d(image[None], 2 * REACH + 1, 1, REACH, count_include_pad=False)[0]
