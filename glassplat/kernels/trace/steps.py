"""Steps of a search shared by CPU and GPU: reading rays, coverage and colour of hits, and lists of nearest hits."""

from __future__ import annotations

import math

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, Scalar
from glassplat.kernels.maths.disc import MOST_DEVIATIONS
from glassplat.kernels.maths.harmonics import color_maths

CHUNK = 16
"""Maximum number of hits of a ray's first search."""
WIDTH = 8
"""Children of a node."""
NODE = 6 * WIDTH
"""Numbers per node: minimum x, y, z and maximum x, y, z of its children."""
STACK = 80
"""Maximum number of pending nodes: seven siblings on each of eleven levels, enough for 32-bit positions, plus one."""
LEVEL_BITS = 4
"""Bits of a node's level in a stack entry; the upper bits hold its index."""
SLACK = 1e-5
"""Relative enlargement of boxes along a ray, so that rounding loses no hit."""
LARGEST_INVERSE = 1e15
"""Replaces 1 / 0 for a direction of length 1; valid for lengths whose square does not underflow in float32."""
FRAME_AT, OPACITY_AT, CONTRIBUTION_AT, GEOMETRY = 3, 12, 13, 15
"""Columns of a row: gradients of mean (3), frame (9), opacity, contributions (2); harmonics have rows of their own."""


def ray_reader(real: type) -> Scalar:
    """Builds the step that reads (origin, direction, inverse direction, length) of a ray, and whether it is valid."""
    zero, one, largest, most = real(0.0), real(1.0), real(LARGEST_INVERSE), real("inf")

    @inlined
    def inverse(x, length):
        if abs(x) * largest > length:
            return one / x
        return (-largest if x < zero else largest) / length

    @inlined
    def ray(origins, directions, r):
        o = origins[r, 0], origins[r, 1], origins[r, 2]
        d = directions[r, 0], directions[r, 1], directions[r, 2]
        squared = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        # NaN and infinity fail one of the comparisons.
        usable = squared > zero and squared < most and abs(o[0]) + abs(o[1]) + abs(o[2]) < most
        length = real(math.sqrt(squared))
        return o, d, (inverse(d[0], length), inverse(d[1], length), inverse(d[2], length)), length, usable

    return ray


@inlined
def shape_of(means, frames, g, o):
    """Offset of one Gaussian from a ray's origin, and its frame."""
    offset = means[g, 0] - o[0], means[g, 1] - o[1], means[g, 2] - o[2]
    first = frames[g, 0, 0], frames[g, 0, 1], frames[g, 0, 2]
    second = frames[g, 1, 0], frames[g, 1, 1], frames[g, 1, 2]
    third = frames[g, 2, 0], frames[g, 2, 1], frames[g, 2, 2]
    return offset, (first, second, third)


def coverage_maths(real: type, exp2: Scalar) -> Scalar:
    """Builds (coverage before clamping, alpha) from opacity and squared distance; both are 0 for misses.

    `exp2` is 2^t for t <= 0.
    """
    half_bits, farthest = real(-0.5 / 0.6931471805599453), real(MOST_DEVIATIONS**2)
    zero, least, most = real(0.0), real(ALPHA_MIN), real(ALPHA_MAX)

    @inlined
    def coverage(opacity, squared):
        if not squared <= farthest:
            return zero, zero
        covered = opacity * exp2(half_bits * squared)
        if not covered >= least:
            return zero, zero
        return covered, covered if covered < most else most

    return coverage


def color_backward(real: type) -> Scalar:
    """Builds the step that adds a hit's gradient of harmonics; returns (colour . v_colour, gradient of unit direction).

    `sh` and `v_sh` are of one Gaussian, [1, K, 3].
    """
    color, color_gradient = color_maths(real)
    zero, half = real(0.0), real(0.5)

    @inlined
    def backward(sh, degree, unit, v_colors, r, weight, v_sh):
        x, y, z = unit[0], unit[1], unit[2]
        red, green, blue = color(sh, 0, degree, x, y, z)
        red, green, blue = red + half, green + half, blue + half
        v_red = v_colors[r, 0] if red > zero else zero
        v_green = v_colors[r, 1] if green > zero else zero
        v_blue = v_colors[r, 2] if blue > zero else zero
        v_unit = color_gradient(sh, 0, degree, x, y, z, (weight * v_red, weight * v_green, weight * v_blue), v_sh)
        return v_red * red + v_green * green + v_blue * blue, v_unit

    return backward


@inlined
def insert(ts, ids, alphas, count, most, t, g, alpha):
    """Inserts a hit into the `most` nearest, ordered by (t, Gaussian); returns their number."""
    place = count if count < most else most - 1
    while place > 0 and (ts[place - 1] > t or (ts[place - 1] == t and ids[place - 1] > g)):
        ts[place], ids[place], alphas[place] = ts[place - 1], ids[place - 1], alphas[place - 1]
        place -= 1
    ts[place], ids[place], alphas[place] = t, g, alpha
    return count + 1 if count < most else count
