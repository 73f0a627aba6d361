"""Blending of sorted discs: the operation on the CPU."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, even_stride, kernel
from glassplat.kernels.backend.cpu_vector import store, vector_kind
from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.composite_discs import cpu_tile
from glassplat.kernels.composite_discs.cpu_backward import (
    AROUND,
    DEPTH,
    PAIR_VALUES,
    PULL,
    UP,
    VP,
    E,
    G,
    composite_discs_backward,
)
from glassplat.kernels.composite_discs.cpu_forward import SPLATS, composite_discs_forward
from glassplat.kernels.maths.disc import MAP
from glassplat.kernels.records import REAL_OF, Discs, TileBins


class Saved(NamedTuple):
    """What the backward pass needs from the forward pass, flat: packed discs, the blocks that each pair reaches, and
    each active tile's final state.
    """

    packed: NDArray[Any]
    pairs: NDArray[np.int32]
    state: NDArray[Any]


def composite_discs(
    discs: Discs, channels: Tensor, bins: TileBins, *, near: float, low_pass: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Saved]:
    """The fields of `BlendedDiscs`, and what `composite_discs_gradients` starts from."""
    cameras, count, num_channels = channels.shape
    shape, real = (bins.num_cameras, bins.height, bins.width), REAL_OF[channels.dtype]
    images = [channels.new_zeros(s) for s in ((*shape, num_channels), shape, shape, shape, shape)]
    # Of PyTorch, because its arrays begin with a cache line, and a packed disc is whole ones.
    sizes = cameras * count * cpu_tile.packed_width(num_channels), len(bins.active) * cpu_tile.STATE
    packed, state = (torch.empty(size, dtype=channels.dtype).numpy() for size in sizes)
    saved = Saved(packed, np.zeros(len(bins.pair_splats), np.int32), state)
    composite_discs_forward(real)(
        *_by_disc(discs), channels.numpy().reshape(-1, num_channels), bins.width, bins.height,
        *_real_options(real, near, low_pass), bins.pair_splats.numpy(), bins.tile_offsets.numpy(),
        bins.splat_offsets.numpy(), bins.active.numpy(), *saved, tuple(_flat(image) for image in images),
    )  # fmt: skip
    image, alpha, depth, median, distortion = images
    return image, alpha, depth, median, distortion, saved


def composite_discs_gradients(
    discs: Discs, channels: Tensor, bins: TileBins, saved: Saved, v_outputs: Sequence[Tensor],
    *, near: float, low_pass: float, probed: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    """Gradients of means2d, maps, opacities, depths, channels and probe; the last where `probed`."""
    (cameras, count, num_channels), real = channels.shape, REAL_OF[channels.dtype]
    # Of tiles that are not active nothing is written.
    width = tile.LANES * ((PAIR_VALUES + 4 * tile.groups_of(num_channels) + tile.LANES - 1) // tile.LANES)
    rows = torch.zeros(len(bins.pair_splats) * width, dtype=channels.dtype).numpy()
    composite_discs_backward(real)(
        cameras * count, num_channels, bins.width, bins.height, *_real_options(real, near, low_pass),
        bins.pair_splats.numpy(), bins.tile_offsets.numpy(), bins.active.numpy(), *saved,
        tuple(_flat(v) for v in v_outputs), rows,
    )  # fmt: skip
    widths = ((2,), (MAP,), (), (), (num_channels,), (2,))
    found = [channels.new_zeros(cameras, count, *rest) for rest in widths]
    sum_disc_rows(real)(
        rows, bins.pair_slots.numpy(), bins.splat_offsets.numpy(), discs.maps.numpy().reshape(-1, MAP),
        discs.opacities.numpy().reshape(-1),
        *(tensor.numpy().reshape(cameras * count, *tensor.shape[2:]) for tensor in found),
    )  # fmt: skip
    return (*found[:5], found[5] if probed else None)


def _real_options(real: type, near: float, low_pass: float) -> tuple[Any, Any]:
    """The near plane, and one over the variance of the low-pass."""
    return real(near), real(1 / low_pass**2) if low_pass else real(np.inf)


def _flat(tensor: Tensor) -> NDArray[Any]:
    array: NDArray[Any] = tensor.contiguous().numpy().reshape(-1)
    return array


def _by_disc(discs: Discs) -> tuple[NDArray[Any], ...]:
    return (
        discs.means2d.numpy().reshape(-1, 2),
        discs.maps.numpy().reshape(-1, MAP),
        discs.opacities.numpy().reshape(-1),
        discs.depths.numpy().reshape(-1),
        discs.outlines.means2d.numpy().reshape(-1, 2),
        discs.outlines.conics.numpy().reshape(-1, 3),
    )


@functools.cache
def sum_disc_rows(real: type) -> Kernel:
    """Fills the gradients of each disc, which are zero, from the rows of its pairs, in a fixed order."""
    full, load = vector_kind(real, tile.LANES)
    zero, LANES = real(0.0), tile.LANES

    @kernel("sum_disc_rows", real)
    def sum_rows(rows, slots, offsets, maps, opacities, v_means, v_maps, v_opacities, v_depths, v_channels, v_probe):
        count, width = offsets.size - 1, rows.size // max(1, slots.size)
        num_chunks = (count + SPLATS - 1) // SPLATS
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            total = np.empty(width, real)
            for s in range(chunk * SPLATS, min(count, (chunk + 1) * SPLATS)):
                if offsets[s] == offsets[s + 1]:
                    continue
                for column in range(0, width, LANES):
                    part = full(zero)
                    for k in range(offsets[s], offsets[s + 1]):
                        part = part + load(rows, slots[k] * width + column)
                    store(total, column, part)
                for d in range(v_channels.shape[1]):
                    v_channels[s, d] = total[PAIR_VALUES + d]
                for j in range(2):
                    v_maps[s, j], v_maps[s, 2 + j], v_maps[s, 4 + j] = total[UP + j], total[VP + j], total[E + j]
                    # What no pixel shows stays zero, even where its geometry is not finite.
                    if total[UP + 2] != zero or total[VP + 2] != zero or total[E + 2] != zero:
                        v_means[s, j] -= total[UP + 2] * maps[s, j]
                        v_means[s, j] -= total[VP + 2] * maps[s, 2 + j]
                        v_means[s, j] -= total[E + 2] * maps[s, 4 + j]
                    v_means[s, j] -= total[AROUND + j]
                    v_probe[s, j] = total[PULL + j]
                if total[G] != zero:
                    v_opacities[s] = total[G] / opacities[s]
                v_depths[s] = total[DEPTH]

    return sum_rows
