"""Gradient rows of (tile, splat) pairs, and their sum per splat in a fixed order."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.cpu.jit import Kernel, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.splats import Splats, TileBins

CHUNK = 512
"""Splats per task."""


def new_pair_rows(bins: TileBins, num_values: int, real: type, probed: bool) -> NDArray[Any]:
    """Room for one gradient row per pair: mean (2), conic (3), opacity (1), `num_values`, and the probe's (2) if any.

    A kernel fills the rows of active tiles. Only where other tiles have pairs must the rest be zero beforehand.
    """
    shape = (len(bins.pair_splats), tile.V_VALUES + num_values + (2 if probed else 0))
    active = bins.active.long()
    filled = int((bins.tile_offsets[active + 1] - bins.tile_offsets[active]).sum())
    return np.empty(shape, real) if filled == shape[0] else np.zeros(shape, real)


def sum_pair_rows(
    rows: NDArray[Any], bins: TileBins, splats: Splats, num_values: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means2d, conics, opacities, values [C, G, num_values] and probe [C, G, 2 or 0]: sums over tiles."""
    probe_width = rows.shape[1] - tile.V_VALUES - num_values
    shape = tuple(splats.opacities.shape)
    widths = ((2,), (3,), (), (num_values,), (probe_width,))
    v_means, v_conics, v_opacities, v_values, v_probe = (splats.opacities.new_empty(*shape, *w) for w in widths)
    _sum_rows(tile.real_of(splats))(
        rows, bins.pair_slots.numpy(), bins.splat_offsets.numpy(),
        v_means.numpy().reshape(-1, 2), v_conics.numpy().reshape(-1, 3), v_opacities.numpy().reshape(-1),
        v_values.numpy().reshape(-1, num_values), v_probe.numpy().reshape(v_opacities.numel(), probe_width),
    )  # fmt: skip
    return v_means, v_conics, v_opacities, v_values, v_probe


@functools.cache
def _sum_rows(real: type) -> Kernel:
    zero = real(0.0)
    V_CONIC, V_OPACITY, V_VALUES = tile.V_CONIC, tile.V_OPACITY, tile.V_VALUES

    @kernel("sum_pair_rows", real)
    def sum_rows(rows, slots, offsets, v_means, v_conics, v_opacities, v_values, v_probe):
        count, V_PROBE = offsets.size - 1, V_VALUES + v_values.shape[1]
        num_chunks = (count + CHUNK - 1) // CHUNK
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            for s in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                v_means[s, :], v_conics[s, :], v_opacities[s], v_values[s, :] = zero, zero, zero, zero
                v_probe[s, :] = zero
                for k in range(offsets[s], offsets[s + 1]):
                    row = rows[slots[k]]
                    for d in range(2):
                        v_means[s, d] += row[d]
                    for d in range(3):
                        v_conics[s, d] += row[V_CONIC + d]
                    v_opacities[s] += row[V_OPACITY]
                    for d in range(v_values.shape[1]):
                        v_values[s, d] += row[V_VALUES + d]
                    for d in range(v_probe.shape[1]):
                        v_probe[s, d] += row[V_PROBE + d]

    return sum_rows
