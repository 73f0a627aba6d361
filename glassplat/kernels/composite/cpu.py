"""Blending of sorted splats, tile by tile and front to back."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.composite.cpu_backward import composite_backward
from glassplat.kernels.composite.cpu_pair_rows import CHUNK, new_pair_rows, sum_pair_rows
from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.maths.blending import TRANSMITTANCE_MIN, Scalar, blend_maths
from glassplat.kernels.splats import LEAST_ALPHA, Deviation, Splats, TileBins

# Planes of the forward pass after those that both directions share; SUMS has one per channel. CENTER, DEVIATION and
# LEAN belong to the second traversal, which sums distances from the mean that the first one has found.
MASK, CENTER, DEVIATION, LEAN, SUMS = (plane * tile.PLANE for plane in range(5, 10))


class Saved(NamedTuple):
    """What the backward pass needs from the forward pass.

    Packed splats, each active tile's final state, and of the channel whose deviation was asked for the mean [C, H, W]
    and the lean [C, H, W]: the weight of what lies above the mean minus that of what lies below.
    """

    packed: NDArray[Any]
    state: NDArray[Any]
    center: NDArray[Any]
    lean: NDArray[Any]


def composite(
    splats: Splats, channels: Tensor, bins: TileBins,
    *, marks: Tensor, num_primary: int, deviation: Deviation | None, needs_gradients: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Saved]:  # fmt: skip
    """Image [C, H, W, D], alpha, mask and deviation [C, H, W], and what `composite_gradients` starts from.

    That is little here, and kept whether gradients are needed or not.
    """
    real = tile.real_of(splats)
    cameras, count, num_channels = channels.shape
    shape = (bins.num_cameras, bins.height, bins.width)
    image, alpha, mask = (torch.zeros(s, dtype=channels.dtype) for s in ((*shape, num_channels), shape, shape))
    deviated = torch.zeros(shape if deviation else (0, 0, 0), dtype=channels.dtype)
    saved = Saved(
        np.empty((cameras * count, tile.packed_width(num_channels)), real),
        np.empty((len(bins.active), tile.STATE_PLANES, tile.PIXELS), real),
        np.zeros(deviated.shape, real),
        np.zeros(deviated.shape, real),
    )
    where = deviation.where.detach().contiguous().numpy() if deviation else saved.center
    _forward(real)(
        *_flat(splats, channels), marks.numpy(), count, num_primary, deviation.channel if deviation else -1, where,
        bins.pair_splats.numpy(), bins.tile_offsets.numpy(), bins.splat_offsets.numpy(), bins.active.numpy(),
        *saved, image.numpy(), alpha.numpy(), mask.numpy(), deviated.numpy(),
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
    num_channels, count = channels.shape[2], channels.shape[1]
    rows = new_pair_rows(bins, num_channels, real, probed)
    *v_images, v_deviation = v_outputs
    channel, through_mean = -1, False
    if deviation:
        channel, through_mean = deviation.channel, deviation.through_mean
        v_deviation = v_deviation * deviation.where
    composite_backward(real, probed)(
        marks.numpy(), count, num_primary, num_channels, channel, through_mean,
        bins.pair_splats.numpy(), bins.tile_offsets.numpy(), bins.active.numpy(), *saved,
        *(v.contiguous().numpy() for v in (*v_images, v_deviation)), rows,
    )  # fmt: skip
    v_means, v_conics, v_opacities, v_values, v_probe = sum_pair_rows(rows, bins, splats, num_channels)
    v_marks = torch.zeros_like(marks)
    if num_primary < count:
        v_marks.copy_(v_values[:, num_primary:, 0])
        v_values[:, num_primary:] = 0
    return v_means, v_conics, v_opacities, v_values, v_marks, v_probe if probed else None


def _flat(splats: Splats, channels: Tensor) -> tuple[NDArray[Any], ...]:
    return (
        splats.means2d.numpy().reshape(-1, 2),
        splats.conics.numpy().reshape(-1, 3),
        splats.opacities.numpy().reshape(-1),
        channels.numpy().reshape(-1, channels.shape[2]),
    )


def _weigh(real: type) -> Scalar:
    clipped_alpha = blend_maths(real).clipped_alpha
    zero, t_min = real(0.0), real(TRANSMITTANCE_MIN)
    T, LAST, COVERAGE = tile.T, tile.LAST, tile.COVERAGE

    @inlined
    def weigh(scratch, at, order):
        """How much of a splat a pixel shows; moves the pixel's transmittance behind the splat."""
        a = clipped_alpha(scratch[COVERAGE + at])
        t = scratch[T + at]
        weight = a * t
        after = t - weight
        alive = after >= t_min
        scratch[T + at] = after if alive else -abs(t)
        scratch[LAST + at] = order if alive else scratch[LAST + at]
        return weight if alive else zero

    return weigh


@inlined
def add_group(scratch, at, weight, c0, c1, c2, c3):
    """Adds four channels of a splat to a pixel's sums, the first of which is at `at`."""
    scratch[at] += weight * c0
    scratch[at + tile.PLANE] += weight * c1
    scratch[at + 2 * tile.PLANE] += weight * c2
    scratch[at + 3 * tile.PLANE] += weight * c3


