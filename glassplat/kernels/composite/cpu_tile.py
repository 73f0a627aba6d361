"""Blocks of pixels of a tile, packed splats, and rows of sums that become their gradients.

A tile of 16 x 16 pixels is traversed in *blocks* of 4 x 4, each one vector. A trained splat covers 5 to 40 pixels of a
tile; in blocks that is half as many lanes as in rows, and blocks that it does not reach cost nothing. A *plane* holds
one value for every pixel of a tile, block after block.

The backward pass writes one row of sums per (tile, splat) pair; the gradients of each splat are summed from its rows in
a fixed order.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, even_stride, inlined, kernel
from glassplat.kernels.backend.cpu_vector import (
    absolute,
    bits_of,
    constant,
    exp,
    fraction,
    item,
    lowest_bit,
    maximum,
    minimum,
    store,
    sums_of,
    times_power_of_2,
    vector_kind,
)
from glassplat.kernels.maths.blending import ALPHA_MIN, EXP2_COEFFICIENTS, Scalar, build_screen_form
from glassplat.kernels.records import REAL_OF, TILE, Splats, TileBins

PIXELS = TILE * TILE
BLOCK = 4
"""Edge of a block in pixels."""
LANES = BLOCK * BLOCK
full, load = vector_kind(LANES)
BLOCKS = PIXELS // LANES
ACROSS = TILE // BLOCK
"""Blocks in a row of a tile."""

# Planes of a tile's state, which the backward pass starts from. LAST and LAST_GLASS hold the position in the tile's
# list of the last splat that the pixel evaluated before it stopped. During the forward pass, T and T_GLASS are negative
# in stopped pixels.
T, LAST, T_GLASS, LAST_GLASS, STATE = 0, PIXELS, 2 * PIXELS, 3 * PIXELS, 4 * PIXELS

GROUP = 4
"""Channels are blended four at a time."""

STOP_AFTER = 8
"""Splats after which a block checks whether all of its pixels have stopped."""

TILES = 4
"""Tiles per task, which allocates memory once for all of them."""

CHUNK = 128
"""Pairs that a tile fetches at once, from scattered memory."""

# Columns of a packed splat. It falls off as 2^(BITS + quadratic form of the offset); along a line of constant x, the
# form is largest at SLOPE_Y times the offset in x.
MEAN_X, MEAN_Y, FORM_XX, FORM_XY, FORM_YY, BITS, SLOPE_X, SLOPE_Y, VALUES = range(9)
ORDER = SLOPE_X
"""Column reused, once a fetched splat's blocks are known, for its position in the tile's list."""

SLACK = 0.02
"""Tolerance for rounding of the logarithm of a coverage, when a block is culled."""

GLASS = BLOCKS
"""Bit of a pair's flags that marks glass; the lower bits mark the blocks that it reaches."""


