"""Rays against rectangles on the GPU: one thread for each pixel, one block for each tile."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.cuda.launch import Kernel, kernel
from glassplat.kernels.panes import PaneHits
from glassplat.kernels.splats import TILE
from glassplat.kernels.tensor_checks import REAL_OF

PIXELS = TILE * TILE


def pane_hits(
    inputs: Sequence[Tensor], width: int, height: int, mask: Tensor | None, beyond: PaneHits | None
) -> PaneHits:
    """As `glassplat.kernels.pane_hits.cpu.pane_hits`."""
    centers = inputs[0]
    count, real = centers.shape[0], REAL_OF[centers.dtype]
    rows, columns = -(-height // TILE), -(-width // TILE)
    index = torch.empty(height, width, dtype=torch.int32, device=centers.device)
    depth = centers.new_empty(height, width)
    tiles = torch.zeros(count, rows, columns, dtype=torch.bool, device=centers.device)
    shown_columns, shown_rows = (tiles.new_zeros(count, size) for size in (width, height))
    before = (None, None) if beyond is None else (beyond.pane, beyond.depth)
    outputs = (index, depth, tiles, shown_columns, shown_rows)
    pane_hits_forward(real)(rows * columns, PIXELS, *inputs, mask, *before, *outputs)
    left, right = _edges(shown_columns)
    top, bottom = _edges(shown_rows)
    return PaneHits(index, depth, tiles, torch.stack([left, top, right, bottom], dim=1).to(centers.dtype))


def _edges(shown: Tensor) -> tuple[Tensor, Tensor]:
    """First and one-past-last true entry of each row [K, n]; 0 and 0 where there is none."""
    count, flags = shown.shape[1], shown.to(torch.int32)
    last = count - flags.flip(1).argmax(1)
    return flags.argmax(1), torch.where(shown.any(1), last, 0)


@cache
def pane_hits_forward(real: type) -> Kernel:
    """Fills the index and the depth, and marks tiles, columns and rows in which a pane is shown."""
    half, one, zero, far = real(0.5), real(1.0), real(0.0), real(np.inf)

    @kernel("pane_hits", real, "real2 real2 real3 real2 real1 real2 int2 real2 int2 real2 bool3 bool2 bool2")
    def forward(
        centers, normals, axes, half_sizes, intrinsics, mask, before, depth_before,
        index, depth_of, tiles, shown_columns, shown_rows,
    ):  # fmt: skip
        height, width = index.shape
        tile_columns = (width + TILE - 1) // TILE
        tile_row, tile_column = cuda.blockIdx.x // tile_columns, cuda.blockIdx.x % tile_columns
        row = tile_row * TILE + cuda.threadIdx.x // TILE
        column = tile_column * TILE + cuda.threadIdx.x % TILE
        if row >= height or column >= width:
            return
        x = (real(np.int32(column)) + half - intrinsics[2]) * (one / intrinsics[0])
        y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
        least, own = zero, -1
        if before.size:
            least, own = depth_before[row, column], before[row, column]
        nearest, hit = far, -1
        for k in range(centers.shape[0]):
            c_x, c_y, c_z = centers[k, 0], centers[k, 1], centers[k, 2]
            n_x, n_y, n_z = normals[k, 0], normals[k, 1], normals[k, 2]
            u_x, u_y, u_z = axes[k, 0, 0], axes[k, 0, 1], axes[k, 0, 2]
            v_x, v_y, v_z = axes[k, 1, 0], axes[k, 1, 1], axes[k, 1, 2]
            depth = (c_x * n_x + c_y * n_y + c_z * n_z) / (n_x * x + (n_y * y + n_z))
            along_u = depth * (u_x * x + (u_y * y + u_z)) - (c_x * u_x + c_y * u_y + c_z * u_z)
            along_v = depth * (v_x * x + (v_y * y + v_z)) - (c_x * v_x + c_y * v_y + c_z * v_z)
            within = abs(along_u) <= half_sizes[k, 0] and abs(along_v) <= half_sizes[k, 1]
            if within and k != own and least < depth < nearest:
                nearest, hit = depth, k
        index[row, column] = hit
        depth_of[row, column] = nearest
        if hit >= 0 and (mask.size == 0 or mask[row, column] > zero):
            # Many threads may write here, all of them the same.
            tiles[hit, tile_row, tile_column] = True
            shown_columns[hit, column] = True
            shown_rows[hit, row] = True

    return forward