def _blend_primary(real: type) -> Scalar:
    COVERAGE, VALUES, weigh = tile.COVERAGE, tile.VALUES, _weigh(real)

    @inlined
    def blend_primary(scratch, splat, order, first, last):
        c0, c1, c2, c3 = splat[VALUES], splat[VALUES + 1], splat[VALUES + 2], splat[VALUES + 3]
        for row in range(first, last):
            base = (row & 15) * 16
            for i in range(16):
                weight = weigh(scratch, base + i, order)
                add_group(scratch, SUMS + base + i, weight, c0, c1, c2, c3)
                # From here on the plane holds weights, for the channels of `blend_more`.
                scratch[COVERAGE + base + i] = weight

    return blend_primary


def _blend_seven(real: type) -> Scalar:
    PLANE, VALUES, weigh = tile.PLANE, tile.VALUES, _weigh(real)

    @inlined
    def blend_seven(scratch, splat, order, first, last):
        """Adds colour, normal and strength of `deferred` at once: no weights to keep, and no eighth channel."""
        c0, c1, c2, c3 = splat[VALUES], splat[VALUES + 1], splat[VALUES + 2], splat[VALUES + 3]
        c4, c5, c6 = splat[VALUES + 4], splat[VALUES + 5], splat[VALUES + 6]
        for row in range(first, last):
            base = (row & 15) * 16
            for i in range(16):
                weight = weigh(scratch, base + i, order)
                add_group(scratch, SUMS + base + i, weight, c0, c1, c2, c3)
                scratch[SUMS + 4 * PLANE + base + i] += weight * c4
                scratch[SUMS + 5 * PLANE + base + i] += weight * c5
                scratch[SUMS + 6 * PLANE + base + i] += weight * c6

    return blend_seven


def _blend_more(real: type) -> Scalar:
    COVERAGE, PLANE, VALUES = tile.COVERAGE, tile.PLANE, tile.VALUES

    @inlined
    def blend_more(scratch, splat, group, first, last):
        """Adds channels beyond the first group, with the weights that `blend_primary` left."""
        at, sums = VALUES + 4 * group, SUMS + (group & 7) * 4 * PLANE
        c0, c1, c2, c3 = splat[at], splat[at + 1], splat[at + 2], splat[at + 3]
        for row in range(first, last):
            base = (row & 15) * 16
            for i in range(16):
                weight = scratch[COVERAGE + base + i]
                add_group(scratch, sums + base + i, weight, c0, c1, c2, c3)

    return blend_more


def _blend_glass(real: type) -> Scalar:
    clipped_alpha = blend_maths(real).clipped_alpha
    zero, t_min = real(0.0), real(TRANSMITTANCE_MIN)
    T, T_GLASS, LAST_GLASS, COVERAGE = tile.T, tile.T_GLASS, tile.LAST_GLASS, tile.COVERAGE

    @inlined
    def blend_glass(scratch, splat, mark, order, first, last):
        for row in range(first, last):
            base = (row & 15) * 16
            for i in range(16):
                a = clipped_alpha(scratch[COVERAGE + base + i])
                t, t_glass = scratch[T + base + i], scratch[T_GLASS + base + i]
                weight = a * t_glass
                after = t_glass - weight
                alive = (after >= t_min) & (t > zero)
                scratch[T_GLASS + base + i] = after if alive else -abs(t_glass)
                scratch[LAST_GLASS + base + i] = order if alive else scratch[LAST_GLASS + base + i]
                scratch[MASK + base + i] += weight * t * mark if alive else zero

    return blend_glass


def _deviate(real: type) -> Scalar:
    clipped_alpha = blend_maths(real).clipped_alpha
    zero = real(0.0)
    T, LAST, COVERAGE = tile.T, tile.LAST, tile.COVERAGE

    @inlined
    def deviate(scratch, value, order, first, last):
        for row in range(first, last):
            base = (row & 15) * 16
            for i in range(16):
                a = clipped_alpha(scratch[COVERAGE + base + i]) if order <= scratch[LAST + base + i] else zero
                t = scratch[T + base + i]
                weight = a * t
                scratch[T + base + i] = t - weight
                difference = value - scratch[CENTER + base + i]
                scratch[DEVIATION + base + i] += weight * abs(difference)
                leaning = weight if difference > zero else -weight
                scratch[LEAN + base + i] += leaning if difference != zero else zero

    return deviate


