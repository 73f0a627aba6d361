"""Blending of sorted discs on the GPU: one block for each active tile, one thread for each pixel, front to back."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cuda import Kernel, blocks_for, kernel
from glassplat.kernels.composite.cuda_tile import BUCKET, PIXELS, at, tile_steps
from glassplat.kernels.composite_discs.cuda_backward import (
    AROUND,
    DEPTH,
    MOMENTS,
    PULL,
    PULLS,
    THREADS,
    WARPS,
    G,
    composite_discs_backward,
    composite_discs_pulls,
)
from glassplat.kernels.composite_discs.cuda_tile import (
    COLUMNS,
    FINALS,
    KEPT_DEPTH,
    KEPT_SQUARES,
    KEPT_T,
    KEPT_TOTAL,
    KEPT_VALUES,
    LAST,
    MEDIAN,
    ORDERS,
    disc_tile_steps,
)
from glassplat.kernels.composite_discs.cuda_tile import DEPTH as Z
from glassplat.kernels.composite_discs.cuda_tile import INVERSE_DEPTH as INVERSE
from glassplat.kernels.maths.blending import ALPHA_MAX, TRANSMITTANCE_MIN
from glassplat.kernels.maths.disc import MAP
from glassplat.kernels.records import REAL_OF, TILE, Discs, TileBins

SUM_THREADS = 256


class Saved(NamedTuple):
    """What the backward pass needs from the forward pass.

    finals [A, 4, 256], orders [A, 2, 256] int32: of each pixel of the active tiles, the planes that `cuda_tile` names;
    orders count from the tile's first pair, -1 for none. looked_at [A] int32: how many pairs of each tile any pixel
    blended. bucket_tiles [B] int32: the active tile that each bucket belongs to, -1 for none. kept [B, D + 4, 256]:
    what each pixel had gathered before a bucket. outputs: image and depth.
    """

    finals: Tensor
    orders: Tensor
    looked_at: Tensor
    bucket_tiles: Tensor
    kept: Tensor
    outputs: tuple[Tensor, Tensor]


def composite_discs(
    discs: Discs, channels: Tensor, bins: TileBins, *, near: float, low_pass: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Saved]:
    """As `glassplat.kernels.composite_discs.cpu.composite_discs`."""
    num_channels, tiles, device = channels.shape[2], len(bins.active), channels.device
    shape = (bins.num_cameras, bins.height, bins.width)
    image, *flat = (channels.new_zeros(s) for s in ((*shape, num_channels), shape, shape, shape, shape))
    buckets = len(bins.pair_splats) // BUCKET + tiles
    alpha, depth, median, distortion = flat
    saved = Saved(
        channels.new_empty(tiles, FINALS, PIXELS),
        torch.empty(tiles, ORDERS, PIXELS, dtype=torch.int32, device=device),
        torch.empty(tiles, dtype=torch.int32, device=device),
        torch.full((buckets,), -1, dtype=torch.int32, device=device),
        channels.new_empty(buckets, KEPT_VALUES + num_channels, PIXELS),
        # Without their history: it holds this record, and would keep itself alive.
        (image.detach(), depth.detach()),
    )
    composite_discs_forward(REAL_OF[channels.dtype], num_channels)(
        tiles, PIXELS, *_geometry(discs), channels.view(-1), near, _sharpness(low_pass),
        bins.pair_splats, bins.tile_offsets, bins.active, *saved[:5], image, *flat,
    )  # fmt: skip
    return image, alpha, depth, median, distortion, saved


def composite_discs_gradients(
    discs: Discs, channels: Tensor, bins: TileBins, saved: Saved, v_outputs: Sequence[Tensor],
    *, near: float, low_pass: float, probed: bool,
) -> tuple[Tensor | None, ...]:  # fmt: skip
    """As `glassplat.kernels.composite_discs.cpu.composite_discs_gradients`."""
    real, (cameras, count, num_channels) = REAL_OF[channels.dtype], channels.shape
    tiles, size = len(bins.active), cameras * count
    pulls = channels.new_empty(tiles, num_channels + PULLS, PIXELS)
    composite_discs_pulls(real, num_channels)(
        tiles, PIXELS, bins.active, saved.finals, *saved.outputs, *v_outputs, pulls
    )  # fmt: skip
    rows = channels.new_zeros(len(bins.pair_splats), MOMENTS + num_channels)
    composite_discs_backward(real, num_channels)(
        blocks_for(len(saved.bucket_tiles), WARPS), THREADS, *_geometry(discs), channels.view(-1, num_channels),
        near, _sharpness(low_pass), bins.width, bins.height, bins.pair_splats, bins.tile_offsets, bins.active,
        saved.orders.view(-1), saved.looked_at, saved.bucket_tiles, saved.kept.view(-1), pulls.view(-1), rows,
    )  # fmt: skip
    sums = channels.new_empty(size, MOMENTS + num_channels)
    sum_disc_rows(real)(
        blocks_for(sums.numel(), SUM_THREADS), SUM_THREADS, rows, bins.pair_slots, bins.splat_offsets, sums
    )  # fmt: skip
    return _from_sums(sums, discs, num_channels, probed)


def _from_sums(sums: Tensor, discs: Discs, num_channels: int, probed: bool) -> tuple[Tensor | None, ...]:
    """Gradients of each disc from the sums over its pixels; what no pixel shows stays zero, finite or not."""
    leading, size = discs.opacities.shape, sums.shape[0]
    by_row = sums[:, :AROUND].unflatten(1, (3, 3))
    v_maps, alone = by_row[:, :, :2], by_row[:, :, 2:]
    through_map = torch.where(alone != 0, alone * discs.maps.view(-1, 3, 2), 0).sum(1)
    v_means = -through_map - sums[:, AROUND:G]
    gained, opacities = sums[:, G], discs.opacities.view(-1)
    v_opacities = torch.where(gained != 0, gained / opacities, 0)
    found = (v_means, v_maps.reshape(size, MAP), v_opacities, sums[:, DEPTH], sums[:, MOMENTS:])
    shaped = [tensor.reshape(*leading, *tensor.shape[1:]) for tensor in found]
    return (*shaped, sums[:, PULL:MOMENTS].reshape(*leading, 2) if probed else None)


def _sharpness(low_pass: float) -> float:
    """One over the variance of the low-pass."""
    return 1 / low_pass**2 if low_pass else float("inf")


def _geometry(discs: Discs) -> tuple[Tensor, ...]:
    """What stands for the discs of all cameras: centres, maps, opacities, depths, outlines' centres and conics."""
    outlines = discs.outlines
    return (
        discs.means2d.view(-1, 2),
        discs.maps.view(-1, MAP),
        discs.opacities.view(-1),
        discs.depths.view(-1),
        outlines.means2d.view(-1, 2),
        outlines.conics.view(-1, 3),
    )


