"""Binning on the CPU: finds the tiles of each splat, sorts splats by depth, and joins both to one list per tile.

Work is split into chunks that depend only on the data. Prefix sums give the output position of each chunk, so results
are the same for any number of threads.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, even_stride, inlined, kernel
from glassplat.kernels.maths.projection import band, half_height, outline
from glassplat.kernels.records import REAL_OF, TILE, Splats, TileBins, check_pair_count

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
    kept, starts, spans, span_offsets, first_rows, slots, splat_offsets = tile_spans(real)(
        means2d, conics, opacities, radii, mask, num_cameras, width, height
    )
    check_pair_count(int(splat_offsets[-1]))
    order = depth_order(key)(depths.view(key), kept, starts)
    pair_splats, tile_offsets, pair_slots = tile_pairs()(
        order, kept, starts, spans, span_offsets, first_rows, slots, mask, per_camera, rows, columns
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


@inlined
def pixel_range(low, high, size):
    """First and last pixel whose centre lies in [low, high], clipped to an image of the given size."""
    # Clamped before the conversion, so that infinities are well defined.
    first = np.int64(math.ceil(min(max(low - 0.5, 0.0), float(size))))
    last = np.int64(math.floor(min(max(high - 0.5, -1.0), float(size - 1))))
    return first, last


@inlined
def rows_of(means2d, conics, opacities, radii, s, height):
    """First and last row of pixels that a splat covers (last < first if none), and its half height."""
    if not (radii[s, 0] > 0 and abs(means2d[s, 0]) + abs(means2d[s, 1]) < np.inf):
        return 0, -1, -1.0
    y = np.float64(means2d[s, 1])
    reach = half_height(conics[s, 0], conics[s, 1], conics[s, 2], opacities[s])
    if not reach >= 0.0:
        return 0, -1, -1.0
    first, last = pixel_range(y - reach, y + reach, height)
    return first, last, reach


@inlined
def shape_of(means2d, conics, s, rows):
    """Shape of a splat for `columns_of`."""
    x, y = np.float64(means2d[s, 0]), np.float64(means2d[s, 1])
    return x, y, rows[0], rows[1], outline(conics[s, 0], conics[s, 1], conics[s, 2], rows[2])


@inlined
def columns_of(shape, row, width):
    """First and last tile that a splat touches in a row of tiles; last < first if none."""
    x, y, first, last, ellipse = shape
    low, high = max(first, row * TILE) + 0.5 - y, min(last, row * TILE + TILE - 1) + 0.5 - y
    left, right = band(ellipse, low, high)
    first_pixel, last_pixel = pixel_range(x + left, x + right, width)
    if first_pixel > last_pixel:
        return 0, -1
    return first_pixel // TILE, last_pixel // TILE


@inlined
def active_between(active_tiles, camera, row, left, right):
    """Number of active tiles between two columns, inclusive."""
    found = right - left + 1
    if active_tiles.size > 0:
        for column in range(left, right + 1):
            if not active_tiles[camera, row, column]:
                found -= 1
    return found


@cache
def tile_spans(real: type) -> Kernel:
    """Finds the visible splats, and the tile columns that each of them touches, row by row.

    Most splats of a scene lie outside the view; later passes process only the V visible ones, stored contiguously.

    Returns:
        kept [V]: splats that cover a row of pixels, in their order.
        starts [C + 1]: start of each camera in `kept`.
        spans [R, 2]: first and last tile column of each row; last < first if the row is not touched.
        span_offsets [V + 1]: start of each visible splat's rows in `spans`.
        first_rows [V]: tile row of the first span of each.
        slots [V + 1]: number of active tiles of all earlier visible splats.
        splat_offsets [S + 1]: the same for every splat, visible or not.
    """

    @kernel("tile_spans", real)
    def spans_of(means2d, conics, opacities, radii, active_tiles, num_cameras, width, height):
        num_splats = opacities.size
        per_camera = num_splats // max(1, num_cameras)
        num_chunks = (num_splats + SPAN_CHUNK - 1) // SPAN_CHUNK
        # A chunk stores its results starting at its first splat, until the counts of all earlier chunks are known.
        found, heights = np.empty(num_splats, np.int32), np.empty(num_splats)
        rows = np.empty((num_splats, 2), np.int32)
        counts, row_counts = np.zeros(num_chunks + 1, np.int64), np.zeros(num_chunks + 1, np.int64)
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            at, touched = chunk * SPAN_CHUNK, 0
            for s in range(chunk * SPAN_CHUNK, min(num_splats, (chunk + 1) * SPAN_CHUNK)):
                first, last, reach = rows_of(means2d, conics, opacities, radii, s, height)
                if first <= last:
                    found[at], heights[at], rows[at, 0], rows[at, 1] = s, reach, first, last
                    touched += last // TILE - first // TILE + 1
                    at += 1
            counts[chunk + 1], row_counts[chunk + 1] = at - chunk * SPAN_CHUNK, touched
        for chunk in range(num_chunks):
            counts[chunk + 1] += counts[chunk]
            row_counts[chunk + 1] += row_counts[chunk]
        num_kept = counts[num_chunks]
        kept, first_rows = np.empty(num_kept, np.int32), np.empty(num_kept, np.int32)
        span_offsets, slots = np.zeros(num_kept + 1, np.int64), np.zeros(num_kept + 1, np.int64)
        spans = np.empty((row_counts[num_chunks], 2), np.int32)
        slot_counts = np.zeros(num_chunks + 1, np.int64)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            i, total = row_counts[chunk], 0
            for v in range(counts[chunk], counts[chunk + 1]):
                source = chunk * SPAN_CHUNK + v - counts[chunk]
                s, first, last = found[source], rows[source, 0], rows[source, 1]
                kept[v], first_rows[v] = s, first // TILE
                shape = shape_of(means2d, conics, s, (first, last, heights[source]))
                for row in range(first // TILE, last // TILE + 1):
                    left, right = columns_of(shape, row, width)
                    spans[i, 0], spans[i, 1] = left, right
                    total += active_between(active_tiles, s // per_camera, row, left, right)
                    i += 1
                span_offsets[v + 1], slots[v + 1] = i, total
            slot_counts[chunk + 1] = total
        for chunk in range(num_chunks):
            slot_counts[chunk + 1] += slot_counts[chunk]
        splat_offsets = np.empty(num_splats + 1, np.int64)
        splat_offsets[num_splats] = slot_counts[num_chunks]
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            v, slot = counts[chunk], slot_counts[chunk]
            for s in range(chunk * SPAN_CHUNK, min(num_splats, (chunk + 1) * SPAN_CHUNK)):
                splat_offsets[s] = slot
                if v < counts[chunk + 1] and kept[v] == s:
                    slots[v + 1] += slot_counts[chunk]
                    slot = slots[v + 1]
                    v += 1
        starts = np.searchsorted(kept, np.arange(num_cameras + 1) * per_camera)
        return kept, starts, spans, span_offsets, first_rows, slots, splat_offsets

    return spans_of


@cache
def depth_order(key: type) -> Kernel:
    """Sorts the kept splats of each camera by depth, nearest first, equal depths by index.

    Positive depths sort like their bits as integers of type `key`. This is a radix sort from the lowest digit, with a
    counting sort in each pass.

    Returns:
        order [V]: positions in `kept`, camera by camera.
    """
    num_digits = -(-np.dtype(key).itemsize * 8 // DIGIT_BITS)
    num_values = 1 << DIGIT_BITS
    digit_mask = key(num_values - 1)
    digit_bits = key(DIGIT_BITS)

    @kernel("depth_order", key)
    def order_of(keys, kept, starts):
        num_cameras, longest = starts.size - 1, 0
        for camera in range(num_cameras):
            longest = max(longest, starts[camera + 1] - starts[camera])
        chunk_size = max(SORT_CHUNK, (longest + SORT_CHUNKS - 1) // SORT_CHUNKS)
        num_chunks = (longest + chunk_size - 1) // chunk_size
        places = np.empty((num_cameras * num_chunks, num_values), np.int64)
        sorted_keys, sorted_places = np.empty((2, kept.size), key), np.empty((2, kept.size), np.int32)
        for digit in range(num_digits):
            shift = key(digit) * digit_bits
            source_keys, source_places = sorted_keys[digit & 1], sorted_places[digit & 1]
            target_keys, target_places = sorted_keys[1 - (digit & 1)], sorted_places[1 - (digit & 1)]
            for task in prange(num_cameras * num_chunks):
                camera, chunk = task // num_chunks, task % num_chunks
                begin = starts[camera] + chunk * chunk_size
                place = places[task]
                place[:] = 0
                for i in range(begin, min(begin + chunk_size, starts[camera + 1])):
                    if digit == 0:
                        source_keys[i] = keys[kept[i]]
                        source_places[i] = i
                    place[(source_keys[i] >> shift) & digit_mask] += 1
            for camera in range(num_cameras):
                total = starts[camera]
                for value in range(num_values):
                    for task in range(camera * num_chunks, (camera + 1) * num_chunks):
                        held = places[task, value]
                        places[task, value] = total
                        total += held
            for task in prange(num_cameras * num_chunks):
                camera, chunk = task // num_chunks, task % num_chunks
                begin = starts[camera] + chunk * chunk_size
                place = places[task]
                for i in range(begin, min(begin + chunk_size, starts[camera + 1])):
                    value = (source_keys[i] >> shift) & digit_mask
                    target = place[value]
                    place[value] = target + 1
                    target_keys[target] = source_keys[i]
                    target_places[target] = source_places[i]
        return sorted_places[num_digits & 1]

    return order_of


@cache
def tile_pairs() -> Kernel:
    """Lists the splats of each tile in depth order: a counting sort of all (splat, tile) pairs by tile.

    Returns:
        pair_splats [P], tile_offsets [C * T + 1], pair_slots [P], as in `TileBins`.
    """

    @kernel("tile_pairs", np.int32)
    def pairs_of(
        order, kept, starts, spans, span_offsets, first_rows, slots, active_tiles, per_camera, rows, columns
    ):  # fmt: skip
        num_cameras, num_kept, num_tiles = starts.size - 1, kept.size, rows * columns
        # Lists each splat's tiles contiguously, not as spans: they are read twice below, out of order.
        tiles = np.empty(slots[num_kept], np.int32)
        num_span_chunks = (num_kept + SPAN_CHUNK - 1) // SPAN_CHUNK
        stride = even_stride(num_span_chunks)
        for task in prange(num_span_chunks):
            chunk = task * stride % num_span_chunks
            for v in range(chunk * SPAN_CHUNK, min(num_kept, (chunk + 1) * SPAN_CHUNK)):
                slot = slots[v]
                for i in range(span_offsets[v], span_offsets[v + 1]):
                    row = first_rows[v] + i - span_offsets[v]
                    for column in range(spans[i, 0], spans[i, 1] + 1):
                        if active_tiles.size == 0 or active_tiles[kept[v] // per_camera, row, column]:
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
                v = order[i]
                for slot in range(slots[v], slots[v + 1]):
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
                v = order[i]
                s = kept[v]
                for slot in range(slots[v], slots[v + 1]):
                    pair = place[tiles[slot]]
                    place[tiles[slot]] = pair + 1
                    pair_splats[pair] = s
                    pair_slots[slot] = pair
        return pair_splats, tile_offsets, pair_slots

    return pairs_of
