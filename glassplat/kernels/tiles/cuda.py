"""Binning on the GPU: one pass over the splats to count their tiles, one to list their rows of tiles, one over the
pairs; torch scans and sorts.

Splats are sorted by depth first. Their pairs are written in that order, so that one stable sort of the pairs by tile,
an integer of 16 bits for all but very large images, leaves each tile's splats nearest first. Each pair has a thread,
which searches the sums of the counts for its splat, then those of the splat's rows: no thread waits for one that covers
the whole image. Only the passes over the splats compute in float64, which most GPUs do 32 or 64 times slower.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import Kernel, blocks_for, kernel
from glassplat.kernels.records import REAL_OF, TILE, Splats, TileBins, check_pair_count
from glassplat.kernels.tiles.cpu import active_between, columns_of, rows_of, shape_of

THREADS = 128


def bin_tiles(splats: Splats, width: int, height: int, active_tiles: Tensor | None) -> TileBins:
    """As `glassplat.kernels.tiles.cpu.bin_tiles`; waits for the GPU once, to learn the number of pairs."""
    num_cameras, per_camera = splats.depths.shape
    count, device, real = num_cameras * per_camera, splats.depths.device, REAL_OF[splats.depths.dtype]
    num_tiles = num_cameras * -(-height // TILE) * -(-width // TILE)
    shapes = (splats.means2d.view(count, 2), splats.conics.view(count, 3), splats.opacities.view(count))
    radii = splats.radii.view(count, 2)
    counts = torch.empty(2, count, dtype=torch.int32, device=device)
    count_tiles(real)(
        blocks_for(count, THREADS), THREADS, *shapes, radii, active_tiles, per_camera, width, height, counts
    )
    offsets = torch.zeros(2 * count + 1, dtype=torch.int64, device=device)
    # One sum over both rows: torch gives each row of a matrix to a single block of threads.
    torch.cumsum(counts.view(-1), 0, out=offsets[1:])
    splat_offsets, span_offsets = offsets[: count + 1], offsets[count:] - offsets[count]
    active, num_active = _active(active_tiles, num_tiles, device)
    # The one thing that the program asks of the GPU, and waits for.
    num_pairs, num_spans, num_active = torch.stack([splat_offsets[-1], span_offsets[-1], num_active]).tolist()
    check_pair_count(num_pairs)
    spans = torch.empty(num_spans, 3, dtype=torch.int32, device=device)
    list_spans(real)(
        blocks_for(count, THREADS), THREADS, *shapes, radii, active_tiles, per_camera, width, height, span_offsets,
        spans,
    )  # fmt: skip
    narrow = num_tiles < np.iinfo(np.int16).max
    tiles = torch.empty(num_pairs, dtype=torch.int16 if narrow else torch.int32, device=device)
    members, slots = torch.empty(2, num_pairs, dtype=torch.int32, device=device)
    emit_tiles(np.int16 if narrow else np.int32)(
        blocks_for(num_pairs, THREADS), THREADS, active_tiles, per_camera, -(-height // TILE), -(-width // TILE),
        num_tiles, *_sequence(splats.depths, counts[0]), splat_offsets, span_offsets, spans, tiles, members, slots,
    )  # fmt: skip
    by_tile, order = torch.sort(tiles, stable=True)
    edges = torch.arange(num_tiles + 1, dtype=tiles.dtype, device=device)
    pair_slots = torch.empty_like(slots)
    pair_slots[slots[order].long()] = torch.arange(num_pairs, dtype=torch.int32, device=device)
    tile_offsets = torch.searchsorted(by_tile, edges)
    return TileBins(
        members[order], tile_offsets, pair_slots, splat_offsets, active[:num_active], width, height, num_cameras
    )


def _active(active_tiles: Tensor | None, num_tiles: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """The active tiles in order, in the front of a longer list, and how many they are."""
    every = torch.arange(num_tiles, dtype=torch.int32, device=device)
    if active_tiles is None:
        return every, torch.full((), num_tiles, device=device)
    flags = active_tiles.flatten()
    counted = flags.cumsum(0)
    # All that are not active are written to the place behind the last.
    places = torch.where(flags, counted - 1, num_tiles)
    return every.new_empty(num_tiles + 1).scatter_(0, places, every), flags.sum()


def _sequence(depths: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """The splats [S] in the order of their depths, camera by camera, and how many pairs those before each have."""
    num_cameras, per_camera = depths.shape
    first = torch.arange(num_cameras, device=depths.device)[:, None] * per_camera
    order = (torch.argsort(depths, dim=1, stable=True) + first).flatten()
    in_order = counts[order].long()
    return order, in_order.cumsum(0) - in_order


@cache
def count_tiles(real: type) -> Kernel:
    """Counts the active tiles that each splat touches, and the rows of tiles that it may touch any in [2, S]."""

    @kernel("count_tiles", real, "real2 real2 real1 real2 bool3 int int int int2")
    def count(means2d, conics, opacities, radii, active_tiles, per_camera, width, height, counts):
        s = cuda.grid(1)
        if s >= opacities.size:
            return
        found, spans = 0, 0
        rows = rows_of(means2d, conics, opacities, radii, s, height)
        if rows[0] <= rows[1]:
            shape, first, last = shape_of(means2d, conics, s, rows), rows[0] // TILE, rows[1] // TILE
            spans = last - first + 1
            for row in range(first, last + 1):
                left, right = columns_of(shape, row, width)
                found += active_between(active_tiles, s // per_camera, row, left, right)
        counts[0, s], counts[1, s] = found, spans

    return count


@cache
def list_spans(real: type) -> Kernel:
    """Lists the rows of tiles of each splat: the row, its first column, and the pairs of the splat up to its end."""

    @kernel("list_spans", real, "real2 real2 real1 real2 bool3 int int int long1 int2")
    def fill(means2d, conics, opacities, radii, active_tiles, per_camera, width, height, span_offsets, spans):
        s = cuda.grid(1)
        if s >= opacities.size or span_offsets[s] == span_offsets[s + 1]:
            return
        rows = rows_of(means2d, conics, opacities, radii, s, height)
        shape, first, found = shape_of(means2d, conics, s, rows), rows[0] // TILE, 0
        for i in range(span_offsets[s], span_offsets[s + 1]):
            row, left, right = first + i - span_offsets[s], 0, -1
            # Should the passes ever round differently, a row that only the first one saw is empty.
            if row * TILE <= rows[1]:
                left, right = columns_of(shape, row, width)
            found += active_between(active_tiles, s // per_camera, row, left, right)
            spans[i, 0], spans[i, 1], spans[i, 2] = row, left, found

    return fill


@inlined
def search(values, x):
    """The last of ascending values that is at most x; the first is."""
    low, high = 0, values.size
    while high - low > 1:
        middle = (low + high) // 2
        if values[middle] <= x:
            low = middle
        else:
            high = middle
    return low


@cache
def emit_tiles(key: type = np.int16) -> Kernel:
    """Writes the tile, the splat and the slot of every pair."""
    keys = "short1" if key is np.int16 else "int1"

    @kernel("emit_tiles", key, f"bool3 int int int int long1 long1 long1 long1 int2 {keys} int1 int1")
    def emit(
        active_tiles, per_camera, grid_rows, grid_columns, num_tiles,
        order, starts, splat_offsets, span_offsets, spans, tiles, members, slots,
    ):  # fmt: skip
        pair = cuda.grid(1)
        if pair >= tiles.size:
            return
        place = search(starts, pair)
        s, left_over = order[place], pair - starts[place]
        members[pair], slots[pair] = s, splat_offsets[s] + left_over
        low, high = span_offsets[s], span_offsets[s + 1]
        while low < high:
            middle = (low + high) // 2
            if spans[middle, 2] <= left_over:
                low = middle + 1
            else:
                high = middle
        if low == span_offsets[s + 1]:
            # Should the passes ever round differently, what is left over goes behind the last tile, where none looks.
            tiles[pair] = key(num_tiles)
            return
        if low > span_offsets[s]:
            left_over -= spans[low - 1, 2]
        camera, row, column = s // per_camera, spans[low, 0], spans[low, 1] + left_over
        if active_tiles.size > 0:
            column = spans[low, 1]
            while left_over > 0 or not active_tiles[camera, row, column]:
                left_over -= active_tiles[camera, row, column]
                column += 1
        tiles[pair] = key((camera * grid_rows + row) * grid_columns + column)

    return emit