def row_width(first: int, num_values: int) -> int:
    """Columns of a row with `num_values` values from column `first` on, rounded up to whole groups and vectors."""
    return LANES * -(-(first + GROUP * -(-num_values // GROUP)) // LANES)


def joined_cameras(tensors: Iterable[Tensor]) -> tuple[Tensor, ...]:
    """Tensors [C, G, ...] as [C * G, ...]."""
    return tuple(tensor.flatten(0, 1) for tensor in tensors)


def flat(tensor: Tensor) -> Tensor:
    """A tensor with one dimension, contiguous."""
    return tensor.contiguous().view(-1)


def pixel_centers(real: type) -> tuple[Scalar, Scalar]:
    """Functions that return the pixel centres of a tile's first block, x and y."""
    xs = constant(real, tuple(i % BLOCK + 0.5 for i in range(LANES)))
    ys = constant(real, tuple(i // BLOCK + 0.5 for i in range(LANES)))
    return xs, ys


def begin_state(real: type) -> Scalar:
    """Builds the function that initialises the state of a tile."""
    zero, one, never = real(0.0), real(1.0), real(-1.0)

    @inlined
    def begin(state, at, columns, rows):
        """Sets transmittances to one, and to zero (stopped) outside the image; returns bits of running blocks."""
        running = np.int64(0)
        for b in range(BLOCKS):
            x, y, i = b % ACROSS * BLOCK, b // ACROSS * BLOCK, at + b * LANES
            running |= np.int64(x < columns and y < rows) << b
            store(state, i + T, full(one))
            store(state, i + T_GLASS, full(one))
            store(state, i + LAST, full(never))
            store(state, i + LAST_GLASS, full(never))
            if x + BLOCK > columns or y + BLOCK > rows:
                for lane in range(LANES):
                    if x + lane % BLOCK >= columns or y + lane // BLOCK >= rows:
                        state[i + T + lane] = zero
        return running

    return begin


@inlined
def finish_state(state, at):
    """Removes the signs that mark stopped pixels, after the last splat of a tile."""
    for i in range(0, PIXELS, LANES):
        store(state, at + T + i, absolute(load(state, at + T + i)))
        store(state, at + T_GLASS + i, absolute(load(state, at + T_GLASS + i)))


def pack_of(real: type) -> Scalar:
    """Builds the step that copies one splat's geometry to its packed row."""
    screen_form = build_screen_form(real)
    half, zero, nothing, endless = real(0.5), real(0.0), real(-np.inf), real(np.inf)
    alpha_min, bits = real(ALPHA_MIN), 1.0 / math.log(2.0)

    @inlined
    def pack(packed, at, mean, conic, opacity):
        xx, xy, yy = screen_form(conic[0], conic[1], conic[2])
        packed[at + MEAN_X], packed[at + MEAN_Y] = mean[0], mean[1]
        packed[at + FORM_XX], packed[at + FORM_XY], packed[at + FORM_YY] = xx, xy, yy
        packed[at + SLOPE_X], packed[at + SLOPE_Y] = -half * xy / xx, -half * xy / yy
        # In double precision, because the determinant of a needle's conic is a small difference of large products.
        determinant = np.float64(conic[0]) * np.float64(conic[2]) - np.float64(conic[1]) * np.float64(conic[1])
        # Written so that NaN anywhere ends in "reaches nothing".
        drawn = 0.0 < determinant < np.inf and conic[0] > zero and alpha_min < opacity < endless
        packed[at + BITS] = real(bits * math.log(np.float64(opacity))) if drawn else nothing

    return pack


@inlined
def tile_bounds(tile, width, height):
    """Camera, first column, first row, columns and rows of a tile."""
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    camera, rest = tile // (tiles_x * tiles_y), tile % (tiles_x * tiles_y)
    x0, y0 = (rest % tiles_x) * TILE, (rest // tiles_x) * TILE
    return camera, x0, y0, min(TILE, width - x0), min(TILE, height - y0)


@inlined
def fetch(batch, packed, pair_splats, first, last, width, x0, y0):
    """Copies packed splats of consecutive pairs to a batch, with means relative to the tile."""
    for p in range(first, last):
        source, target = pair_splats[p] * np.int64(width), (p - first) * width
        for column in range(0, width, LANES):
            store(batch, target + column, load(packed, source + column))
    for k in range(last - first):
        batch[k * width + MEAN_X] -= np.float32(x0)
        batch[k * width + MEAN_Y] -= np.float32(y0)


def reached_of(real: type) -> Scalar:
    """Builds the step that returns the blocks of a tile that a fetched splat reaches, as bits."""
    lefts = constant(real, tuple(b % ACROSS * BLOCK + 0.5 for b in range(BLOCKS)))
    tops = constant(real, tuple(b // ACROSS * BLOCK + 0.5 for b in range(BLOCKS)))
    zero, last, least = real(0.0), real(BLOCK - 1), real(math.log2(ALPHA_MIN) - SLACK)

    @inlined
    def reached(batch, at):
        left, top = lefts() - item(batch, at + MEAN_X), tops() - item(batch, at + MEAN_Y)
        right, bottom, nowhere = left + last, top + last, full(zero)
        # The largest coverage within a block is at the centre or on one of the two edges nearest to it.
        near_x = maximum(left, minimum(right, nowhere))
        near_y = maximum(top, minimum(bottom, nowhere))
        far_x = maximum(left, minimum(right, near_y * item(batch, at + SLOPE_X)))
        far_y = maximum(top, minimum(bottom, near_x * item(batch, at + SLOPE_Y)))
        most = maximum(exponent(batch, at, near_x, far_y), exponent(batch, at, far_x, near_y))
        return bits_of(most >= least)

    return reached


@inlined
def lane_of(x, y):
    """Index in a plane of the pixel in column x and row y of the tile."""
    return (y // BLOCK * ACROSS + x // BLOCK) * LANES + y % BLOCK * BLOCK + x % BLOCK


@inlined
def list_plain_block(entries, pairs, first, last, block):
    """As `list_block`, if none of the fetched splats is glass."""
    count = 0
    for p in range(first, last):
        entries[count] = np.int32(p - first)
        count += (item(pairs, p) >> block) & 1
    return count


@inlined
def list_block(entries, pairs, first, last, block):
    """Lists the fetched splats that reach a block, glass as the complement of its index; returns their number."""
    count = 0
    for p in range(first, last):
        k, pair = np.int32(p - first), item(pairs, p)
        entries[count] = k ^ -((pair >> GLASS) & 1)
        count += (pair >> block) & 1
    return count


@inlined
def exponent(batch, at, dx, dy):
    """Base-2 logarithm of a fetched splat's coverage at offsets from its mean."""
    along = dx * item(batch, at + FORM_XX) + dy * item(batch, at + FORM_XY)
    return along * dx + (dy * item(batch, at + FORM_YY) * dy + item(batch, at + BITS))


def exp2_of(real: type) -> Scalar:
    """Builds the step that evaluates 2^t of a vector for -100 < t < 1; undefined elsewhere."""
    c0, c1, c2, c3, c4, c5 = (real(c) for c in EXP2_COEFFICIENTS)
    natural = real(math.log(2.0))

    @inlined
    def fast_exp2(t):
        f = fraction(t)
        return times_power_of_2(((((f * c5 + c4) * f + c3) * f + c2) * f + c1) * f + c0, t)

    @inlined
    def exact_exp2(t):
        return exp(t * natural)

    return fast_exp2 if real is np.float32 else exact_exp2


SPLATS = 512
"""Splats per task."""

# Columns of a pair's row, sums over its pixels: of g = v_alpha alpha, and of g times powers of the offset from the
# mean; for `absgrad`, of |g times the derivative of the base-2 exponent|; and the gradients of its values.
G, G_X, G_Y, G_XX, G_XY, G_YY, ABSGRAD_X, ABSGRAD_Y, PAIR_VALUES = range(9)


def sum_channels_of(real: type, image: int, weight: int, values: int) -> Scalar:
    """Builds the step that sums gradients of channels, given the planes of gradients and weights, and a column."""
    zero = real(0.0)

    @inlined
    def sum_channels(planes, blocks, group, groups, rows, row, sums):
        """Fills a pair's sums, starting at a group of channels; `sums` is scratch."""
        none = full(zero)
        for d in range(group * GROUP, groups * GROUP, GROUP):
            s0, s1, s2, s3, left = none, none, none, none, blocks
            while left != 0:
                i = lowest_bit(left) * LANES
                left &= left - 1
                v, shown = image + d * PIXELS + i, load(planes, weight + i)
                s0, s1 = s0 + shown * load(planes, v), s1 + shown * load(planes, v + PIXELS)
                s2, s3 = s2 + shown * load(planes, v + 2 * PIXELS), s3 + shown * load(planes, v + 3 * PIXELS)
            four = (s0, s1, s2, s3, none, none, none, none, none, none, none, none, none, none, none, none)
            store(sums, 0, sums_of(four))
            for i in range(4):
                rows[row + values + d + i] = sums[i]

    return sum_channels


def new_pair_rows(bins: TileBins, width: int, dtype: torch.dtype) -> Tensor:
    """Flat buffer for one row per pair, with a width from `row_width`.

    A kernel fills the rows of active tiles. The buffer is zeroed only if other tiles have pairs. Columns that pad a
    row stay undefined, and so do their sums, which nothing reads.
    """
    active, pairs = bins.active.long(), len(bins.pair_splats)
    filled = len(active) == len(bins.tile_offsets) - 1 or pairs == int(
        (bins.tile_offsets[active + 1] - bins.tile_offsets[active]).sum()
    )
    # PyTorch aligns it to cache lines, and a row fills one.
    return (torch.empty if filled else torch.zeros)(pairs * width, dtype=dtype)


def sum_pair_rows(
    rows: Tensor, bins: TileBins, splats: Splats, num_values: int, with_absgrad: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Sums over tiles: gradients of means2d, conics, opacities, values [C, G, num_values], absgrad [C, G, 2 or 0]."""
    absgrad_width = 2 if with_absgrad else 0
    shape = tuple(splats.opacities.shape)
    widths = ((2,), (3,), (), (num_values,), (absgrad_width,))
    found = [splats.opacities.new_empty(*shape, *w) for w in widths]
    _sum_rows(REAL_OF[splats.means2d.dtype])(
        rows, bins.pair_slots, bins.splat_offsets, *joined_cameras((splats.conics, splats.opacities, *found))
    )
    v_means, v_conics, v_opacities, v_values, v_absgrad = found
    return v_means, v_conics, v_opacities, v_values, v_absgrad


@functools.cache
def _sum_rows(real: type) -> Kernel:
    zero, half, nats = real(0.0), real(0.5), real(math.log(2.0))

    @kernel("sum_pair_rows", real)
    def sum_rows(rows, slots, offsets, conics, opacities, v_means, v_conics, v_opacities, v_values, v_absgrad):
        count, width = offsets.size - 1, rows.size // max(1, slots.size)
        num_chunks = (count + SPLATS - 1) // SPLATS
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            begin, end = chunk * SPLATS, min(count, (chunk + 1) * SPLATS)
            v_means[begin:end], v_conics[begin:end], v_opacities[begin:end] = zero, zero, zero
            v_values[begin:end], v_absgrad[begin:end] = zero, zero
            total = np.empty(width, real)
            for s in range(begin, end):
                first, last = offsets[s], offsets[s + 1]
                if first == last:
                    continue
                for column in range(0, width, LANES):
                    part = full(zero)
                    for k in range(first, last):
                        part = part + load(rows, item(slots, k) * np.int64(width) + column)
                    store(total, column, part)
                for d in range(v_values.shape[1]):
                    v_values[s, d] = total[PAIR_VALUES + d]
                # alpha = opacity exp(-q / 2), q = xx dx^2 + 2 xy dx dy + yy dy^2. Gradients of invisible splats stay
                # zero, even if their geometry is not finite.
                if total[G_XX] != zero or total[G] != zero:
                    xx, xy, yy = conics[s, 0], conics[s, 1], conics[s, 2]
                    v_means[s, 0] = xx * total[G_X] + xy * total[G_Y]
                    v_means[s, 1] = xy * total[G_X] + yy * total[G_Y]
                    v_conics[s, 0] = -half * total[G_XX]
                    v_conics[s, 1] = -total[G_XY]
                    v_conics[s, 2] = -half * total[G_YY]
                    v_opacities[s] = total[G] / opacities[s]
                for d in range(v_absgrad.shape[1]):
                    v_absgrad[s, d] = nats * total[ABSGRAD_X + d]

    return sum_rows