@cache
def composite_discs_forward(real: type, num_channels: int = 6) -> Kernel:
    """Fills the images of the active tiles, and what the backward pass needs."""
    place, (load, cover) = tile_steps(real).place, disc_tile_steps(real)
    zero, half, one, two = real(0.0), real(0.5), real(1.0), real(2.0)
    t_min, alpha_max, stopped = real(TRANSMITTANCE_MIN), real(ALPHA_MAX), np.int32(PIXELS)

    @kernel(
        f"composite_discs_forward_{num_channels}",
        real,
        "real2 real2 real1 real1 real2 real2 real1 real real int1 long1 int1 "
        "real3 int3 int1 int1 real3 real4 real3 real3 real3 real3",
    )
    def forward(
        means, maps, opacities, depths, centers, conics, channels, near, sharpness, pair_splats, tile_offsets, active,
        finals, orders, looked_at, bucket_tiles, kept, image, alpha, depth, median, distortion,
    ):  # fmt: skip
        geometry = cuda.shared.array((PIXELS, COLUMNS), real)
        reached = cuda.shared.array(PIXELS, np.int32)
        members = cuda.shared.array(PIXELS, np.int32)
        most = cuda.shared.array(1, np.int32)
        sums = cuda.local.array(num_channels, real)
        n, pixel = cuda.blockIdx.x, cuda.threadIdx.x
        camera, x0, y0, columns, num_rows = place(active[n], image.shape[2], image.shape[1])
        column, row = pixel % TILE, pixel // TILE
        x, y, bit = real(np.int32(column)), real(np.int32(row)), np.int32(1 << row)
        inside = column < columns and row < num_rows
        running, last_order, middle_order = np.int32(inside), np.int32(-1), np.int32(-1)
        t, spread, far, middle, first_seen, total, squares = one, zero, zero, zero, zero, zero, zero
        for d in range(num_channels):
            sums[d] = zero
        if pixel == 0:
            most[0] = 0
        start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
        first_bucket = start // BUCKET + n
        for first in range(0, stop - start, PIXELS):
            if not cuda.syncthreads_or(running):
                break
            if start + first + pixel < stop:
                if pixel % BUCKET == 0:
                    bucket_tiles[first_bucket + (first + pixel) // BUCKET] = n
                s = pair_splats[start + first + pixel]
                reached[pixel] = load(
                    geometry, pixel, s, means, maps, opacities, depths, centers, conics, x0, y0, num_rows
                )
                members[pixel] = s
            cuda.syncthreads()
            here, group = np.int32(min(PIXELS, stop - start - first)), np.int32(0)
            while running != 0 and group < here:
                bucket = first_bucket + (first + group) // BUCKET
                kept[bucket, KEPT_T, pixel], kept[bucket, KEPT_DEPTH, pixel] = t, far
                kept[bucket, KEPT_TOTAL, pixel], kept[bucket, KEPT_SQUARES, pixel] = total, squares
                for d in range(num_channels):
                    kept[bucket, KEPT_VALUES + d, pixel] = sums[d]
                i = group
                group = np.int32(min(group + BUCKET, here))
                while i < group:
                    k = np.uint32(i)
                    if np.int32(reached[k] & bit) != 0:
                        _, met, e, covered, _ = cover(geometry, k, x, y, near, sharpness)
                        weight = min(covered, alpha_max) * t
                        left = t - weight
                        if covered > zero and left >= t_min:
                            inverse = e * geometry[k, INVERSE]
                            if last_order < 0:
                                first_seen = inverse
                            apart = inverse - first_seen
                            spread += weight * ((apart * (one - t) - two * total) * apart + squares)
                            total += weight * apart
                            squares += weight * apart * apart
                            z = met[2] * geometry[k, Z]
                            far += weight * z
                            last_order = np.int32(first + i)
                            if t > half:
                                middle, middle_order = z, last_order
                            t = left
                            for d in range(num_channels):
                                sums[d] += weight * channels[at(members[k] * num_channels + d)]
                        elif covered > zero:
                            i = stopped
                    i = np.int32(i + 1)
                if i > stopped:
                    running = np.int32(0)
        cuda.syncthreads()
        cuda.atomic.max(most, 0, np.int32(last_order + 1))
        cuda.syncthreads()
        if pixel == 0:
            looked_at[n] = most[0]
        finals[n, 0, pixel], finals[n, 1, pixel] = t, first_seen
        finals[n, 2, pixel], finals[n, 3, pixel] = total, squares
        orders[n, LAST, pixel], orders[n, MEDIAN, pixel] = last_order, middle_order
        if inside:
            alpha[camera, y0 + row, x0 + column], depth[camera, y0 + row, x0 + column] = one - t, far
            median[camera, y0 + row, x0 + column] = middle
            distortion[camera, y0 + row, x0 + column] = spread
            for d in range(num_channels):
                image[camera, y0 + row, x0 + column, d] = sums[d]

    return forward


@cache
def sum_disc_rows(real: type) -> Kernel:
    """One thread for each column of each disc: sums its pairs' rows in a fixed order."""
    zero = real(0.0)

    @kernel("sum_disc_rows", real, "real2 int1 long1 real2")
    def sum_up(rows, slots, offsets, sums):
        i, width = cuda.grid(1), rows.shape[1]
        s, column = i // width, i % width
        if s >= sums.shape[0]:
            return
        total = zero
        for k in range(offsets[s], offsets[s + 1]):
            total += rows[slots[k], column]
        sums[s, column] = total

    return sum_up
