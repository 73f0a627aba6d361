"""Blending of sorted splats: the operation on the CPU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.composite.cpu_backward import composite_backward
from glassplat.kernels.composite.cpu_discs import composite_discs, composite_discs_gradients
from glassplat.kernels.composite.cpu_forward import composite_forward
from glassplat.kernels.composite.cpu_tile import new_pair_rows, sum_pair_rows
from glassplat.kernels.records import Deviation, Splats, TileBins

__all__ = ["composite", "composite_discs", "composite_discs_gradients", "composite_gradients"]


class Saved(NamedTuple):
    """Flat results of the forward pass for the backward pass.

    Packed splats, what each pair reaches (`cpu_tile.GLASS`), each active tile's final state, and where a deviation was
    asked for, each active tile's mean of the channel and its lean: the weight of what lies above the mean minus that of
    what lies below.
    """

    packed: NDArray[Any]
    pairs: NDArray[np.int32]
    state: NDArray[Any]
    spread: NDArray[Any]


def composite(
    splats: Splats, channels: Tensor, bins: TileBins,
    *, marks: Tensor, num_primary: int, deviation: Deviation | None, needs_gradients: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Saved]:  # fmt: skip
    """Image [C, H, W, D], alpha, mask and deviation [C, H, W], and what `composite_gradients` starts from.

    That is little here, and kept whether gradients are needed or not.
    """
    cameras, count, num_channels = channels.shape
    shape = (bins.num_cameras, bins.height, bins.width)
    dtype, tiles = channels.dtype, len(bins.active)
    image, alpha, mask = (torch.zeros(s, dtype=dtype) for s in ((*shape, num_channels), shape, shape))
    deviated = torch.zeros(shape if deviation else (0, 0, 0), dtype=dtype)
    # Of PyTorch, because its arrays begin with a cache line, and a packed splat is one.
    sizes = cameras * count * tile.packed_width(num_channels), tiles * tile.STATE
    packed, state = (torch.empty(size, dtype=dtype).numpy() for size in sizes)
    spread = torch.zeros(tiles * 2 * tile.PIXELS if deviation else 0, dtype=dtype).numpy()
    saved = Saved(packed, np.empty(len(bins.pair_splats), np.int32), state, spread)
    where = _flat(deviation.where.detach()) if deviation else spread
    composite_forward(tile.real_of(splats))(
        *_by_splat(splats, channels), marks.numpy(), count, num_primary, bins.width, bins.height,
        deviation.channel if deviation else -1, where,
        bins.pair_splats.numpy(), bins.tile_offsets.numpy(), bins.splat_offsets.numpy(), bins.active.numpy(),
        *saved, *(_flat(output) for output in (image, alpha, mask, deviated)),
    )  # fmt: skip
    return image, alpha, mask, deviated, saved


def composite_gradients(
    splats: Splats, channels: Tensor, bins: TileBins, saved: Saved, v_outputs: Sequence[Tensor],
    *, marks: Tensor, num_primary: int, deviation: Deviation | None, probed: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor | None]:  # fmt: skip
    """Gradients of means2d, conics, opacities, channels and marks, given those of image, alpha, mask and deviation.

    Last the probe's, where `probed`.
    """
    real = tile.real_of(splats)
    cameras, count, num_channels = channels.shape
    rows = new_pair_rows(bins, num_channels, real)
    *v_images, v_deviation = v_outputs
    channel, through_mean = -1, False
    if deviation:
        channel, through_mean = deviation.channel, deviation.through_mean
        v_deviation = v_deviation * deviation.where
    composite_backward(real, probed)(
        cameras * count, num_primary < count, num_channels, bins.width, bins.height, channel, through_mean,
        bins.pair_splats.numpy(), bins.tile_offsets.numpy(), bins.active.numpy(), *saved,
        *(_flat(v) for v in (*v_images, v_deviation)), rows,
    )  # fmt: skip
    v_means, v_conics, v_opacities, v_values, v_probe = sum_pair_rows(rows, bins, splats, num_channels, probed)
    v_marks = torch.zeros_like(marks)
    if num_primary < count:
        v_marks.copy_(v_values[:, num_primary:, 0])
        v_values[:, num_primary:] = 0
    return v_means, v_conics, v_opacities, v_values, v_marks, v_probe if probed else None


def _flat(tensor: Tensor) -> NDArray[Any]:
    array: NDArray[Any] = tensor.contiguous().numpy().reshape(-1)
    return array


def _by_splat(splats: Splats, channels: Tensor) -> tuple[NDArray[Any], ...]:
    return (
        splats.means2d.numpy().reshape(-1, 2),
        splats.conics.numpy().reshape(-1, 3),
        splats.opacities.numpy().reshape(-1),
        channels.numpy().reshape(-1, channels.shape[2]),
    )
