"""Brute-force reference of `glassplat.kernels.tiles.bin_tiles`, with the same name and signature.

It evaluates every pixel of every splat, so a tile is listed exactly if a pixel centre has coverage of at least 1/255.
The kernel may list a few more tiles, if the ellipse passes between pixel centres.
"""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.maths.blending import ALPHA_MIN
from glassplat.kernels.records import TILE, Splats, TileBins


@torch.no_grad()
def bin_tiles(splats: Splats, width: int, height: int, active_tiles: Tensor | None = None) -> TileBins:
    """Lists the splats of every tile; see `glassplat.kernels.tiles.bin_tiles`."""
    num_cameras, per_camera = splats.depths.shape
    covered = _covered_tiles(splats, width, height)
    if active_tiles is not None:
        covered &= active_tiles[:, None]
    _, _, rows, columns = covered.shape
    order = splats.depths.argsort(dim=1, stable=True)
    by_depth = covered.gather(1, order[:, :, None, None].expand_as(covered))
    camera, tile, rank = by_depth.flatten(2).permute(0, 2, 1).nonzero().unbind(dim=1)
    pair_splats = camera * per_camera + order[camera, rank]
    per_tile = torch.bincount(camera * rows * columns + tile, minlength=num_cameras * rows * columns)
    per_splat = torch.bincount(pair_splats, minlength=num_cameras * per_camera)
    tiles = torch.arange(num_cameras * rows * columns)
    return TileBins(
        pair_splats=pair_splats.to(torch.int32),
        tile_offsets=_offsets(per_tile),
        pair_slots=pair_splats.argsort(stable=True).to(torch.int32),
        splat_offsets=_offsets(per_splat),
        active=(tiles if active_tiles is None else tiles[active_tiles.flatten()]).to(torch.int32),
        width=width,
        height=height,
        num_cameras=num_cameras,
    )


def _offsets(counts: Tensor) -> Tensor:
    """Start of each group [len + 1], from the sizes."""
    return torch.cat([counts.new_zeros(1), counts.cumsum(0)])


def _covered_tiles(splats: Splats, width: int, height: int) -> Tensor:
    """Mask [C, G, rows, columns] of tiles with a pixel centre whose coverage is at least 1/255."""
    dtype = splats.means2d.dtype
    x, y = torch.arange(width, dtype=dtype) + 0.5, torch.arange(height, dtype=dtype) + 0.5
    dx = x - splats.means2d[..., 0, None, None]
    dy = y[:, None] - splats.means2d[..., 1, None, None]
    xx, xy, yy = splats.conics[..., None, None].unbind(dim=2)
    alpha = splats.opacities[..., None, None] * torch.exp(-0.5 * (xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy))
    touched = (alpha >= ALPHA_MIN) & (splats.radii[..., :1, None] > 0)
    pooled = torch.nn.functional.max_pool2d(touched.flatten(0, 1)[:, None].float(), TILE, ceil_mode=True)
    return pooled[:, 0].unflatten(0, splats.depths.shape) > 0
