"""Blending of sorted splats on the CPU.

Each pixel runs a short loop over the splats of its tile, from front to back:

    for splat in tile:
        alpha = min(0.99, 2^exponent(offset))              # 0 below 1/255
        if splat is glass:
            if t_glass (1 - alpha) < 1e-4: take no more glass
            mask    += mark alpha t t_glass
            t_glass *= 1 - alpha
        else:
            if t (1 - alpha) < 1e-4: stop
            image   += channels alpha t
            t       *= 1 - alpha

The loop runs for sixteen pixels at once:

    image   tiles of 16 x 16 pixels, a few for each task                               composite_forward
    tile    16 blocks, and its splats in chunks of 128, packed side by side (`fetch`)
    block   4 x 4 pixels, the lanes of one vector, and the splats that reach it        blend_block
            (`list_block`; glass as ~k)

Four channels are blended along with alpha; `blend_more` adds the others from stored weights. A stopped pixel keeps its
transmittance with a negative sign, so that one comparison finds the running lanes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.backend.cpu import ONE, Kernel, even_stride, inlined, kernel
from glassplat.kernels.backend.cpu_vector import (
    absolute,
    bits_of,
    drop_fourths,
    interleave,
    item,
    minimum,
    select,
    store,
    vector_kind,
)
from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.composite.cpu_backward import composite_backward
from glassplat.kernels.composite.cpu_discs import composite_discs, composite_discs_gradients
from glassplat.kernels.composite.cpu_tile import (
    SPLATS,
    STOP_AFTER,
    exponent,
    lane_of,
    list_block,
    list_plain_block,
    new_pair_rows,
    sum_pair_rows,
    tile_bounds,
)
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, Scalar
from glassplat.kernels.records import LEAST_ALPHA, ON_MEAN, REAL_OF, Deviation, Splats, TileBins

full, load = vector_kind(tile.LANES)
load_row = vector_kind(tile.BLOCK).load
BLOCK, ACROSS, BLOCKS, LANES, PIXELS = tile.BLOCK, tile.ACROSS, tile.BLOCKS, tile.LANES, tile.PIXELS
T, LAST, T_GLASS, LAST_GLASS, STATE = tile.T, tile.LAST, tile.T_GLASS, tile.LAST_GLASS, tile.STATE
MEAN_X, MEAN_Y, ORDER, VALUES = tile.MEAN_X, tile.MEAN_Y, tile.ORDER, tile.VALUES

# Planes of a tile's results; SUMS has one per channel. T_AGAIN, CENTER, DEVIATION and LEAN belong to the second
# traversal, which sums distances from the mean of the first.
MASK, T_AGAIN, CENTER, DEVIATION, LEAN, SUMS = (plane * tile.PIXELS for plane in range(6))


def _blend_block(real: type, with_glass: bool) -> Scalar:
    """Builds the loop over the splats of a block, with or without glass splats."""
    x_centers, y_centers = tile.pixel_centers(real)
    exp2 = tile.exp2_of(real)
    zero, t_min, alpha_max = real(0.0), real(TRANSMITTANCE_MIN), real(ALPHA_MAX)
    least = real(math.log2(ALPHA_MIN))

    @inlined
    def blend_block(state, at_state, planes, at, batch, width, entries, count, x, y, weights, keep):
        """Blends the first four channels; returns the number of splats processed, and whether any pixel still runs."""
        xs, ys = x_centers() + x, y_centers() + y
        none, most = full(zero), full(alpha_max)
        t, last = load(state, at_state + T), load(state, at_state + LAST)
        s0, s1 = load(planes, at + SUMS), load(planes, at + SUMS + PIXELS)
        s2, s3 = load(planes, at + SUMS + 2 * PIXELS), load(planes, at + SUMS + 3 * PIXELS)
        if with_glass:
            t_glass, last_glass = load(state, at_state + T_GLASS), load(state, at_state + LAST_GLASS)
            mask = load(planes, at + MASK)
        e = 0
        while e < count:
            k = item(entries, e)
            glass = with_glass and k < 0
            k = ~k if glass else k
            splat = k * width
            bits = exponent(batch, splat, xs - item(batch, splat + MEAN_X), ys - item(batch, splat + MEAN_Y))
            alpha = select(bits >= least, minimum(exp2(bits), most), none)
            position = full(item(batch, splat + ORDER))
            if with_glass and glass:
                weight = alpha * t_glass
                after = t_glass - weight
                alive = (after >= t_min) & (t > zero)
                t_glass = select(alive, after, -absolute(t_glass))
                last_glass = select(alive, position, last_glass)
                mask = mask + select(alive, weight * t * item(batch, splat + VALUES), none)
                weight = none
            else:
                weight = alpha * t
                after = t - weight
                alive = after >= t_min
                weight = select(alive, weight, none)
                t = select(alive, after, -absolute(t))
                last = select(alive, position, last)
                s0 = s0 + weight * item(batch, splat + VALUES)
                s1 = s1 + weight * item(batch, splat + VALUES + 1)
                s2 = s2 + weight * item(batch, splat + VALUES + 2)
                s3 = s3 + weight * item(batch, splat + VALUES + 3)
            if keep:
                store(weights, e * LANES, weight)
            e += 1
            if e % STOP_AFTER == 0 and bits_of(t > zero) == 0:
                break
        store(state, at_state + T, t)
        store(state, at_state + LAST, last)
        store(planes, at + SUMS, s0)
        store(planes, at + SUMS + PIXELS, s1)
        store(planes, at + SUMS + 2 * PIXELS, s2)
        store(planes, at + SUMS + 3 * PIXELS, s3)
        if with_glass:
            store(state, at_state + T_GLASS, t_glass)
            store(state, at_state + LAST_GLASS, last_glass)
            store(planes, at + MASK, mask)
        return e, bits_of(t > zero) != 0

    return blend_block


@inlined
def _blend_more(planes, at, batch, width, entries, count, column, weights):
    """Blends four more channels, starting at `column` of a splat, with the stored weights."""
    at += SUMS + (column - VALUES) * PIXELS
    s0, s1 = load(planes, at), load(planes, at + PIXELS)
    s2, s3 = load(planes, at + 2 * PIXELS), load(planes, at + 3 * PIXELS)
    for e in range(count):
        k = item(entries, e)
        if k >= 0:
            value, weight = k * width + column, load(weights, e * LANES)
            s0 = s0 + weight * item(batch, value)
            s1 = s1 + weight * item(batch, value + 1)
            s2 = s2 + weight * item(batch, value + 2)
            s3 = s3 + weight * item(batch, value + 3)
    store(planes, at, s0)
    store(planes, at + PIXELS, s1)
    store(planes, at + 2 * PIXELS, s2)
    store(planes, at + 3 * PIXELS, s3)


def _deviate_block(real: type) -> Scalar:
    x_centers, y_centers = tile.pixel_centers(real)
    exp2 = tile.exp2_of(real)
    zero, alpha_max, least = real(0.0), real(ALPHA_MAX), real(math.log2(ALPHA_MIN))
    on_mean = real(ON_MEAN * np.finfo(real).eps)

    @inlined
    def deviate_block(state, at_state, planes, at, batch, width, entries, count, x, y, column):
        """Sums the weighted distances of `column` from CENTER, over splats that `blend_block` has blended."""
        xs, ys = x_centers() + x, y_centers() + y
        none, most = full(zero), full(alpha_max)
        t, last, center = load(planes, at + T_AGAIN), load(state, at_state + LAST), load(planes, at + CENTER)
        deviation, lean, slack = load(planes, at + DEVIATION), load(planes, at + LEAN), on_mean * absolute(center)
        for e in range(count):
            k = item(entries, e)
            if k >= 0:
                splat = k * width
                bits = exponent(batch, splat, xs - item(batch, splat + MEAN_X), ys - item(batch, splat + MEAN_Y))
                shown = (bits >= least) & (last >= item(batch, splat + ORDER))
                weight = select(shown, minimum(exp2(bits), most), none) * t
                t = t - weight
                difference = item(batch, splat + column) - center
                deviation = deviation + weight * absolute(difference)
                lean = lean + select(difference > slack, weight, select(difference < -slack, -weight, none))
        store(planes, at + T_AGAIN, t)
        store(planes, at + DEVIATION, deviation)
        store(planes, at + LEAN, lean)

    return deviate_block


@inlined
def _write_whole_block(state, at, planes, i, image, alpha, first, width, channels):
    """Writes a block of three or four channels that lies within the image; `first` is its first pixel."""
    s0, s1 = load(planes, SUMS + i), load(planes, SUMS + PIXELS + i)
    s2, s3 = load(planes, SUMS + 2 * PIXELS + i), load(planes, SUMS + 3 * PIXELS + i)
    rows = interleave((s0, s1, s2, s3))
    for y in range(BLOCK):
        store(alpha, first + y * width, ONE - load_row(state, at + T + i + y * BLOCK))
        if channels == 4:
            store(image, (first + y * width) * 4, rows[y])
        else:
            eight, four = drop_fourths(rows[y])
            store(image, (first + y * width) * 3, eight)
            store(image, (first + y * width) * 3 + 8, four)


@inlined
def _write_block(state, at, planes, i, image, alpha, first, width, columns, rows, channels):
    for y in range(min(BLOCK, rows)):
        for x in range(min(BLOCK, columns)):
            pixel, lane = first + y * width + x, i + y * BLOCK + x
            alpha[pixel] = ONE - state[at + T + lane]
            for d in range(channels):
                image[pixel * channels + d] = planes[SUMS + d * PIXELS + lane]


@inlined
def write_tile(state, at, planes, image, alpha, first, width, columns, rows, channels):
    """Writes a tile to the flat images."""
    for b in range(BLOCKS):
        x, y = b % ACROSS * BLOCK, b // ACROSS * BLOCK
        corner = first + y * width + x
        if 3 <= channels <= 4 and x + BLOCK <= columns and y + BLOCK <= rows:
            _write_whole_block(state, at, planes, b * LANES, image, alpha, corner, width, channels)
        elif x < columns and y < rows:
            _write_block(state, at, planes, b * LANES, image, alpha, corner, width, columns - x, rows - y, channels)


@inlined
def write_mask(planes, mask, first, width, columns, rows):
    """Writes a tile to the flat mask."""
    for y in range(rows):
        for x in range(columns):
            mask[first + y * width + x] = planes[MASK + lane_of(x, y)]


@inlined
def write_deviation(planes, where, deviation, first, width, columns, rows):
    """Writes a tile to the deviation, which is flat like its factor `where`."""
    for y in range(rows):
        for x in range(columns):
            pixel = first + y * width + x
            deviation[pixel] = planes[DEVIATION + lane_of(x, y)] * where[pixel]


def _begin_deviation(real: type) -> Scalar:
    one, zero, least_alpha = real(1.0), real(0.0), real(LEAST_ALPHA)

    @inlined
    def begin_deviation(state, at, planes, channel, where, first, width, columns, rows):
        """Prepares the second traversal of a tile; returns False if `where` is zero throughout."""
        wanted = False
        for y in range(rows):
            for x in range(columns):
                wanted |= where[first + y * width + x] != zero
        for i in range(PIXELS):
            covered = one - state[at + T + i]
            total = planes[SUMS + channel * PIXELS + i]
            planes[CENTER + i] = total / max(covered, least_alpha) if covered > least_alpha else zero
            planes[T_AGAIN + i] = one
            planes[DEVIATION + i] = planes[LEAN + i] = zero
        return wanted

    return begin_deviation


@functools.cache
def composite_forward(real: type) -> Kernel:
    """Builds the kernel that blends all tiles."""
    pack, reached, begin = tile.pack_of(real), tile.reached_of(real), tile.begin_state(real)
    blend_plain, blend_mixed, deviate_block = _blend_block(real, False), _blend_block(real, True), _deviate_block(real)
    begin_deviation, zero = _begin_deviation(real), real(0.0)
    CHUNK, GLASS, TILES = tile.CHUNK, tile.GLASS, tile.TILES

    @kernel("composite_forward", real)
    def forward(
        means, conics, opacities, channels, marks, splats_per_camera, num_primary, image_width, height,
        deviation_channel, where,
        pair_splats, tile_offsets, splat_offsets, active,
        packed, pairs, state, spread, image, alpha, mask, deviation,
    ):  # fmt: skip
        num_splats, num_channels = channels.shape
        width, groups = packed.size // max(1, num_splats), (num_channels + 3) // 4
        num_chunks = (num_splats + SPLATS - 1) // SPLATS
        pack_stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * pack_stride % num_chunks
            for s in range(chunk * SPLATS, min(num_splats, (chunk + 1) * SPLATS)):
                if splat_offsets[s + 1] > splat_offsets[s]:
                    pack(packed, s * width, means[s], conics[s], opacities[s])
                    glass = s % splats_per_camera - num_primary
                    for d in range(width - VALUES):
                        packed[s * width + VALUES + d] = channels[s, d] if d < num_channels else zero
                    if glass >= 0:
                        packed[s * width + VALUES] = marks[s // splats_per_camera, glass]
        num_tasks = (active.size + TILES - 1) // TILES
        stride = even_stride(num_tasks)
        for task in prange(num_tasks):
            planes = np.empty(SUMS + groups * 4 * PIXELS, real)
            batch, entries = np.empty(CHUNK * width, real), np.empty(CHUNK + 1, np.int32)
            weights: Any = np.empty(CHUNK * LANES, real)
            begun = task * stride % num_tasks * TILES
            for n in range(begun, min(active.size, begun + TILES)):
                camera, x0, y0, columns, rows = tile_bounds(active[n], image_width, height)
                start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
                at = n * STATE
                running = begin(state, at, columns, rows)
                if start == stop:
                    continue
                planes[MASK : MASK + PIXELS], planes[SUMS:] = zero, zero
                for first in range(start, stop, CHUNK):
                    last = min(first + CHUNK, stop)
                    tile.fetch(batch, packed, pair_splats, first, last, width, x0, y0)
                    any_glass = False
                    for p in range(first, last):
                        bits = reached(batch, (p - first) * width) & running
                        if pair_splats[p] - camera * splats_per_camera >= num_primary:
                            bits |= np.int64(1) << GLASS
                            any_glass = True
                        pairs[p] = bits
                        batch[(p - first) * width + ORDER] = real(np.int32(p - start))
                    for b in range(BLOCKS):
                        if any_glass:
                            count = list_block(entries, pairs, first, last, b)
                        else:
                            count = list_plain_block(entries, pairs, first, last, b)
                        if count == 0:
                            continue
                        x, y = real(b % ACROSS * BLOCK), real(b // ACROSS * BLOCK)
                        i = b * LANES
                        if any_glass:
                            taken, runs = blend_mixed(
                                state, at + i, planes, i, batch, width, entries, count, x, y, weights, groups > 1
                            )
                        else:
                            taken, runs = blend_plain(
                                state, at + i, planes, i, batch, width, entries, count, x, y, weights, groups > 1
                            )
                        for group in range(1, groups):
                            _blend_more(planes, i, batch, width, entries, taken, VALUES + 4 * group, weights)
                        if not runs:
                            running &= ~(np.int64(1) << b)
                            # Splats that the stopped block has skipped must not reach it in the backward pass.
                            for e in range(taken, count):
                                k = entries[e]
                                pairs[first + (~k if k < 0 else k)] &= ~(np.int32(1) << b)
                    if running == 0:
                        stop = last
                        break
                tile.finish_state(state, at)
                corner = (camera * height + y0) * image_width + x0
                write_tile(state, at, planes, image, alpha, corner, image_width, columns, rows, num_channels)
                if num_primary < splats_per_camera:
                    write_mask(planes, mask, corner, image_width, columns, rows)
                if deviation_channel < 0:
                    continue
                if not begin_deviation(state, at, planes, deviation_channel, where, corner, image_width, columns, rows):
                    continue
                for first in range(start, stop, CHUNK):
                    last = min(first + CHUNK, stop)
                    tile.fetch(batch, packed, pair_splats, first, last, width, x0, y0)
                    for p in range(first, last):
                        batch[(p - first) * width + ORDER] = real(np.int32(p - start))
                    for b in range(BLOCKS):
                        count = list_block(entries, pairs, first, last, b)
                        x, y = real(b % ACROSS * BLOCK), real(b // ACROSS * BLOCK)
                        deviate_block(
                            state, at + b * LANES, planes, b * LANES, batch, width, entries, count, x, y,
                            VALUES + deviation_channel,
                        )  # fmt: skip
                keep = n * 2 * PIXELS
                spread[keep : keep + PIXELS] = planes[CENTER : CENTER + PIXELS]
                spread[keep + PIXELS : keep + 2 * PIXELS] = planes[LEAN : LEAN + PIXELS]
                write_deviation(planes, where, deviation, corner, image_width, columns, rows)

    return forward


__all__ = ["composite", "composite_discs", "composite_discs_gradients", "composite_gradients"]


class Saved(NamedTuple):
    """Flat results of the forward pass for the backward pass.

    Packed splats, blocks reached by each pair (`cpu_tile.GLASS`), and final states of active tiles. If a deviation is
    requested, also the channel's mean in each pixel of active tiles, and its lean: the weight of splats above the mean
    minus that of splats below.
    """

    packed: Tensor
    pairs: Tensor
    state: Tensor
    spread: Tensor


def composite(
    splats: Splats, channels: Tensor, bins: TileBins,
    *, marks: Tensor, num_primary: int, deviation: Deviation | None, needs_gradients: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Saved]:  # fmt: skip
    """Image [C, H, W, D], alpha, mask and deviation [C, H, W], and the state for `composite_gradients`.

    The state is small on the CPU, and returned even if no gradients are needed.
    """
    cameras, count, num_channels = channels.shape
    shape = (bins.num_cameras, bins.height, bins.width)
    dtype, tiles = channels.dtype, len(bins.active)
    # Zeros of NumPy, because untouched pages of many panes take no memory.
    sizes = (*shape, num_channels), shape, shape
    image, alpha, mask = (torch.from_numpy(np.zeros(size, REAL_OF[dtype])) for size in sizes)
    deviated = torch.zeros(shape if deviation else (0, 0, 0), dtype=dtype)
    # Arrays of PyTorch, because they are aligned to cache lines, and a packed splat fills one.
    lengths = cameras * count * tile.row_width(VALUES, num_channels), tiles * STATE
    packed, state = (torch.empty(length, dtype=dtype) for length in lengths)
    spread = torch.zeros(tiles * 2 * PIXELS if deviation else 0, dtype=dtype)
    saved = Saved(packed, torch.empty(len(bins.pair_splats), dtype=torch.int32), state, spread)
    where = tile.flat(deviation.where.detach()) if deviation else spread
    composite_forward(REAL_OF[channels.dtype])(
        *tile.joined_cameras((*splats[:3], channels)), marks, count, num_primary, bins.width, bins.height,
        deviation.channel if deviation else -1, where,
        bins.pair_splats, bins.tile_offsets, bins.splat_offsets, bins.active,
        *saved, *(tile.flat(output) for output in (image, alpha, mask, deviated)),
    )  # fmt: skip
    return image, alpha, mask, deviated, saved


def composite_gradients(
    splats: Splats, channels: Tensor, bins: TileBins, saved: Saved, v_outputs: Sequence[Tensor],
    *, marks: Tensor, num_primary: int, deviation: Deviation | None, with_absgrad: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Gradients of means2d, conics, opacities, channels and `absgrad`, given those of image, alpha, mask and deviation.

    That of a mark is in the place of its splat's first channel; that of `absgrad` is empty without `with_absgrad`.
    """
    cameras, count, num_channels = channels.shape
    rows = new_pair_rows(bins, tile.row_width(tile.PAIR_VALUES, num_channels), channels.dtype)
    *v_images, v_deviation = v_outputs
    channel, through_mean = -1, False
    if deviation:
        channel, through_mean = deviation.channel, deviation.through_mean
        v_deviation = v_deviation * deviation.where
    composite_backward(REAL_OF[channels.dtype], with_absgrad)(
        cameras * count, num_primary < count, num_channels, bins.width, bins.height, channel, through_mean,
        bins.pair_splats, bins.tile_offsets, bins.active, *saved,
        *(tile.flat(v) for v in (*v_images, v_deviation)), rows,
    )  # fmt: skip
    return sum_pair_rows(rows, bins, splats, num_channels, with_absgrad)
