"""Rows of sums of (tile, splat) pairs, and the gradients of each splat from them in a fixed order."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, even_stride, kernel
from glassplat.kernels.backend.cpu_vector import item, store, vector_kind
from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.records import Splats, TileBins

CHUNK = 512
"""Splats per task."""

# Columns of a pair's row: the sum of g = v_alpha alpha over its pixels, and of g times powers of the offset from the
# mean; of |g| times the slope of the exponent to base 2, the probe's; and the gradients of its values.
G, G_X, G_Y, G_XX, G_XY, G_YY, PULL_X, PULL_Y, PAIR_VALUES = range(9)


def new_pair_rows(bins: TileBins, num_values: int, real: type) -> NDArray[Any]:
    """Room for one row per pair, flat.

    A kernel fills the rows of active tiles. Only where other tiles have pairs must the rest be zero beforehand.
    """
    width = tile.LANES * ((PAIR_VALUES + tile.GROUP * tile.groups_of(num_values) + tile.LANES - 1) // tile.LANES)
    size = len(bins.pair_splats) * width
    filled = len(bins.active) == len(bins.tile_offsets) - 1 or _pairs_of_active_tiles(bins) == len(bins.pair_splats)
    dtype = torch.float64 if real is np.float64 else torch.float32
    # Of PyTorch, because its arrays begin with a cache line, and a row is one.
    rows: NDArray[Any] = (torch.empty if filled else torch.zeros)(size, dtype=dtype).numpy()
    return rows


def _pairs_of_active_tiles(bins: TileBins) -> int:
    active = bins.active.long()
    return int((bins.tile_offsets[active + 1] - bins.tile_offsets[active]).sum())


def sum_pair_rows(
    rows: NDArray[Any], bins: TileBins, splats: Splats, num_values: int, probed: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means2d, conics, opacities, values [C, G, num_values] and probe [C, G, 2 or 0]: sums over tiles."""
    probe_width = 2 if probed else 0
    shape = tuple(splats.opacities.shape)
    widths = ((2,), (3,), (), (num_values,), (probe_width,))
    v_means, v_conics, v_opacities, v_values, v_probe = (splats.opacities.new_empty(*shape, *w) for w in widths)
    _sum_rows(tile.real_of(splats))(
        rows, bins.pair_slots.numpy(), bins.splat_offsets.numpy(),
        splats.conics.numpy().reshape(-1, 3), splats.opacities.numpy().reshape(-1),
        v_means.numpy().reshape(-1, 2), v_conics.numpy().reshape(-1, 3), v_opacities.numpy().reshape(-1),
        v_values.numpy().reshape(-1, num_values), v_probe.numpy().reshape(v_opacities.numel(), probe_width),
    )  # fmt: skip
    return v_means, v_conics, v_opacities, v_values, v_probe


@functools.cache
def _sum_rows(real: type) -> Kernel:
    full, load = vector_kind(real, tile.LANES)
    zero, half, nats, LANES = real(0.0), real(0.5), real(math.log(2.0)), tile.LANES

    @kernel("sum_pair_rows", real)
    def sum_rows(rows, slots, offsets, conics, opacities, v_means, v_conics, v_opacities, v_values, v_probe):
        count, width = offsets.size - 1, rows.size // max(1, slots.size)
        num_chunks = (count + CHUNK - 1) // CHUNK
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            begin, end = chunk * CHUNK, min(count, (chunk + 1) * CHUNK)
            v_means[begin:end], v_conics[begin:end], v_opacities[begin:end] = zero, zero, zero
            v_values[begin:end], v_probe[begin:end] = zero, zero
            total = np.empty(width, real)
            for s in range(begin, end):
                first, last = offsets[s], offsets[s + 1]
                if first == last:
                    continue
                for column in range(0, width, LANES):
                    part = full(zero)
                    for k in range(first, last):
                        part = part + load(rows, item(slots, k) * np.int64(width) + column)
                    store(total, column, part)
                for d in range(v_values.shape[1]):
                    v_values[s, d] = total[PAIR_VALUES + d]
                # alpha = opacity exp(-q / 2), q = xx dx^2 + 2 xy dx dy + yy dy^2. What no pixel shows stays zero, even
                # where its geometry is not finite.
                if total[G_XX] != zero or total[G] != zero:
                    xx, xy, yy = conics[s, 0], conics[s, 1], conics[s, 2]
                    v_means[s, 0] = xx * total[G_X] + xy * total[G_Y]
                    v_means[s, 1] = xy * total[G_X] + yy * total[G_Y]
                    v_conics[s, 0] = -half * total[G_XX]
                    v_conics[s, 1] = -total[G_XY]
                    v_conics[s, 2] = -half * total[G_YY]
                    v_opacities[s] = total[G] / opacities[s]
                for d in range(v_probe.shape[1]):
                    v_probe[s, d] = nats * total[PULL_X + d]

    return sum_rows
