"""What the kernels that blend discs share: packed discs, planes of a tile, and where a block of pixels meets a disc.

Tiles, blocks and outlines are those of `glassplat.kernels.composite.cpu_tile`: which blocks a disc may reach is decided
by its outline, and what it covers by its map.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cpu_vector import item, select, vector_kind
from glassplat.kernels.composite import cpu_tile as tile
from glassplat.kernels.maths.blending import ALPHA_MIN, Scalar
from glassplat.kernels.maths.disc import meet_maths
from glassplat.kernels.maths.ray_hit import MOST_DEVIATIONS

# Columns of a packed disc: first its outline as a packed splat, of which ORDER is reused once blocks are known.
CENTER_X, CENTER_Y, U_X, U_Y, V_X, V_Y, W_X, W_Y, BITS, DEPTH, INVERSE_DEPTH, VALUES = range(
    tile.VALUES, tile.VALUES + 12
)
ORDER = tile.ORDER

# Planes of a tile's state, which the backward pass starts from: transmittance, position in the tile's list of the last
# disc that a pixel blended and of the one whose depth is the median, and of the inverse depths the one that others are
# measured from, the weighted sum and the weighted sum of squares. T is negative where a pixel has stopped.
T, LAST, MEDIAN, FIRST, TOTAL, SQUARES = (plane * tile.PIXELS for plane in range(6))
STATE = 6 * tile.PIXELS


class DiscFunctions(NamedTuple):
    """Compiled steps that every kernel takes.

    Attributes:
        pack: copies one disc's geometry into its packed row; returns whether it may be drawn.
        fetch: copies the packed discs of consecutive pairs next to each other, their centres relative to the tile.
        cover: of a fetched disc and a block: the offset (dx, dy) of the pixels, (u, v, 1 / e) and e where their rays
            meet the disc, (0, 0, 1) and 1 where the falloff around its centre is the larger one; the coverage before it
            is clamped, 0 where it is not drawn; and which pixels show the disc and not that falloff.
    """

    pack: Scalar
    fetch: Scalar
    cover: Scalar


def disc_functions(real: type) -> DiscFunctions:
    """Builds the functions for `real`, np.float32 or np.float64."""
    return DiscFunctions(_pack(real), _fetch(real), _cover(real))


def packed_width(num_values: int) -> int:
    """Columns of a packed disc that carries `num_values` channels in whole groups: whole vectors."""
    return tile.LANES * ((VALUES + tile.GROUP * tile.groups_of(num_values) + tile.LANES - 1) // tile.LANES)


def _pack(real: type) -> Scalar:
    pack_outline = tile.tile_functions(real).pack
    zero, one, nothing, endless = real(0.0), real(1.0), real(-np.inf), real(np.inf)
    alpha_min, bits = real(ALPHA_MIN), 1.0 / math.log(2.0)

    @inlined
    def pack(packed, at, center, map_of, opacity, depth, outline_center, conic):
        pack_outline(packed, at, outline_center, conic, opacity)
        if conic[0] == zero and conic[1] == zero and conic[2] == zero:
            # It crosses the near plane and may reach any block.
            for column in range(tile.FORM_XX, tile.VALUES):
                packed[at + column] = zero
        total = center[0] + center[1] + depth
        for j in range(6):
            packed[at + U_X + j] = map_of[j]
            total += map_of[j]
        drawn = abs(total) < endless and alpha_min <= opacity < endless and zero < depth
        if not drawn:
            packed[at + tile.BITS] = nothing
        packed[at + CENTER_X], packed[at + CENTER_Y] = center[0], center[1]
        packed[at + BITS] = real(bits * math.log(np.float64(opacity))) if drawn else nothing
        packed[at + DEPTH], packed[at + INVERSE_DEPTH] = depth, one / depth

    return pack


def _fetch(real: type) -> Scalar:
    fetch_splats = tile.tile_functions(real).fetch

    @inlined
    def fetch(batch, packed, pair_splats, first, last, width, x0, y0):
        fetch_splats(batch, packed, pair_splats, first, last, width, x0, y0)
        for k in range(last - first):
            batch[k * width + CENTER_X] -= real(x0)
            batch[k * width + CENTER_Y] -= real(y0)

    return fetch


def _cover(real: type) -> Scalar:
    meet, exp2, full = meet_maths(real)[0], tile.tile_functions(real).exp2, vector_kind(real, tile.LANES).full
    x_centers, y_centers = tile.pixel_centers(real)
    zero, one, farthest = real(0.0), real(1.0), real(MOST_DEVIATIONS**2)
    half_bits, least = real(0.5 / math.log(2.0)), real(math.log2(ALPHA_MIN))
    far = real(4 * MOST_DEVIATIONS**2)

    @inlined
    def cover(batch, at, x, y, near, sharpness):
        """`x` and `y` are the block's corner, `sharpness` is one over the variance of the low-pass."""
        dx = x_centers() + (x - item(batch, at + CENTER_X))
        dy = y_centers() + (y - item(batch, at + CENTER_Y))
        found = (
            item(batch, at + U_X), item(batch, at + U_Y), item(batch, at + V_X), item(batch, at + V_Y),
            item(batch, at + W_X), item(batch, at + W_Y),
        )  # fmt: skip
        none, ones = full(zero), full(one)
        up, vp, e = meet(found, dx, dy)
        inverse = ones / e
        u, v = up * inverse, vp * inverse
        solid = u * u + v * v
        around = (dx * dx + dy * dy) * sharpness
        # Comparisons with NaN are false, and so no falloff that is NaN is chosen.
        within = (e > zero) & (full(item(batch, at + DEPTH)) > e * near) & (solid <= farthest)
        solid = select(within, solid, full(far))
        nearer = around < solid
        q = select(nearer, around, solid)
        bits = full(item(batch, at + BITS)) - q * half_bits
        drawn = (q <= farthest) & (bits >= least)
        coverage = select(drawn, exp2(bits), none)
        on_disc = within & (solid <= select(nearer, around, full(far)))
        met = select(on_disc, u, none), select(on_disc, v, none), select(on_disc, inverse, ones)
        return (dx, dy), met, select(on_disc, e, ones), coverage, on_disc

    return cover
