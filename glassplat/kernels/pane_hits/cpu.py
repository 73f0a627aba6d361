"""Rays against rectangles on the CPU, row by row: everything but one division is affine along a row."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.composite.cpu_tile import TILE
from glassplat.kernels.cpu.jit import Kernel, kernel
from glassplat.kernels.panes import PaneHits
from glassplat.kernels.tensor_checks import REAL_OF


def pane_hits(
    inputs: Sequence[Tensor], width: int, height: int, mask: Tensor | None, beyond: PaneHits | None
) -> PaneHits:
    """Nearest panes, from the fields of `Panes` and the intrinsics."""
    centers = inputs[0]
    count, real = centers.shape[0], REAL_OF[centers.dtype]
    index = torch.empty(height, width, dtype=torch.int32)
    depth = centers.new_empty(height, width)
    tiles = torch.zeros(count, -(-height // TILE), -(-width // TILE), dtype=torch.bool)
    windows = centers.new_zeros(count, 4)
    visible = centers.new_empty(0, 0) if mask is None else mask
    before = (index.new_empty(0, 0), centers.new_empty(0, 0)) if beyond is None else (beyond.pane, beyond.depth)
    tensors = (*inputs, visible, *before, index, depth, tiles, windows)
    pane_hits_forward(real)(*(tensor.numpy() for tensor in tensors))
    return PaneHits(index, depth, tiles, windows)


@cache
def pane_hits_forward(real: type) -> Kernel:
    """Fills the index, the depth, the tiles and the windows of the panes."""
    half, one, zero, far = real(0.5), real(1.0), real(0.0), real(np.inf)

    @kernel("pane_hits", real)
    def forward(
        centers, normals, axes, half_sizes, intrinsics, mask, before, depth_before, index, depth_of, tiles, windows
    ):  # fmt: skip
        height, width = index.shape
        count = centers.shape[0]
        spans: NDArray[Any] = np.empty((height, count, 2), np.int32)
        for tile_row in prange((height + TILE - 1) // TILE):
            least: NDArray[Any] = np.zeros(width, real)
            own: NDArray[Any] = np.full(width, -1, np.int32)
            for row in range(tile_row * TILE, min(height, tile_row * TILE + TILE)):
                y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
                nearest = depth_of[row]
                nearest[:] = far
                index[row, :] = -1
                if before.size:
                    least[:], own[:] = depth_before[row], before[row]
                for k in range(count):
                    n, u, v, c = normals[k], axes[k, 0], axes[k, 1], centers[k]
                    distance = c[0] * n[0] + c[1] * n[1] + c[2] * n[2]
                    along_u, along_v = c[0] * u[0] + c[1] * u[1] + c[2] * u[2], c[0] * v[0] + c[1] * v[1] + c[2] * v[2]
                    n_x, n_row = n[0], n[1] * y + n[2]
                    u_x, u_row = u[0], u[1] * y + u[2]
                    v_x, v_row = v[0], v[1] * y + v[2]
                    most_u, most_v = half_sizes[k, 0], half_sizes[k, 1]
                    inverse_f, c_x = one / intrinsics[0], intrinsics[2]
                    for column in range(width):
                        x = (real(np.int32(column)) + half - c_x) * inverse_f
                        depth = distance / (n_x * x + n_row)
                        inside = (depth > least[column]) & (depth < nearest[column]) & (own[column] != k)
                        inside &= abs(depth * (u_x * x + u_row) - along_u) <= most_u
                        inside &= abs(depth * (v_x * x + v_row) - along_v) <= most_v
                        nearest[column] = depth if inside else nearest[column]
                        index[row, column] = np.int32(k) if inside else index[row, column]
                spans[row, :, 0], spans[row, :, 1] = width, -1
                for column in range(width):
                    k = index[row, column]
                    if k >= 0 and (mask.size == 0 or mask[row, column] > zero):
                        tiles[k, tile_row, column // TILE] = True
                        spans[row, k, 0] = min(spans[row, k, 0], column)
                        spans[row, k, 1] = column
        for k in range(count):
            left, top, right, bottom = width, height, 0, 0
            for row in range(height):
                if spans[row, k, 1] >= 0:
                    left, right = min(left, spans[row, k, 0]), max(right, spans[row, k, 1] + 1)
                    top, bottom = min(top, row), row + 1
            if right > 0:
                windows[k, 0], windows[k, 1], windows[k, 2], windows[k, 3] = left, top, right, bottom

    return forward
