"""Blending of sorted splats on the GPU, front to back: one block per active tile, one thread per pixel.

Kernels are compiled for a number of channels, so that a pixel's sums stay in registers.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cuda import Kernel, blocks_for, kernel
from glassplat.kernels.composite.cpu_tile import joined_cameras, tile_bounds
from glassplat.kernels.composite.cuda_backward import EXTRAS, THREADS, WARPS, composite_backward, composite_cotangents
from glassplat.kernels.composite.cuda_discs import composite_discs, composite_discs_gradients
from glassplat.kernels.composite.cuda_tile import (
    ALIGNMENT,
    BUCKET,
    COLUMNS,
    PIXELS,
    at,
    new_pair_rows,
    sum_pair_rows,
    tile_steps,
)
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from glassplat.kernels.records import LEAST_ALPHA, ON_MEAN, REAL_OF, TILE, Deviation, Splats, TileBins

__all__ = ["composite", "composite_discs", "composite_discs_gradients", "composite_gradients"]


class Saved(NamedTuple):
    """Results of the forward pass for the backward pass.

    final [A, 2, 256]: both transmittances of each pixel of the active tiles.
    last [A, 2, 256] int32: the last pair that each pixel blended, relative to the tile's first, -1 for none.
    looked_at [A] int32: number of pairs of each tile up to the last one that any pixel blended.
    bucket_tiles [B] int32: the active tile that each bucket belongs to, -1 for unused buckets.
    kept [B, D + 1, 256], with glass [B, D + 3, 256]: for each running pixel before the first pair of a bucket, its
        transmittance, channel sums, second transmittance and mask sum.
    kept_spread [B, 256]: sum of the deviation there, if requested.
    center, lean [C, H, W]: mean and lean of the channel whose deviation is requested, as on the CPU.
    outputs: image, alpha, mask and deviation.

    B is 0 if no gradients are needed.
    """

    final: Tensor
    last: Tensor
    looked_at: Tensor
    bucket_tiles: Tensor
    kept: Tensor
    kept_spread: Tensor
    center: Tensor
    lean: Tensor
    outputs: tuple[Tensor, Tensor, Tensor, Tensor]


def composite(
    splats: Splats, channels: Tensor, bins: TileBins,
    *, marks: Tensor, num_primary: int, deviation: Deviation | None, needs_gradients: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Saved]:  # fmt: skip
    """As `glassplat.kernels.composite.cpu.composite`."""
    real, (_, count, num_channels) = REAL_OF[channels.dtype], channels.shape
    shape, tiles = (bins.num_cameras, bins.height, bins.width), len(bins.active)
    # If all tiles are active, every pixel is written.
    new = channels.new_empty if tiles == len(bins.tile_offsets) - 1 else channels.new_zeros
    image, alpha, mask = (new(s) for s in ((*shape, num_channels), shape, shape))
    zeros = channels.new_zeros if deviation else channels.new_empty
    deviated, center, lean = (zeros(shape if deviation else (0, 0, 0)) for _ in range(3))
    buckets = len(bins.pair_splats) // BUCKET + tiles if needs_gradients else 0
    planes = num_channels + (1 if num_primary == count else 3)
    saved = Saved(
        channels.new_empty(tiles, 2, PIXELS),
        torch.empty(tiles, 2, PIXELS, dtype=torch.int32, device=channels.device),
        torch.empty(tiles, dtype=torch.int32, device=channels.device),
        torch.full((buckets,), -1, dtype=torch.int32, device=channels.device),
        channels.new_empty(buckets, planes, PIXELS),
        channels.new_empty(buckets if deviation else 0, PIXELS),
        center,
        lean,
        # Detached, because the autograd graph holds this record: a reference cycle would keep both alive.
        (image.detach(), alpha.detach(), mask.detach(), deviated.detach()),
    )
    lists = (bins.pair_splats, bins.tile_offsets, bins.active)
    geometry, values = joined_cameras(splats[:3]), channels.view(-1)
    composite_forward(real, num_channels)(
        tiles, PIXELS, *geometry, values, marks.view(-1), count, num_primary, *lists, *saved[:5],
        image, alpha, mask,
    )  # fmt: skip
    if deviation:
        where = deviation.where.detach().contiguous()
        composite_deviation(real)(
            tiles, PIXELS, *geometry, values, num_channels, count, num_primary, deviation.channel, where,
            *lists, *saved[1:3], saved.kept_spread, image, alpha, center, lean, deviated,
        )  # fmt: skip
    return image, alpha, mask, deviated, saved


def composite_gradients(
    splats: Splats, channels: Tensor, bins: TileBins, saved: Saved, v_outputs: Sequence[Tensor],
    *, marks: Tensor, num_primary: int, deviation: Deviation | None, with_absgrad: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """As `glassplat.kernels.composite.cpu.composite_gradients`."""
    real, (_, count, num_channels), tiles = REAL_OF[channels.dtype], channels.shape, len(bins.active)
    v_image, v_alpha, v_mask, v_deviation = v_outputs
    image, _, mask, deviated = saved.outputs
    channel, v_spread = -1, v_deviation
    if deviation:
        channel, v_spread = deviation.channel, v_deviation * deviation.where
        if deviation.through_mean:
            v_image, v_alpha = through_mean(v_image, v_alpha, v_spread, saved, channel)
    v_pixels = channels.new_empty(tiles, num_channels + EXTRAS, PIXELS)
    composite_cotangents(real, num_channels)(
        tiles, PIXELS, channel, bins.active, saved.final, saved.center, image, mask, deviated,
        *(v.contiguous() for v in (v_image, v_alpha, v_mask, v_deviation, v_spread)), v_pixels,
    )  # fmt: skip
    rows = new_pair_rows(bins, channels, with_absgrad)
    composite_backward(real, num_channels, with_absgrad)(
        blocks_for(len(saved.bucket_tiles), WARPS), THREADS, *joined_cameras((*splats[:3], channels)), marks,
        count, num_primary, channel, bins.width, bins.height, bins.pair_splats, bins.tile_offsets, bins.active,
        saved.last.view(-1), saved.looked_at, saved.bucket_tiles, saved.kept.view(-1), saved.kept_spread.view(-1),
        v_pixels.view(-1), rows,
    )  # fmt: skip
    return sum_pair_rows(rows, bins, splats, num_channels)


def through_mean(
    v_image: Tensor, v_alpha: Tensor, v_deviation: Tensor, saved: Saved, channel: int
) -> tuple[Tensor, Tensor]:
    """Adds the deviation's gradient through the mean, which is the channel's sum over the coverage."""
    alpha = saved.outputs[1]
    covered = alpha > LEAST_ALPHA
    v_sum = torch.where(covered, -v_deviation * saved.lean / torch.where(covered, alpha, 1), 0)
    v_image = v_image.clone()
    v_image[..., channel] += v_sum
    return v_image, v_alpha - v_sum * saved.center


@cache
def composite_forward(real: type, num_channels: int = 4) -> Kernel:
    """Fills image, alpha and mask of the active tiles, and the state for the backward pass."""
    load, coverage = tile_steps(real)
    zero, one, t_min = real(0.0), real(1.0), real(TRANSMITTANCE_MIN)
    alpha_min, alpha_max, stopped = real(ALPHA_MIN), real(ALPHA_MAX), np.int32(PIXELS)

    @kernel(
        f"composite_forward_{num_channels}",
        real,
        "real2 real2 real1 real1 real1 int int int1 long1 int1 real3 int3 int1 int1 real3 real4 real3 real3",
    )
    def forward(
        means, conics, opacities, channels, marks, splats_per_camera, num_primary, pair_splats, tile_offsets, active,
        final, last, looked_at, bucket_tiles, kept, image, alpha, mask,
    ):  # fmt: skip
        geometry = cuda.shared.array((PIXELS, COLUMNS), real, alignment=ALIGNMENT)
        reached = cuda.shared.array(PIXELS, np.int32)
        members = cuda.shared.array(PIXELS, np.int32)
        most = cuda.shared.array(1, np.int32)
        sums = cuda.local.array(num_channels, real)
        n, pixel = cuda.blockIdx.x, cuda.threadIdx.x
        camera, x0, y0, columns, num_rows = tile_bounds(active[n], image.shape[2], image.shape[1])
        column, row = pixel % TILE, pixel // TILE
        x, y, bit = real(np.int32(column)), real(np.int32(row)), np.int32(1 << row)
        inside = column < columns and row < num_rows
        # Integers, because a Boolean that changes in a loop costs three more instructions.
        running, glass_running = np.int32(inside), np.int32(inside)
        t, t_glass, shown, last_order, last_glass = one, one, zero, np.int32(-1), np.int32(-1)
        for d in range(num_channels):
            sums[d] = zero
        if pixel == 0:
            most[0] = 0
        start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
        first_bucket, first_glass = start // BUCKET + n, np.int32(camera * splats_per_camera + num_primary)
        keeps, keeps_glass = bucket_tiles.size > 0, num_primary < splats_per_camera
        # Offset of this camera's marks, relative to the index of its first glass splat.
        before_marks = camera * (splats_per_camera - num_primary) - first_glass
        for first in range(0, stop - start, PIXELS):
            if not cuda.syncthreads_or(running):
                break
            if start + first + pixel < stop:
                if keeps and pixel % BUCKET == 0:
                    bucket_tiles[first_bucket + (first + pixel) // BUCKET] = n
                s = pair_splats[start + first + pixel]
                reached[pixel] = load(geometry, pixel, s, means, conics, opacities, x0, y0, num_rows)
                members[pixel] = s
            cuda.syncthreads()
            here, group = np.int32(min(PIXELS, stop - start - first)), np.int32(0)
            while running != 0 and group < here:
                if keeps:
                    bucket = first_bucket + (first + group) // BUCKET
                    kept[bucket, 0, pixel] = t
                    for d in range(num_channels):
                        kept[bucket, 1 + d, pixel] = sums[d]
                    if keeps_glass:
                        kept[bucket, num_channels + 1, pixel], kept[bucket, num_channels + 2, pixel] = t_glass, shown
                i = group
                group = np.int32(min(group + BUCKET, here))
                while i < group:
                    k = np.uint32(i)
                    covered = coverage(geometry, k, x, y) if np.int32(reached[k] & bit) != 0 else zero
                    if covered >= alpha_min:
                        a, s = min(covered, alpha_max), members[k]
                        if s < first_glass:
                            weight = a * t
                            left = t - weight
                            if left >= t_min:
                                t, last_order = left, np.int32(first + i)
                                for d in range(num_channels):
                                    sums[d] += weight * channels[at(s * num_channels + d)]
                            else:
                                i = stopped
                        elif glass_running != 0:
                            weight = a * t_glass
                            left = t_glass - weight
                            if not left >= t_min:
                                glass_running = np.int32(0)
                            else:
                                t_glass, last_glass = left, np.int32(first + i)
                                shown += weight * t * marks[at(before_marks + s)]
                    i = np.int32(i + 1)
                if i > stopped:
                    running = np.int32(0)
        cuda.syncthreads()
        cuda.atomic.max(most, 0, np.int32(max(last_order, last_glass) + 1))
        cuda.syncthreads()
        if pixel == 0:
            looked_at[n] = most[0]
        final[n, 0, pixel], final[n, 1, pixel] = t, t_glass
        last[n, 0, pixel], last[n, 1, pixel] = last_order, last_glass
        if inside:
            alpha[camera, y0 + row, x0 + column] = one - t
            mask[camera, y0 + row, x0 + column] = shown
            for d in range(num_channels):
                image[camera, y0 + row, x0 + column, d] = sums[d]

    return forward


@cache
def composite_deviation(real: type) -> Kernel:
    """Second traversal: fills a channel's mean, and the deviation and lean from it, in active tiles."""
    load, coverage = tile_steps(real)
    zero, one, least_alpha, on_mean = real(0.0), real(1.0), real(LEAST_ALPHA), real(ON_MEAN * np.finfo(real).eps)
    alpha_min, alpha_max = real(ALPHA_MIN), real(ALPHA_MAX)

    @kernel(
        "composite_deviation",
        real,
        "real2 real2 real1 real1 int int int int real3 int1 long1 int1 int3 int1 real2 real4 real3 real3 real3 real3",
    )
    def deviate(
        means, conics, opacities, channels, num_channels, splats_per_camera, num_primary, channel, where,
        pair_splats, tile_offsets, active, last, looked_at, kept_spread, image, alpha, center, lean, deviation,
    ):  # fmt: skip
        geometry = cuda.shared.array((PIXELS, COLUMNS), real, alignment=ALIGNMENT)
        reached = cuda.shared.array(PIXELS, np.int32)
        members = cuda.shared.array(PIXELS, np.int32)
        n, pixel = cuda.blockIdx.x, cuda.threadIdx.x
        camera, x0, y0, columns, num_rows = tile_bounds(active[n], image.shape[2], image.shape[1])
        column, row = pixel % TILE, pixel // TILE
        x, y, bit = real(np.int32(column)), real(np.int32(row)), np.int32(1 << row)
        inside = column < columns and row < num_rows
        factor, middle = zero, zero
        if inside:
            factor = where[camera, y0 + row, x0 + column]
            covered = alpha[camera, y0 + row, x0 + column]
            if covered > least_alpha:
                middle = image[camera, y0 + row, x0 + column, channel] / covered
        if not cuda.syncthreads_or(1 if factor != zero else 0):
            return
        t, spread, leaning = one, zero, zero
        start, first_glass = tile_offsets[active[n]], np.int32(camera * splats_per_camera + num_primary)
        count, last_order = looked_at[n], last[n, 0, pixel]
        for first in range(0, count, PIXELS):
            cuda.syncthreads()
            if first + pixel < count:
                s = pair_splats[start + first + pixel]
                reached[pixel] = load(geometry, pixel, s, means, conics, opacities, x0, y0, num_rows)
                members[pixel] = s
            cuda.syncthreads()
            here, group = np.int32(min(PIXELS, count - first)), np.int32(0)
            while group < here:
                if kept_spread.shape[0] > 0:
                    kept_spread[start // BUCKET + n + (first + group) // BUCKET, pixel] = spread
                i = group
                group = np.int32(min(group + BUCKET, here))
                # The pixel has stopped after the last splat that it blended.
                end = np.int32(min(group, last_order + 1 - first))
                while i < end:
                    k = np.uint32(i)
                    i = np.int32(i + 1)
                    if reached[k] & bit == 0:
                        continue
                    a = coverage(geometry, k, x, y)
                    if not a >= alpha_min or members[k] >= first_glass:
                        continue
                    weight = min(a, alpha_max) * t
                    t -= weight
                    difference = channels[at(members[k] * num_channels + channel)] - middle
                    spread += weight * abs(difference)
                    if abs(difference) > on_mean * abs(middle):
                        leaning += weight if difference > zero else -weight
        if inside:
            center[camera, y0 + row, x0 + column] = middle
            lean[camera, y0 + row, x0 + column] = leaning
            deviation[camera, y0 + row, x0 + column] = spread * factor

    return deviate
