"""Scalar maths of a cube map: face and position of a direction, neighbouring texels across edges, and mirroring.

Every function is pure and compiles for the CPU and for CUDA, typed by its factory where needed. Face 2 a + s belongs to
axis a, on the negative side for s = 1; its columns run along axis a + 1 and its rows along a + 2 (mod 3). Cells are
texels of faces padded by a ring of their neighbours' texels: texel i is cell i + 1.
"""

from __future__ import annotations

import numpy as np

from glassplat.kernels.backend.cpu import ONE, TWO, ZERO, inlined
from glassplat.kernels.maths.blending import Scalar, build_exp2
from glassplat.kernels.maths.projection import combine, dot


@inlined
def on_face(x, y, z):
    """(Axis, face, u, v, 1 / |largest coordinate|) of a direction; u and v are in [-1, 1]."""
    size_x, size_y, size_z = abs(x), abs(y), abs(z)
    if size_x >= size_y and size_x >= size_z:
        axis, major, along, down = 0, x, y, z
    elif size_y >= size_z:
        axis, major, along, down = 1, y, z, x
    else:
        axis, major, along, down = 2, z, x, y
    inverse = ONE / abs(major)
    return axis, 2 * axis + (1 if major < ZERO else 0), along * inverse, down * inverse, inverse


@inlined
def from_face(place, g_u, g_v):
    """Gradient of a direction from those of u and v, given the result of `on_face`."""
    axis, face, u, v, inverse = place
    along, down = g_u * inverse, g_v * inverse
    outwards = -(along * u + down * v)
    outwards = -outwards if face > 2 * axis else outwards
    if axis == 0:
        return outwards, along, down
    if axis == 1:
        return down, outwards, along
    return along, down, outwards


def build_cell(real: type) -> Scalar:
    """Builds the first of the two cells around u or v, and the fraction of the way to the second one.

    The cell is valid for every value; the fraction of NaN is NaN.
    """
    half = real(0.5)

    @inlined
    def cell(u, size):
        extent = real(size)
        position = half * (u * extent + extent) + half
        held = position if position > half else half
        held = held if held < extent + half else extent + half
        first = np.int32(held)
        return first, position - real(first)

    return cell


@inlined
def bilinear(left, right, lower_left, lower_right, along, down):
    """Interpolation of two cells of a row and the two below them, at the fractions along the row and down."""
    above = left * (ONE - along) + right * along
    below = lower_left * (ONE - along) + lower_right * along
    return above * (ONE - down) + below * down


@inlined
def bilinear_gradient(left, right, lower_left, lower_right, along, down):
    """Derivatives of `bilinear` with respect to the fractions."""
    across = right - left
    twist = lower_right - lower_left - across
    return across + down * twist, lower_left - left + along * twist


def build_logistic(real: type) -> Scalar:
    """Builds 1 / (1 + exp(-x))."""
    exp2, bits = build_exp2(real), real(1.0 / np.log(2.0))

    @inlined
    def logistic(x):
        small = exp2(-abs(x) * bits)
        value = (ONE if x >= ZERO else small) / (ONE + small)
        # `exp2` treats NaN as a very small number.
        return value if x == x else x

    return logistic


def lookup_maths(real: type) -> tuple[Scalar, Scalar]:
    """Lookup of padded faces in direction `i`, and the gradient of that direction."""
    cell, zero, half = build_cell(real), real(0.0), real(0.5)

    @inlined
    def look_up(i, padded, directions, found):
        size = padded.shape[1] - 2
        _, face, u, v, _ = on_face(directions[i, 0], directions[i, 1], directions[i, 2])
        column, along = cell(u, size)
        row, down = cell(v, size)
        upper, lower = padded[face, row], padded[face, row + 1]
        for d in range(padded.shape[3]):
            found[i, d] = bilinear(
                upper[column, d], upper[column + 1, d], lower[column, d], lower[column + 1, d], along, down
            )

    @inlined
    def look_up_gradient(i, padded, directions, v_found, v_directions, fractions):
        """Also fills the fractions; returns the row of cells, counted over all faces, and the column."""
        side = padded.shape[1]
        place = on_face(directions[i, 0], directions[i, 1], directions[i, 2])
        face = place[1]
        column, along = cell(place[2], side - 2)
        row, down = cell(place[3], side - 2)
        upper, lower = padded[face, row], padded[face, row + 1]
        v_along, v_down = zero, zero
        for d in range(padded.shape[3]):
            by_along, by_down = bilinear_gradient(
                upper[column, d], upper[column + 1, d], lower[column, d], lower[column + 1, d], along, down
            )
            v_along += v_found[i, d] * by_along
            v_down += v_found[i, d] * by_down
        texels_per_u = half * real(side - 2)
        x, y, z = from_face(place, v_along * texels_per_u, v_down * texels_per_u)
        v_directions[i, 0], v_directions[i, 1], v_directions[i, 2] = x, y, z
        fractions[i, 0], fractions[i, 1] = along, down
        return face * side + row, column

    return look_up, look_up_gradient


@inlined
def mirror_ray(ray, normal):
    """A ray mirrored by a normal of any length, times the square of that length."""
    return combine(dot(normal, normal), ray, -TWO * dot(ray, normal), normal)


@inlined
def mirrored_gradient(ray, normal, g):
    """Gradient of the normal from that of the mirrored ray."""
    by_square = combine(TWO * dot(ray, g), normal, -TWO * dot(normal, g), ray)
    across = -TWO * dot(ray, normal)
    return by_square[0] + across * g[0], by_square[1] + across * g[1], by_square[2] + across * g[2]


# Neighbours across the edges of a cube map with S texels a side, in whole numbers.


@inlined
def over_column(face, side, row, size):
    """(face, row, column) of the texel next to `row`: after the last column for side 0, before the first for side 1."""
    return 2 * ((face // 2 + 1) % 3) + side, (1 - face % 2) * (size - 1), row


@inlined
def over_row(face, side, column, size):
    """The same for the texel next to `column`, after the last or before the first row."""
    return 2 * ((face // 2 + 2) % 3) + side, column, (1 - face % 2) * (size - 1)