@functools.cache
def _forward(real: type) -> Kernel:
    pack, place, begin, is_finished, save_state, _, fetch, cover, _ = tile.tile_functions(real)
    blend_primary, blend_more, blend_glass = _blend_primary(real), _blend_more(real), _blend_glass(real)
    blend_seven, deviate = _blend_seven(real), _deviate(real)
    one, zero, least_alpha = real(1.0), real(0.0), real(LEAST_ALPHA)
    T, LAST, PIXELS, PLANE, VALUES, BATCH = tile.T, tile.LAST, tile.PIXELS, tile.PLANE, tile.VALUES, tile.BATCH

    @inlined
    def looked_at(scratch):
        most = -one
        for i in range(PIXELS):
            most = max(most, scratch[LAST + i])
        return int(most) + 1

    @inlined
    def write_tile(scratch, image, alpha, mask, camera, x0, y0, columns, rows):
        for y in range(rows):
            base = (y & 15) * 16
            image_row = image[camera, y0 + y, x0 : x0 + columns]
            alpha_row, mask_row = alpha[camera, y0 + y, x0 : x0 + columns], mask[camera, y0 + y, x0 : x0 + columns]
            for x in range(alpha_row.size):
                alpha_row[x] = one - abs(scratch[T + base + x])
                mask_row[x] = scratch[MASK + base + x]
            for d in range(image_row.shape[1]):
                for x in range(image_row.shape[0]):
                    image_row[x, d] = scratch[SUMS + (d & 31) * PLANE + base + x]

    @inlined
    def begin_deviation(scratch, channel, where, camera, x0, y0, columns, rows):
        """Starts the second traversal of a tile; False where nobody asks for it."""
        wanted = False
        for y in range(rows):
            for x in range(columns):
                wanted |= where[camera, y0 + y, x0 + x] != zero
        for i in range(tile.PLANE):
            covered = one - abs(scratch[T + i])
            total = scratch[SUMS + (channel & 31) * PLANE + i]
            scratch[CENTER + i] = total / max(covered, least_alpha) if covered > least_alpha else zero
            scratch[T + i] = one
        return wanted

    @inlined
    def write_deviation(scratch, where, center, lean, deviation, camera, x0, y0, columns, rows):
        for y in range(rows):
            for x in range(columns):
                i, factor = (y & 15) * 16 + (x & 15), where[camera, y0 + y, x0 + x]
                center[camera, y0 + y, x0 + x] = scratch[CENTER + i]
                lean[camera, y0 + y, x0 + x] = scratch[LEAN + i]
                deviation[camera, y0 + y, x0 + x] = scratch[DEVIATION + i] * factor

    @kernel("composite_forward", real)
    def forward(
        means, conics, opacities, channels, marks, splats_per_camera, num_primary, deviation_channel, where,
        pair_splats, tile_offsets, splat_offsets, active,
        packed, state, center, lean, image, alpha, mask, deviation,
    ):  # fmt: skip
        num_splats, num_channels = channels.shape
        groups = (num_channels + 3) // 4
        num_chunks = (num_splats + CHUNK - 1) // CHUNK
        pack_stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * pack_stride % num_chunks
            for s in range(chunk * CHUNK, min(num_splats, (chunk + 1) * CHUNK)):
                if splat_offsets[s + 1] > splat_offsets[s]:
                    pack(packed, s, means, conics, opacities)
                    for d in range(groups * 4):
                        packed[s, VALUES + d] = channels[s, d] if d < num_channels else zero
        stride = even_stride(active.size)
        for task in prange(active.size):
            n = task * stride % active.size
            camera, x0, y0, columns, rows = place(active[n], image.shape[2], image.shape[1])
            scratch = np.empty(SUMS + groups * 4 * PLANE, real)
            scratch[:] = zero
            begin(scratch, columns, rows)
            batch = np.empty((BATCH, packed.shape[1]), real)
            start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
            for first in range(start, stop, BATCH):
                finished, glass_finished = is_finished(scratch)
                if finished:
                    break
                last = min(first + BATCH, stop)
                fetch(batch, packed, pair_splats, first, last)
                for p in range(first, last):
                    order, splat = real(np.int32(p - start)), batch[p - first]
                    glass = pair_splats[p] - camera * splats_per_camera - num_primary
                    if glass >= 0 and glass_finished:
                        continue
                    top, bottom = cover(scratch, splat, x0, y0, rows)
                    if glass >= 0:
                        blend_glass(scratch, splat, marks[camera, glass], order, top, bottom)
                    elif num_channels == 7:
                        blend_seven(scratch, splat, order, top, bottom)
                    else:
                        blend_primary(scratch, splat, order, top, bottom)
                        for group in range(1, groups):
                            blend_more(scratch, splat, group, top, bottom)
            save_state(state, n, scratch)
            if start == stop:
                continue
            write_tile(scratch, image, alpha, mask, camera, x0, y0, columns, rows)
            if deviation_channel < 0:
                continue
            if not begin_deviation(scratch, deviation_channel, where, camera, x0, y0, columns, rows):
                continue
            stop = min(stop, start + looked_at(scratch))
            for first in range(start, stop, BATCH):
                last = min(first + BATCH, stop)
                fetch(batch, packed, pair_splats, first, last)
                for p in range(first, last):
                    if pair_splats[p] - camera * splats_per_camera < num_primary:
                        order, splat = real(np.int32(p - start)), batch[p - first]
                        top, bottom = cover(scratch, splat, x0, y0, rows)
                        deviate(scratch, splat[VALUES + deviation_channel], order, top, bottom)
            write_deviation(scratch, where, center, lean, deviation, camera, x0, y0, columns, rows)

    return forward
