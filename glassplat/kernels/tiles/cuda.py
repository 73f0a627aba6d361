"""Binning on the GPU. Three passes over the splats count their tiles, order the counts and list their rows of tiles;
two more process the pairs; torch scans and sorts. Kernels are few, because a launch takes longer than a small one.

Splats are sorted by depth first. Their pairs are written in that order, so that one stable sort of the pairs by tile,
an integer of 16 bits up to 32,767 tiles of all cameras, leaves each tile's splats nearest first. Each pair has a
thread, which finds its splat by binary search in the prefix sums, then its row in those of the splat. So no thread has
to process a splat that covers the whole image. Only the passes over the splats use float64, which is 32 or 64 times
slower on most GPUs.
"""

from __future__ import annotations

from functools import cache, lru_cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import Kernel, kernel
from glassplat.kernels.records import REAL_OF, TILE, Splats, TileBins, check_pair_count
from glassplat.kernels.tiles.cpu import active_between, columns_of, rows_of, shape_of


def bin_tiles(splats: Splats, width: int, height: int, active_tiles: Tensor | None) -> TileBins:
    """As `glassplat.kernels.tiles.cpu.bin_tiles`; synchronises once, to read the number of pairs."""
    num_cameras, per_camera = splats.depths.shape
    count, device, real = num_cameras * per_camera, splats.depths.device, REAL_OF[splats.depths.dtype]
    rows, columns = -(-height // TILE), -(-width // TILE)
    num_tiles = num_cameras * rows * columns
    shapes = (splats.means2d.view(count, 2), splats.conics.view(count, 3), splats.opacities.view(count))
    seen = (*shapes, splats.radii.view(count, 2), active_tiles, per_camera, width, height)
    # One prefix sum over sections of equal length: the pairs of each splat, its rows of tiles, flags of active tiles if
    # not all are, and the pairs again in depth order. Totals are read at the ends of sections.
    masked = active_tiles is not None and num_tiles > 0
    length = max(count, num_tiles if masked else 1)
    by_depth = (3 if masked else 2) * length
    sums = torch.empty(by_depth + count + 1, dtype=torch.int64, device=device)
    count_tiles(real).over(length, *seen, length, sums)
    order = torch.argsort(splats.depths, dim=1, stable=True).flatten()
    order_counts().over(count, per_camera, by_depth, order, sums)
    sums.cumsum_(0)
    # The only synchronisation with the GPU.
    num_pairs, *totals = sums[length : by_depth + 1 : length].tolist()
    check_pair_count(num_pairs)
    spans = torch.empty(totals[0] - num_pairs, 3, dtype=torch.int32, device=device)
    active = torch.empty(totals[1] - totals[0], dtype=torch.int32, device=device) if masked else None
    list_spans(real).over(length, *seen, length, sums, spans, active)
    key, dtype = (np.int16, torch.int16) if num_tiles < np.iinfo(np.int16).max else (np.int32, torch.int32)
    tiles = torch.empty(num_pairs, dtype=dtype, device=device)
    members, slots = torch.empty(2, num_pairs, dtype=torch.int32, device=device)
    sizes = (per_camera, rows, columns, num_tiles, length, by_depth)
    emit_tiles(key).over(num_pairs, active_tiles, *sizes, order, sums, spans, tiles, members, slots)
    by_tile, order = torch.sort(tiles, stable=True)
    pair_splats, pair_slots = torch.empty(2, num_pairs, dtype=torch.int32, device=device)
    tile_offsets = torch.empty(num_tiles + 1, dtype=torch.int64, device=device)
    outputs = (pair_splats, pair_slots, tile_offsets)
    list_pairs(key).over(max(num_pairs, num_tiles + 1), by_tile, order, members, slots, *outputs)
    if active is None:
        active = _every_tile(num_tiles, device)
    return TileBins(pair_splats, tile_offsets, pair_slots, sums[: count + 1], active, width, height, num_cameras)


@lru_cache(maxsize=64)
@torch.inference_mode(False)
def _every_tile(count: int, device: torch.device) -> Tensor:
    """Indices of all tiles, in a cached tensor that must not be modified."""
    return torch.arange(count, dtype=torch.int32, device=device)


@inlined
def is_active(active_tiles, tile):
    """Return whether a tile is active; tiles are numbered over all cameras."""
    rows, columns = active_tiles.shape[1], active_tiles.shape[2]
    row = tile // columns
    return active_tiles[row // rows, row % rows, tile % columns]


@cache
def count_tiles(real: type) -> Kernel:
    """Writes the summands: for each splat the number of active tiles that it touches and of tile rows that it may
    touch; for each tile whether it is active, if not all are. They are preceded by a zero.
    """

    @kernel("count_tiles", real, "real2 real2 real1 real2 bool3 int int int long long1")
    def count(means2d, conics, opacities, radii, active_tiles, per_camera, width, height, length, sums):
        s = cuda.grid(1)
        if s >= length:
            return
        found, spans = 0, 0
        if s < opacities.size:
            rows = rows_of(means2d, conics, opacities, radii, s, height)
            if rows[0] <= rows[1]:
                shape, first, last = shape_of(means2d, conics, s, rows), rows[0] // TILE, rows[1] // TILE
                spans = last - first + 1
                for row in range(first, last + 1):
                    left, right = columns_of(shape, row, width)
                    found += active_between(active_tiles, s // per_camera, row, left, right)
        sums[1 + s], sums[1 + length + s] = found, spans
        if active_tiles.size > 0:
            sums[1 + 2 * length + s] = 1 if s < active_tiles.size and is_active(active_tiles, s) else 0
        if s == 0:
            sums[0] = 0

    return count


@cache
def order_counts(key: type = np.int64) -> Kernel:
    """Writes the last section: the number of pairs of each splat, camera by camera in depth order."""

    @kernel("order_counts", key, "int long long1 long1")
    def fill(per_camera, by_depth, order, sums):
        i = cuda.grid(1)
        if i < order.size:
            sums[1 + by_depth + i] = sums[1 + i // per_camera * per_camera + order[i]]

    return fill


@cache
def list_spans(real: type) -> Kernel:
    """Lists the tile rows of each splat: the row, its first column, and the splat's pairs up to the end of the row.

    Lists the active tiles too, if not all are.
    """

    @kernel("list_spans", real, "real2 real2 real1 real2 bool3 int int int long long1 int2 int1")
    def fill(means2d, conics, opacities, radii, active_tiles, per_camera, width, height, length, sums, spans, active):
        s = cuda.grid(1)
        if s < active_tiles.size and is_active(active_tiles, s):
            active[sums[2 * length + s] - sums[2 * length]] = s
        if s >= opacities.size or sums[length + s] == sums[length + s + 1]:
            return
        rows = rows_of(means2d, conics, opacities, radii, s, height)
        shape, first, found = shape_of(means2d, conics, s, rows), rows[0] // TILE, 0
        begin = sums[length + s] - sums[length]
        for i in range(begin, sums[length + s + 1] - sums[length]):
            row, left, right = first + i - begin, 0, -1
            # If the passes ever round differently, a row that only the first one found is empty.
            if row * TILE <= rows[1]:
                left, right = columns_of(shape, row, width)
            found += active_between(active_tiles, s // per_camera, row, left, right)
            spans[i, 0], spans[i, 1], spans[i, 2] = row, left, found

    return fill


@inlined
def search(values, begin, end, x):
    """Last position in [begin, end) of ascending values with a value of at most x; `begin` if there is none."""
    low, high = begin, end
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

    @kernel("emit_tiles", key, f"bool3 int int int int long long long1 long1 int2 {keys} int1 int1")
    def emit(
        active_tiles, per_camera, grid_rows, grid_columns, num_tiles, length, by_depth,
        order, sums, spans, tiles, members, slots,
    ):  # fmt: skip
        pair = cuda.grid(1)
        if pair >= tiles.size:
            return
        before = sums[by_depth] + pair
        place = search(sums, by_depth, by_depth + order.size, before)
        left_over, camera = before - sums[place], (place - by_depth) // per_camera
        s = camera * per_camera + order[place - by_depth]
        members[pair], slots[pair] = s, sums[s] + left_over
        begin, end = sums[length + s] - sums[length], sums[length + s + 1] - sums[length]
        low, high = begin, end
        while low < high:
            middle = (low + high) // 2
            if spans[middle, 2] <= left_over:
                low = middle + 1
            else:
                high = middle
        if low == end:
            # If the passes ever round differently, surplus pairs go to an unused tile after the last one.
            tiles[pair] = key(num_tiles)
            return
        if low > begin:
            left_over -= spans[low - 1, 2]
        row, column = spans[low, 0], spans[low, 1] + left_over
        if active_tiles.size > 0:
            column = spans[low, 1]
            while left_over > 0 or not active_tiles[camera, row, column]:
                left_over -= active_tiles[camera, row, column]
                column += 1
        tiles[pair] = key((camera * grid_rows + row) * grid_columns + column)

    return emit


@cache
def list_pairs(key: type = np.int16) -> Kernel:
    """Writes the splats and slots of the pairs, sorted by tile, and the start of each tile's pairs."""
    keys = "short1" if key is np.int16 else "int1"

    @kernel("list_pairs", key, f"{keys} long1 int1 int1 int1 int1 long1")
    def fill(tiles, order, members, slots, pair_splats, pair_slots, tile_offsets):
        i = cuda.grid(1)
        if i < tiles.size:
            pair_splats[i], pair_slots[slots[order[i]]] = members[order[i]], i
        if i < tile_offsets.size:
            tile_offsets[i] = search(tiles, -1, tiles.size, i - 1) + 1

    return fill
