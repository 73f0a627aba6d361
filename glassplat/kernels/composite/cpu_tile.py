"""What the blending kernels share: a tile's scratch memory, the packed splats, and sums of gradients.

A tile keeps one value per pixel in a *plane* of 16 x 16, and all planes in one flat buffer at offsets known to the
compiler. That is what lets it see that planes never overlap, and turn every loop over the 16 pixels of a row into
vector instructions without checks. For the same reason rows and channels enter offsets through `row & 15` and
`channel & 31`: the compiler then knows that they are not negative.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.maths.blending import Scalar, blend_maths
from glassplat.kernels.splats import TILE, Splats

PIXELS = TILE * TILE
PLANE = PIXELS + TILE
"""Floats from one plane to the next; the extra row keeps planes from competing for the same cache sets."""

# Planes that forward and backward share. T and T_GLASS are negative where the pixel has stopped; LAST and LAST_GLASS
# hold the position in the tile's list of the last splat that the pixel looked at before it stopped.
# COVERAGE holds opacity times falloff of the current splat, in the rows that it reaches.
T, LAST, T_GLASS, LAST_GLASS, COVERAGE = 0, PLANE, 2 * PLANE, 3 * PLANE, 4 * PLANE
STATE_PLANES, SHARED_PLANES = 4, 5

GROUP = 4
"""Channels are blended four at a time."""

BATCH = 16
"""Splats that a tile fetches at once. They lie anywhere in memory: fetched one at a time, each would be waited for."""

# Columns of a packed splat.
MEAN_X, MEAN_Y, FORM_XX, FORM_XY, FORM_YY, OPACITY, REACH, VALUES = 0, 1, 2, 3, 4, 5, 6, 8

# Columns of the gradient of one (tile, splat) pair.
V_MEAN, V_CONIC, V_OPACITY, V_VALUES = 0, 2, 5, 6


class TileFunctions(NamedTuple):
    """Compiled steps that every blending kernel takes.

    Attributes:
        pack: copies one splat's geometry into its packed row.
        place: camera, first column, first row, columns and rows of a tile.
        begin: fresh transmittances; pixels beyond the image's edge start as stopped.
        is_finished: whether every pixel has stopped, for all splats and for glass.
        save_state, load_state: the planes that the backward pass starts from.
        fetch: copies the packed splats of consecutive pairs next to each other.
        cover: fills COVERAGE; first and one-past-last row that the splat reaches. A loop of its own, because the
            processor overlaps more rows of a short computation than of a long one.
        geometry_gradient: gradient of one pair's mean, conic and opacity from three rows of lane sums.
    """

    pack: Scalar
    place: Scalar
    begin: Scalar
    is_finished: Scalar
    save_state: Scalar
    load_state: Scalar
    fetch: Scalar
    cover: Scalar
    geometry_gradient: Scalar


def tile_functions(real: type) -> TileFunctions:
    """Builds the functions for `real`, np.float32 or np.float64."""
    return TileFunctions(
        _pack(real),
        _place(),
        _begin(real),
        _is_finished(real),
        _save_state(),
        _load_state(),
        _fetch(),
        _cover(real),
        _geometry_gradient(real),
    )


def packed_width(num_values: int) -> int:
    """Columns of a packed splat that carries `num_values` channels, filled up to whole groups."""
    return VALUES + GROUP * ((num_values + GROUP - 1) // GROUP)


def real_of(splats: Splats) -> type:
    """The NumPy type that a kernel for these splats is built with."""
    return np.float64 if splats.means2d.dtype == torch.float64 else np.float32


def _pack(real: type) -> Scalar:
    maths = blend_maths(real)
    screen_form, vertical_reach = maths.screen_form, maths.vertical_reach

    @inlined
    def pack(packed, s, means, conics, opacities):
        xx, xy, yy = conics[s, 0], conics[s, 1], conics[s, 2]
        packed[s, MEAN_X], packed[s, MEAN_Y] = means[s, 0], means[s, 1]
        packed[s, FORM_XX], packed[s, FORM_XY], packed[s, FORM_YY] = screen_form(xx, xy, yy)
        packed[s, OPACITY] = opacities[s]
        packed[s, REACH] = vertical_reach(xx, xy, yy, opacities[s])

    return pack


def _place() -> Scalar:
    @inlined
    def place(tile, width, height):
        tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
        camera, rest = tile // (tiles_x * tiles_y), tile % (tiles_x * tiles_y)
        x0, y0 = (rest % tiles_x) * TILE, (rest // tiles_x) * TILE
        return camera, x0, y0, min(TILE, width - x0), min(TILE, height - y0)

    return place


def _begin(real: type) -> Scalar:
    zero, one, never = real(0.0), real(1.0), real(-1.0)

    @inlined
    def begin(scratch, columns, rows):
        for i in range(PIXELS):
            inside = i % TILE < columns and i // TILE < rows
            scratch[T + i] = one if inside else zero
            scratch[T_GLASS + i] = one
            scratch[LAST + i] = never
            scratch[LAST_GLASS + i] = never

    return begin


def _is_finished(real: type) -> Scalar:
    zero = real(0.0)

    @inlined
    def is_finished(scratch):
        left, left_for_glass = zero, zero
        for i in range(PIXELS):
            t, t_glass = scratch[T + i], scratch[T_GLASS + i]
            t = t if t > zero else zero
            left += t
            left_for_glass += t if t_glass > zero else zero
        return left == zero, left_for_glass == zero

    return is_finished


def _save_state() -> Scalar:
    @inlined
    def save_state(state, n, scratch):
        for plane in range(STATE_PLANES):
            for i in range(PIXELS):
                state[n, plane, i] = abs(scratch[plane * PLANE + i]) if plane % 2 == 0 else scratch[plane * PLANE + i]

    return save_state


def _load_state() -> Scalar:
    @inlined
    def load_state(state, n, scratch):
        """Returns how many pairs of the tile any pixel has looked at."""
        most = state[n, 1, 0]
        for plane in range(STATE_PLANES):
            for i in range(PIXELS):
                value = state[n, plane, i]
                scratch[plane * PLANE + i] = value
                if plane % 2 == 1:
                    most = max(most, value)
        return int(most) + 1

    return load_state


def _fetch() -> Scalar:
    @inlined
    def fetch(batch, packed, pair_splats, first, last):
        for p in range(first, last):
            row, to = packed[pair_splats[p]], batch[p - first]
            for column in range(row.size):
                to[column] = row[column]

    return fetch


def _cover(real: type) -> Scalar:
    maths = blend_maths(real)
    exp2, row_range = maths.exp2, maths.row_range
    half = real(0.5)

    @inlined
    def cover(scratch, splat, x0, y0, num_rows):
        mean_x, mean_y = splat[MEAN_X] - real(x0), splat[MEAN_Y] - real(y0)
        xx, xy, yy, opacity = splat[FORM_XX], splat[FORM_XY], splat[FORM_YY], splat[OPACITY]
        first, last = row_range(mean_y, splat[REACH], num_rows)
        for row in range(first, last):
            base = COVERAGE + (row & 15) * TILE
            dy = real(row) + half - mean_y
            linear, constant = xy * dy, yy * dy * dy
            for i in range(TILE):
                dx = real(np.int32(i)) + half - mean_x
                scratch[base + i] = opacity * exp2((xx * dx + linear) * dx + constant)
        return first, last

    return cover


def _geometry_gradient(real: type) -> Scalar:
    zero, half = real(0.0), real(0.5)
    nats, half_nats = real(-math.log(2.0)), real(-2.0 * math.log(2.0))

    @inlined
    def geometry_gradient(out, p, scratch, lanes, splat, x0):
        """`lanes`: 3 x 16 column sums of g, g dy and g dy^2, with g = v_alpha alpha and dy the row's offset."""
        lanes = lanes & 0xFFFF
        offset = half - (splat[MEAN_X] - real(x0))
        g_0, g_x, g_xx, g_y, g_xy, g_yy = zero, zero, zero, zero, zero, zero
        for i in range(TILE):
            dx = real(np.int32(i)) + offset
            g, gy = scratch[lanes + i], scratch[lanes + TILE + i]
            g_0 += g
            g_x += g * dx
            g_xx += g * dx * dx
            g_y += gy
            g_xy += gy * dx
            g_yy += scratch[lanes + 2 * TILE + i]
        # alpha = opacity exp(-q / 2), q = xx dx^2 + 2 xy dx dy + yy dy^2, and g = v_q * -2.
        xx, xy, yy = half_nats * splat[FORM_XX], nats * splat[FORM_XY], half_nats * splat[FORM_YY]
        out[p, V_MEAN] = xx * g_x + xy * g_y
        out[p, V_MEAN + 1] = xy * g_x + yy * g_y
        out[p, V_CONIC] = -half * g_xx
        out[p, V_CONIC + 1] = -g_xy
        out[p, V_CONIC + 2] = -half * g_yy
        out[p, V_OPACITY] = g_0 / splat[OPACITY]

    return geometry_gradient
