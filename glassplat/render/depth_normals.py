"""Which way the surface faces that a depth map describes."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.panes.reference import ray_grid
from glassplat.scene.camera import Camera

CELLS_ACROSS = 32
"""Cells along the longer side of an image; depths and normals are averaged over cells before they are compared."""
LEAST_COVERAGE = 0.5
STEEPEST = 0.15
"""Largest change of depth between neighbouring cells, as a share of the depth, that is a slope and not an edge."""


def cell_side(camera: Camera) -> int:
    """Pixels along the side of a cell."""
    return max(1, round(max(camera.width, camera.height) / CELLS_ACROSS))


def depth_normals(depth: Tensor, alpha: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Normals [h, w, 3] of a depth map's cells, world axes, facing the camera; and [h, w] 1 where they count, else 0.

    Args:
        depth: [H, W] along the optical axis.
        alpha: [H, W] coverage.
        camera: whose pixels they are.
    """
    side = cell_side(camera)
    covered = (alpha > LEAST_COVERAGE).to(depth.dtype)
    share = cell_means(covered[..., None], side)[..., 0]
    mean_depth = cell_means((depth * covered)[..., None], side)[..., 0] / share.clamp(min=1e-6)
    height, width = mean_depth.shape
    points = mean_depth[..., None] * ray_grid(camera.intrinsics.to(depth) / side, width, height)
    along, down = torch.zeros_like(points), torch.zeros_like(points)
    along[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    # In a frame with x to the right, y down and z forward, down x along points to the camera.
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, along), dim=-1)
    steepness = _most_nearby(mean_depth) + _most_nearby(-mean_depth)
    whole = (_most_nearby(1 - share) == 0) & (steepness < STEEPEST * mean_depth) & (normals.abs().sum(-1) > 0)
    rotation = camera.cam_from_world[:3, :3].to(depth)
    return normals @ rotation, whole.to(depth.dtype)


def cell_means(image: Tensor, side: int) -> Tensor:
    """Means [h, w, D] over the whole cells of an image [H, W, D]."""
    return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), side).permute(1, 2, 0)


def _most_nearby(image: Tensor) -> Tensor:
    """[h, w] largest value among each cell and its eight neighbours."""
    return torch.nn.functional.max_pool2d(image[None], 3, 1, 1)[0]
