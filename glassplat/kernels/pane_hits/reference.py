"""The definition of `pane_hits`: every ray against every rectangle."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.composite.cpu_tile import TILE
from glassplat.kernels.panes import PaneHits, Panes


def pane_hits(
    panes: Panes,
    intrinsics: Tensor,
    width: int,
    height: int,
    mask: Tensor | None = None,
    *,
    beyond: PaneHits | None = None,
) -> PaneHits:
    """See `glassplat.kernels.pane_hits.pane_hits`."""
    rays = ray_grid(intrinsics, width, height)
    count = panes.centers.shape[0]
    distance = (panes.centers * panes.normals).sum(-1)
    depth = distance[:, None, None] / torch.einsum("hwi,ki->khw", rays, panes.normals)
    inside = depth > 0
    for axis in range(2):
        along = torch.einsum("hwi,ki->khw", rays, panes.axes[:, axis]) * depth
        offset = along - (panes.centers * panes.axes[:, axis]).sum(-1)[:, None, None]
        inside &= offset.abs() <= panes.half_sizes[:, axis, None, None]
    if beyond is not None:
        # A pane is not behind itself, however its depth is rounded.
        own = beyond.pane == torch.arange(count, device=beyond.pane.device)[:, None, None]
        inside &= (depth > beyond.depth) & ~own
    far = torch.full((1, height, width), torch.inf, dtype=rays.dtype)
    nearest, index = torch.cat([far, torch.where(inside, depth, torch.inf)]).min(dim=0)
    index = torch.where(nearest < torch.inf, index, 0) - 1
    shown = torch.stack([index == k for k in range(count)]) if count else torch.zeros(0, height, width).bool()
    if mask is not None:
        shown &= mask > 0
    tiles = torch.nn.functional.max_pool2d(shown.float()[:, None], TILE, ceil_mode=True)[:, 0] > 0
    windows = torch.zeros(count, 4, dtype=rays.dtype)
    for k in range(count):
        rows, columns = shown[k].nonzero().unbind(-1)
        if len(rows):
            windows[k] = torch.stack([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
    return PaneHits(index.to(torch.int32), nearest, tiles, windows)


def ray_grid(intrinsics: Tensor, width: int, height: int) -> Tensor:
    """Rays [H, W, 3] through the pixel centres, (x, y, 1) in the camera frame."""
    fx, fy, cx, cy = intrinsics
    x = (torch.arange(width, dtype=intrinsics.dtype, device=intrinsics.device) + 0.5 - cx) / fx
    y = (torch.arange(height, dtype=intrinsics.dtype, device=intrinsics.device) + 0.5 - cy) / fy
    plane = x.expand(height, width)
    return torch.stack([plane, y[:, None].expand(height, width), torch.ones_like(plane)], dim=-1)
