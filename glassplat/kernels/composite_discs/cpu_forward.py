"""Blending of sorted discs, tile by tile, block by block and front to back."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numba import prange

from glassplat.kernels.backend.cpu import Kernel, even_stride, inlined, kernel
from glassplat.kernels.backend.cpu_vector import absolute, bits_of, item, minimum, select, store, vector_kind
from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.composite.cpu_tile import lane_of, list_block
from glassplat.kernels.composite_discs import cpu_tile as discs
from glassplat.kernels.maths.blending import ALPHA_MAX, TRANSMITTANCE_MIN, Scalar

# Planes of a tile's results; SUMS has one per channel.
DEPTH, MIDDLE, DISTORTION, SUMS = (plane * tile.PIXELS for plane in range(4))
STOP_AFTER = 8
"""Discs after which a block looks whether all of its pixels have stopped."""
SPLATS = 512
"""Discs per task that packs them."""


def _blend_block(real: type) -> Scalar:
    """Builds the loop over the discs of a block."""
    full, load = vector_kind(real, tile.LANES)
    cover = discs.disc_functions(real).cover
    zero, half, one, t_min, alpha_max = real(0.0), real(0.5), real(1.0), real(TRANSMITTANCE_MIN), real(ALPHA_MAX)
    T, LAST, MEDIAN, FIRST, TOTAL, SQUARES = (
        discs.T, discs.LAST, discs.MEDIAN, discs.FIRST, discs.TOTAL, discs.SQUARES
    )  # fmt: skip
    ORDER, Z, INVERSE = discs.ORDER, discs.DEPTH, discs.INVERSE_DEPTH

    @inlined
    def blend_block(state, at_state, planes, at, batch, width, entries, count, x, y, near, sharpness, weights):
        """Fills the weights; returns how many discs it took, and whether any pixel still runs."""
        none, most = full(zero), full(alpha_max)
        t, last, middle_at = load(state, at_state + T), load(state, at_state + LAST), load(state, at_state + MEDIAN)
        first, total = load(state, at_state + FIRST), load(state, at_state + TOTAL)
        squares, distortion = load(state, at_state + SQUARES), load(planes, at + DISTORTION)
        depth, middle = load(planes, at + DEPTH), load(planes, at + MIDDLE)
        e = 0
        while e < count:
            splat = item(entries, e) * width
            _, met, nearness, coverage, _ = cover(batch, splat, x, y, near, sharpness)
            alpha = minimum(coverage, most)
            weight = alpha * t
            after = t - weight
            alive = after >= t_min
            weight = select(alive, weight, none)
            z, position = met[2] * item(batch, splat + Z), full(item(batch, splat + ORDER))
            inverse = nearness * item(batch, splat + INVERSE)
            # Measured from the first one that a pixel shows: squares of what is alike would cancel.
            first = select(t >= one, inverse, first)
            apart = inverse - first
            part = (apart * apart) * (one - t) - (apart * total) * (one + one) + squares
            distortion = distortion + weight * part
            total, squares = total + weight * apart, squares + weight * (apart * apart)
            depth = depth + weight * z
            halfway = (t > half) & (weight > zero)
            middle, middle_at = select(halfway, z, middle), select(halfway, position, middle_at)
            last = select(weight > zero, position, last)
            t = select(alive, after, -absolute(t))
            store(weights, e * tile.LANES, weight)
            e += 1
            if e % STOP_AFTER == 0 and bits_of(t > zero) == 0:
                break
        store(state, at_state + T, t)
        store(state, at_state + LAST, last)
        store(state, at_state + MEDIAN, middle_at)
        store(state, at_state + FIRST, first)
        store(state, at_state + TOTAL, total)
        store(state, at_state + SQUARES, squares)
        store(planes, at + DISTORTION, distortion)
        store(planes, at + DEPTH, depth)
        store(planes, at + MIDDLE, middle)
        return e, bits_of(t > zero) != 0

    return blend_block


def _blend_channels(real: type) -> Scalar:
    load, zero = vector_kind(real, tile.LANES).load, real(0.0)
    PIXELS, LANES = tile.PIXELS, tile.LANES

    @inlined
    def blend_channels(planes, at, batch, width, entries, count, column, weights):
        """Adds four channels, the first of which is a disc's `column`."""
        s0, s1 = load(planes, at), load(planes, at + PIXELS)
        s2, s3 = load(planes, at + 2 * PIXELS), load(planes, at + 3 * PIXELS)
        for e in range(count):
            weight, value = load(weights, e * LANES), item(entries, e) * width + column
            # What no pixel of the block shows may hold anything.
            if bits_of(weight > zero) != 0:
                s0 = s0 + weight * item(batch, value)
                s1 = s1 + weight * item(batch, value + 1)
                s2 = s2 + weight * item(batch, value + 2)
                s3 = s3 + weight * item(batch, value + 3)
        store(planes, at, s0)
        store(planes, at + PIXELS, s1)
        store(planes, at + 2 * PIXELS, s2)
        store(planes, at + 3 * PIXELS, s3)

    return blend_channels


