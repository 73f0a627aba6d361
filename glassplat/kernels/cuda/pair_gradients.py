"""Gradient rows of (tile, splat) pairs, and their sum per splat in a fixed order.

A row holds sums over a tile's pixels: of g dx, g dy, g dx^2, g dx dy, g dy^2 and g, with g the gradient of the exponent
of the splat's falloff and (dx, dy) the offset from its centre, then one value per channel. All of these add up over
tiles; what they mean for mean, conic and opacity is worked out once per splat.
"""

from __future__ import annotations

from functools import cache

from numba import cuda
from torch import Tensor

from glassplat.kernels.cuda.launch import Kernel, blocks_for, kernel
from glassplat.kernels.splats import Splats, TileBins
from glassplat.kernels.tensor_checks import REAL_OF

THREADS = 256
MOMENTS = 6


def new_pair_rows(bins: TileBins, channels: Tensor) -> Tensor:
    """One gradient row per pair [P, 6 + D], all zero: a tile fills those of the pairs that its pixels blended."""
    return channels.new_zeros(len(bins.pair_splats), MOMENTS + channels.shape[2])


def sum_pair_rows(rows: Tensor, bins: TileBins, splats: Splats) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means2d, conics, opacities and values [C, G, D], summed over each splat's tiles."""
    shape, width = tuple(splats.opacities.shape), rows.shape[1]
    count = shape[0] * shape[1]
    found = [rows.new_empty(count, *rest) for rest in ((2,), (3,), (), (width - MOMENTS,))]
    sum_rows(REAL_OF[rows.dtype])(
        blocks_for(count * width, THREADS), THREADS, rows, bins.pair_slots, bins.splat_offsets,
        splats.conics.view(-1, 3), splats.opacities.view(-1), *found,
    )  # fmt: skip
    v_means, v_conics, v_opacities, v_values = (tensor.view(*shape, *tensor.shape[1:]) for tensor in found)
    return v_means, v_conics, v_opacities, v_values


@cache
def sum_rows(real: type) -> Kernel:
    """One thread for each column of each splat: neighbouring threads read neighbouring numbers."""
    zero, half = real(0.0), real(0.5)

    @kernel("sum_pair_rows", real, "real2 int1 long1 real2 real1 real2 real2 real1 real2")
    def sum_up(rows, slots, offsets, conics, opacities, v_means, v_conics, v_opacities, v_values):
        i, width = cuda.grid(1), rows.shape[1]
        s, column = i // width, i % width
        if s >= opacities.size:
            return
        total, other = zero, zero
        for k in range(offsets[s], offsets[s + 1]):
            total += rows[slots[k], column]
            if column < 2:
                other += rows[slots[k], 1 - column]
        if column < 2:
            # q = xx dx^2 + 2 xy dx dy + yy dy^2, and the exponent is -q / 2.
            v_means[s, column] = conics[s, 2 * column] * total + conics[s, 1] * other
        elif column < 5:
            v_conics[s, column - 2] = -total if column == 3 else -half * total
        elif column == 5:
            v_opacities[s] = total / opacities[s] if total != zero else zero
        else:
            v_values[s, column - MOMENTS] = total

    return sum_up
