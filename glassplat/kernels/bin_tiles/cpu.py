"""Binning on the CPU: which tiles a splat touches, the splats by depth, and the two together as one list per tile.

Work is split into chunks that depend on the data alone, and each chunk knows from prefix sums where its results go, so
that they are the same for any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.maths.projection import ellipse_maths
from glassplat.kernels.splats import TILE, Splats, TileBins, check_pair_count
from glassplat.kernels.tensor_checks import REAL_OF

KEY_OF = {torch.float32: np.uint32, torch.float64: np.uint64}
SPAN_CHUNK = 1024
DIGIT_BITS = 11
SORT_CHUNKS, SORT_CHUNK = 16, 8192
PAIR_CHUNKS, PAIR_CHUNK = 64, 2048


def bin_tiles(splats: Splats, width: int, height: int, active_tiles: Tensor | None) -> TileBins:
    """Lists the splats of every tile; contiguous tensors."""
    num_cameras, per_camera = splats.depths.shape
    rows, columns, count = -(-height // TILE), -(-width // TILE), num_cameras * per_camera
    real, key = REAL_OF[splats.depths.dtype], KEY_OF[splats.depths.dtype]
    arrays = (tensor.numpy() for tensor in splats)
    means2d, conics, opacities, depths, radii = (a.reshape(count, *a.shape[2:]) for a in arrays)
    mask = np.zeros((0, 0, 0), np.bool_) if active_tiles is None else active_tiles.numpy()
    spans, span_offsets, first_rows, splat_offsets = tile_spans(real)(
        means2d, conics, opacities, radii, mask, num_cameras, width, height
    )
    check_pair_count(int(splat_offsets[-1]))
    order, starts = depth_order(key)(depths.view(key), splat_offsets, num_cameras)
    pair_splats, tile_offsets, pair_slots = tile_pairs()(
        order, starts, spans, span_offsets, first_rows, splat_offsets, mask, rows, columns
    )
    tiles = num_cameras * rows * columns
    active = torch.arange(tiles, dtype=torch.int32) if active_tiles is None else active_tiles.flatten().nonzero()[:, 0]
    return TileBins(
        pair_splats=torch.from_numpy(pair_splats),
        tile_offsets=torch.from_numpy(tile_offsets),
        pair_slots=torch.from_numpy(pair_slots),
        splat_offsets=torch.from_numpy(splat_offsets),
        active=active.to(torch.int32),
        width=width,
        height=height,
        num_cameras=num_cameras,
    )


@cache
def tile_spans(real: type) -> Kernel:
    """Finds the tile columns that each splat touches, tile row by tile row.

    Returns:
        spans [R, 2]: first and last tile column; last < first where a row is not touched.
        span_offsets [S + 1]: where the rows of each splat begin in `spans`.
        first_rows [S]: tile row of each splat's first span.
        splat_offsets [S + 1]: active tiles of all splats before.
    """
    half_height, outline, band = ellipse_maths()
    pixel_range = pixel_ranges()

    @kernel("tile_spans", real)
    def spans_of(means2d, conics, opacities, radii, active_tiles, num_cameras, width, height):
        num_splats = opacities.size
        per_camera = num_splats // max(1, num_cameras)
        num_chunks = (num_splats + SPAN_CHUNK - 1) // SPAN_CHUNK
        masked = active_tiles.size > 0
        heights = np.empty(num_splats)
        first_rows = np.empty(num_splats, np.int32)
        span_offsets, splat_offsets = np.zeros(num_splats + 1, np.int64), np.zeros(num_splats + 1, np.int64)
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            for s in range(chunk * SPAN_CHUNK, min(num_splats, (chunk + 1) * SPAN_CHUNK)):
                if not (radii[s, 0] > 0 and abs(means2d[s, 0]) + abs(means2d[s, 1]) < np.inf):
                    continue
                y = np.float64(means2d[s, 1])
                reach = half_height(conics[s, 0], conics[s, 1], conics[s, 2], opacities[s])
                first, last = pixel_range(y - reach, y + reach, height)
                if first <= last and reach >= 0.0:
                    heights[s] = reach
                    first_rows[s] = first // TILE
                    span_offsets[s + 1] = last // TILE - first // TILE + 1
        for s in range(num_splats):
            span_offsets[s + 1] += span_offsets[s]
        spans = np.empty((span_offsets[num_splats], 2), np.int32)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            for s in range(chunk * SPAN_CHUNK, min(num_splats, (chunk + 1) * SPAN_CHUNK)):
                begin, end = span_offsets[s], span_offsets[s + 1]
                if begin == end:
                    continue
                x, y, reach = np.float64(means2d[s, 0]), np.float64(means2d[s, 1]), heights[s]
                shape = outline(conics[s, 0], conics[s, 1], conics[s, 2], reach)
                first, last = pixel_range(y - reach, y + reach, height)
                count = 0
                for i in range(begin, end):
                    row = first_rows[s] + i - begin
                    low, high = max(first, row * TILE) + 0.5 - y, min(last, row * TILE + TILE - 1) + 0.5 - y
                    left, right = band(shape, low, high)
                    first_pixel, last_pixel = pixel_range(x + left, x + right, width)
                    spans[i, 0], spans[i, 1] = 0, -1
                    if first_pixel > last_pixel:
                        continue
                    spans[i, 0], spans[i, 1] = first_pixel // TILE, last_pixel // TILE
                    count += spans[i, 1] - spans[i, 0] + 1
                    if masked:
                        for column in range(spans[i, 0], spans[i, 1] + 1):
                            count -= not active_tiles[s // per_camera, row, column]
                splat_offsets[s + 1] = count
        for s in range(num_splats):
            splat_offsets[s + 1] += splat_offsets[s]
        return spans, span_offsets, first_rows, splat_offsets

    return spans_of


def pixel_ranges() -> Callable[..., Any]:
    """Builds the function that finds the pixels between two coordinates."""

    @inlined
    def pixel_range(low, high, size):
        """First and last pixel whose centre lies in [low, high], within an image of that size."""
        # Clamped before the conversion, so that infinities are well defined.
        first = np.int64(math.ceil(min(max(low - 0.5, 0.0), float(size))))
        last = np.int64(math.floor(min(max(high - 0.5, -1.0), float(size - 1))))
        return first, last

    return pixel_range


@cache
def depth_order(key: type) -> Kernel:
    """Sorts the splats of each camera that have any tile by depth, nearest first, equal depths by index.

    Depths are positive, so their bits, taken as integers of type `key`, sort as they do: a radix sort from the lowest
    digit, each pass a counting sort.

    Returns:
        order [V]: splats, camera by camera.
        starts [C + 1]: where each camera begins in `order`.
    """
    num_digits = -(-np.dtype(key).itemsize * 8 // DIGIT_BITS)
    num_values = 1 << DIGIT_BITS
    digit_mask = key(num_values - 1)
    digit_bits = key(DIGIT_BITS)

    @kernel("depth_order", key)
    def order_of(keys, splat_offsets, num_cameras):
        num_splats = keys.size
        per_camera = num_splats // max(1, num_cameras)
        chunk_size = max(SORT_CHUNK, (per_camera + SORT_CHUNKS - 1) // SORT_CHUNKS)
        num_chunks = (per_camera + chunk_size - 1) // chunk_size
        starts = np.arange(num_cameras + 1) * per_camera
        places = np.empty((num_cameras * num_chunks, num_values), np.int64)
        sorted_keys, sorted_splats = np.empty((2, num_splats), key), np.empty((2, num_splats), np.int32)
        for digit in range(num_digits):
            shift = key(digit) * digit_bits
            source_keys, source_splats = sorted_keys[digit & 1], sorted_splats[digit & 1]
            target_keys, target_splats = sorted_keys[1 - (digit & 1)], sorted_splats[1 - (digit & 1)]
            for task in prange(num_cameras * num_chunks):
                camera, chunk = task // num_chunks, task % num_chunks
                begin = starts[camera] + chunk * chunk_size
                place = places[task]
                place[:] = 0
                for i in range(begin, min(begin + chunk_size, starts[camera + 1])):
                    if digit == 0:
                        source_keys[i] = keys[i]
                        source_splats[i] = i
                    if digit > 0 or splat_offsets[i + 1] > splat_offsets[i]:
                        place[(source_keys[i] >> shift) & digit_mask] += 1
            total = 0
            new_starts = np.empty(num_cameras + 1, np.int64)
            for camera in range(num_cameras):
                new_starts[camera] = total
                for value in range(num_values):
                    for task in range(camera * num_chunks, (camera + 1) * num_chunks):
                        held = places[task, value]
                        places[task, value] = total
                        total += held
            new_starts[num_cameras] = total
            for task in prange(num_cameras * num_chunks):
                camera, chunk = task // num_chunks, task % num_chunks
                begin = starts[camera] + chunk * chunk_size
                place = places[task]
                for i in range(begin, min(begin + chunk_size, starts[camera + 1])):
                    if digit > 0 or splat_offsets[i + 1] > splat_offsets[i]:
                        value = (source_keys[i] >> shift) & digit_mask
                        target = place[value]
                        place[value] = target + 1
                        target_keys[target] = source_keys[i]
                        target_splats[target] = source_splats[i]
            starts = new_starts
        return sorted_splats[num_digits & 1, : starts[num_cameras]], starts

    return order_of


@cache
def tile_pairs() -> Kernel:
    """Lists the splats of each tile in depth order: a counting sort of all (splat, tile) pairs by tile.

    Returns:
        pair_splats [P], tile_offsets [C * T + 1], pair_slots [P], as in `TileBins`.
    """

    @kernel("tile_pairs", np.int32)
    def pairs_of(order, starts, spans, span_offsets, first_rows, splat_offsets, active_tiles, rows, columns):
        num_cameras, num_splats, num_tiles = starts.size - 1, first_rows.size, rows * columns
        per_camera = num_splats // max(1, num_cameras)
        # Each splat's tiles in a row, in place of spans: read twice below, in an order that defeats the caches.
        tiles = np.empty(splat_offsets[num_splats], np.int32)
        num_span_chunks = (num_splats + SPAN_CHUNK - 1) // SPAN_CHUNK
        stride = even_stride(num_span_chunks)
        for task in prange(num_span_chunks):
            chunk = task * stride % num_span_chunks
            for s in range(chunk * SPAN_CHUNK, min(num_splats, (chunk + 1) * SPAN_CHUNK)):
                slot = splat_offsets[s]
                for i in range(span_offsets[s], span_offsets[s + 1] if splat_offsets[s + 1] > slot else 0):
                    row = first_rows[s] + i - span_offsets[s]
                    for column in range(spans[i, 0], spans[i, 1] + 1):
                        if active_tiles.size == 0 or active_tiles[s // per_camera, row, column]:
                            tiles[slot] = row * columns + column
                            slot += 1
        longest = 0
        for camera in range(num_cameras):
            longest = max(longest, starts[camera + 1] - starts[camera])
        chunk_size = max(PAIR_CHUNK, (longest + PAIR_CHUNKS - 1) // PAIR_CHUNKS)
        num_chunks = (longest + chunk_size - 1) // chunk_size
        places = np.empty((num_cameras * num_chunks, num_tiles), np.int32)
        for task in prange(num_cameras * num_chunks):
            camera, chunk = task // num_chunks, task % num_chunks
            begin = starts[camera] + chunk * chunk_size
            place = places[task]
            place[:] = 0
            for i in range(begin, min(begin + chunk_size, starts[camera + 1])):
                s = order[i]
                for slot in range(splat_offsets[s], splat_offsets[s + 1]):
                    place[tiles[slot]] += 1
        tile_offsets = np.zeros(num_cameras * num_tiles + 1, np.int64)
        total = 0
        for camera in range(num_cameras):
            for tile in range(num_tiles):
                tile_offsets[camera * num_tiles + tile] = total
                for task in range(camera * num_chunks, (camera + 1) * num_chunks):
                    held = places[task, tile]
                    places[task, tile] = total
                    total += held
        tile_offsets[num_cameras * num_tiles] = total
        pair_splats, pair_slots = np.empty(total, np.int32), np.empty(total, np.int32)
        for task in prange(num_cameras * num_chunks):
            camera, chunk = task // num_chunks, task % num_chunks
            begin = starts[camera] + chunk * chunk_size
            place = places[task]
            for i in range(begin, min(begin + chunk_size, starts[camera + 1])):
                s = order[i]
                for slot in range(splat_offsets[s], splat_offsets[s + 1]):
                    pair = place[tiles[slot]]
                    place[tiles[slot]] = pair + 1
                    pair_splats[pair] = s
                    pair_slots[slot] = pair
        return pair_splats, tile_offsets, pair_slots

    return pairs_of