def _begin(real: type) -> Scalar:
    zero, one, never = real(0.0), real(1.0), real(-1.0)
    BLOCK, ACROSS, LANES, BLOCKS = tile.BLOCK, tile.ACROSS, tile.LANES, tile.BLOCKS
    T, LAST, FIRST, STATE = discs.T, discs.LAST, discs.FIRST, discs.STATE

    @inlined
    def begin(state, at, columns, rows):
        """A fresh state; pixels beyond the image's edge start as stopped. Returns bits of blocks that run."""
        state[at + LAST : at + FIRST] = never
        state[at + FIRST : at + STATE] = zero
        running = np.int64(0)
        for b in range(BLOCKS):
            x, y = b % ACROSS * BLOCK, b // ACROSS * BLOCK
            running |= np.int64(x < columns and y < rows) << b
            for i in range(LANES):
                inside = x + i % BLOCK < columns and y + i // BLOCK < rows
                state[at + T + b * LANES + i] = one if inside else zero
        return running

    return begin


def _write_tile(real: type) -> Scalar:
    one, PIXELS, T = real(1.0), tile.PIXELS, discs.T

    @inlined
    def write_tile(state, at, planes, images, first, width, columns, rows, channels):
        """Puts a tile into the images, which are flat, and takes off the signs that tell which pixels have stopped."""
        image, alpha, depth, median, distortion = images
        for i in range(PIXELS):
            state[at + T + i] = abs(state[at + T + i])
        for y in range(rows):
            for x in range(columns):
                pixel, lane = first + y * width + x, lane_of(x, y)
                alpha[pixel] = one - state[at + T + lane]
                depth[pixel], median[pixel] = planes[DEPTH + lane], planes[MIDDLE + lane]
                distortion[pixel] = planes[DISTORTION + lane]
                for d in range(channels):
                    image[pixel * channels + d] = planes[SUMS + d * PIXELS + lane]

    return write_tile


@functools.cache
def composite_discs_forward(real: type) -> Kernel:
    """Builds the kernel that blends all tiles."""
    place, reached = tile.tile_functions(real).place, tile.tile_functions(real).reached
    pack, fetch, _ = discs.disc_functions(real)
    blend_block, blend_channels, begin = _blend_block(real), _blend_channels(real), _begin(real)
    write_tile, zero = _write_tile(real), real(0.0)
    BLOCK, ACROSS, BLOCKS, LANES, PIXELS = tile.BLOCK, tile.ACROSS, tile.BLOCKS, tile.LANES, tile.PIXELS
    VALUES, ORDER, CHUNK, STATE = discs.VALUES, discs.ORDER, tile.CHUNK, discs.STATE

    @kernel("composite_discs_forward", real)
    def forward(
        means, maps, opacities, depths, outline_centers, conics, channels, image_width, height, near, sharpness,
        pair_splats, tile_offsets, splat_offsets, active, packed, pairs, state, images,
    ):  # fmt: skip
        num_discs, num_channels = channels.shape
        width, groups = packed.size // max(1, num_discs), (num_channels + 3) // 4
        num_chunks = (num_discs + SPLATS - 1) // SPLATS
        pack_stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * pack_stride % num_chunks
            for s in range(chunk * SPLATS, min(num_discs, (chunk + 1) * SPLATS)):
                if splat_offsets[s + 1] > splat_offsets[s]:
                    pack(packed, s * width, means[s], maps[s], opacities[s], depths[s], outline_centers[s], conics[s])
                    for d in range(width - VALUES):
                        packed[s * width + VALUES + d] = channels[s, d] if d < num_channels else zero
        stride = even_stride(active.size)
        for task in prange(active.size):
            n = task * stride % active.size
            camera, x0, y0, columns, rows = place(active[n], image_width, height)
            start, stop = tile_offsets[active[n]], tile_offsets[active[n] + 1]
            at = n * STATE
            running = begin(state, at, columns, rows)
            if start == stop:
                continue
            planes = np.empty(SUMS + groups * 4 * PIXELS, real)
            planes[:] = zero
            batch, entries = np.empty(CHUNK * width, real), np.empty(CHUNK + 1, np.int32)
            weights: Any = np.empty(CHUNK * LANES, real)
            for first in range(start, stop, CHUNK):
                last = min(first + CHUNK, stop)
                fetch(batch, packed, pair_splats, first, last, width, x0, y0)
                for p in range(first, last):
                    pairs[p] = reached(batch, (p - first) * width) & running
                    batch[(p - first) * width + ORDER] = real(np.int32(p - start))
                for b in range(BLOCKS):
                    count = list_block(entries, pairs, first, last, b)
                    if count == 0:
                        continue
                    x, y = real(b % ACROSS * BLOCK), real(b // ACROSS * BLOCK)
                    i = b * LANES
                    taken, runs = blend_block(
                        state, at + i, planes, i, batch, width, entries, count, x, y, near, sharpness, weights
                    )
                    for group in range(groups):
                        blend_channels(
                            planes, SUMS + 4 * group * PIXELS + i, batch, width, entries, taken, VALUES + 4 * group,
                            weights,
                        )  # fmt: skip
                    if not runs:
                        running &= ~(np.int64(1) << b)
                        # What the block was not asked about any more does not reach it in the backward pass either.
                        for e in range(taken, count):
                            pairs[first + entries[e]] &= ~(np.int32(1) << b)
                if running == 0:
                    break
            corner = (camera * height + y0) * image_width + x0
            write_tile(state, at, planes, images, corner, image_width, columns, rows, num_channels)

    return forward
