"""Scalar maths of view-dependent colour: real spherical harmonics up to degree 3, and their adjoint.

Signs and order are those of 3DGS, so that its files can be read as they are.
"""

from __future__ import annotations

import math

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.maths.blending import Scalar

MAX_DEGREE = 3
SH_CONSTANTS = (
    math.sqrt(1 / (4 * math.pi)),
    math.sqrt(3 / (4 * math.pi)),
    math.sqrt(15 / (4 * math.pi)),
    math.sqrt(5 / (16 * math.pi)),
    math.sqrt(15 / (16 * math.pi)),
    math.sqrt(35 / (32 * math.pi)),
    math.sqrt(105 / (4 * math.pi)),
    math.sqrt(21 / (32 * math.pi)),
    math.sqrt(7 / (16 * math.pi)),
    math.sqrt(105 / (16 * math.pi)),
)
"""Normalisation of the harmonics: degree 0; degree 1; degree 2 in the order (xy, z^2, x^2 - y^2); degree 3 in the order
(y (3 x^2 - y^2), xyz, y (4 z^2 - x^2 - y^2), z (2 z^2 - 3 x^2 - 3 y^2), z (x^2 - y^2))."""


def check_sh_degree(sh_degree: int, coefficients: int) -> None:
    """Raises ValueError if a degree is out of range or needs more coefficients than given; 0 coefficients are fine."""
    if not 0 <= sh_degree <= MAX_DEGREE or (coefficients and coefficients < (sh_degree + 1) ** 2):
        raise ValueError(
            f"sh_degree is {sh_degree}, but degrees go from 0 to {MAX_DEGREE} and sh holds {coefficients} coefficients"
            ", of which degree L needs (L + 1)^2; lower sh_degree or pass more"
        )


def color_maths(real: type) -> tuple[Scalar, Scalar]:
    """Builds the colour of one Gaussian from its coefficients `sh[n]` [K, 3], and its adjoint.

    `color` returns (r, g, b) before the offset and the clamp, seen along a unit direction (x, y, z). `color_gradient`
    adds the gradient of the coefficients to `g_sh[n]` and returns that of the direction.
    """
    basis = harmonic_basis(real)
    return _color(basis), _color_gradient(real, basis)


def harmonic_basis(real: type) -> Scalar:
    """Builds the function that returns all 16 harmonics of a unit direction (x, y, z)."""
    c0, c1, c_xy, c_zz, c_xx, c_yxx, c_xyz, c_yzz, c_zzz, c_zxx = (real(c) for c in SH_CONSTANTS)
    two, three, four = real(2.0), real(3.0), real(4.0)

    @inlined
    def basis(x, y, z):
        xx, yy, zz = x * x, y * y, z * z
        return (
            c0,
            -c1 * y,
            c1 * z,
            -c1 * x,
            c_xy * x * y,
            -c_xy * y * z,
            c_zz * (two * zz - xx - yy),
            -c_xy * x * z,
            c_xx * (xx - yy),
            -c_yxx * y * (three * xx - yy),
            c_xyz * x * y * z,
            -c_yzz * y * (four * zz - xx - yy),
            c_zzz * z * (two * zz - three * (xx + yy)),
            -c_yzz * x * (four * zz - xx - yy),
            c_zxx * z * (xx - yy),
            -c_yxx * x * (xx - three * yy),
        )

    return basis


def build_channel(take: Scalar) -> Scalar:
    """Builds the function that evaluates one colour channel from harmonics, for scalars or vectors.

    `take(sh, n, k, c)` reads channel c of coefficient k.
    """

    # Tuples are indexed by constants only: a variable index compiles to a switch.
    @inlined
    def channel(sh, n, c, degree, b):
        value = b[0] * take(sh, n, 0, c)
        if degree > 0:
            value = value + b[1] * take(sh, n, 1, c) + b[2] * take(sh, n, 2, c) + b[3] * take(sh, n, 3, c)
        if degree > 1:
            value = value + b[4] * take(sh, n, 4, c) + b[5] * take(sh, n, 5, c) + b[6] * take(sh, n, 6, c)
            value = value + b[7] * take(sh, n, 7, c) + b[8] * take(sh, n, 8, c)
        if degree > 2:
            value = value + b[9] * take(sh, n, 9, c) + b[10] * take(sh, n, 10, c) + b[11] * take(sh, n, 11, c)
            value = value + b[12] * take(sh, n, 12, c) + b[13] * take(sh, n, 13, c)
            value = value + b[14] * take(sh, n, 14, c) + b[15] * take(sh, n, 15, c)
        return value

    return channel


def build_color_gradient(real: type, put: Scalar, v_basis: Scalar) -> Scalar:
    """Builds the adjoint of three colour channels, for scalars or vectors; it returns the gradient of the direction.

    `put(g_sh, at, k, b, g)` stores or adds the gradient of coefficient k, from its harmonic b and the gradients g of
    the channels; `v_basis(sh, n, k, g)` returns the gradient of that harmonic.
    """
    first, second, third = _direction_gradients(real)

    @inlined
    def color_gradient(sh, n, degree, x, y, z, b, g, g_sh, at, none):
        put(g_sh, at, 0, b[0], g)
        gx, gy, gz = none, none, none
        if degree > 0:
            put(g_sh, at, 1, b[1], g)
            put(g_sh, at, 2, b[2], g)
            put(g_sh, at, 3, b[3], g)
            gx, gy, gz = first(v_basis(sh, n, 1, g), v_basis(sh, n, 2, g), v_basis(sh, n, 3, g))
        if degree > 1:
            put(g_sh, at, 4, b[4], g)
            put(g_sh, at, 5, b[5], g)
            put(g_sh, at, 6, b[6], g)
            put(g_sh, at, 7, b[7], g)
            put(g_sh, at, 8, b[8], g)
            h = (
                v_basis(sh, n, 4, g),
                v_basis(sh, n, 5, g),
                v_basis(sh, n, 6, g),
                v_basis(sh, n, 7, g),
                v_basis(sh, n, 8, g),
            )
            more = second(x, y, z, h)
            gx, gy, gz = gx + more[0], gy + more[1], gz + more[2]
        if degree > 2:
            put(g_sh, at, 9, b[9], g)
            put(g_sh, at, 10, b[10], g)
            put(g_sh, at, 11, b[11], g)
            put(g_sh, at, 12, b[12], g)
            put(g_sh, at, 13, b[13], g)
            put(g_sh, at, 14, b[14], g)
            put(g_sh, at, 15, b[15], g)
            low = (v_basis(sh, n, 9, g), v_basis(sh, n, 10, g), v_basis(sh, n, 11, g), v_basis(sh, n, 12, g))
            high = (v_basis(sh, n, 13, g), v_basis(sh, n, 14, g), v_basis(sh, n, 15, g))
            more = third(x, y, z, low, high)
            gx, gy, gz = gx + more[0], gy + more[1], gz + more[2]
        return gx, gy, gz

    return color_gradient


def _color(basis: Scalar) -> Scalar:
    @inlined
    def take(sh, n, k, c):
        return sh[n, k, c]

    channel = build_channel(take)

    @inlined
    def color(sh, n, degree, x, y, z):
        b = basis(x, y, z)
        return channel(sh, n, 0, degree, b), channel(sh, n, 1, degree, b), channel(sh, n, 2, degree, b)

    return color


def _color_gradient(real: type, basis: Scalar) -> Scalar:
    zero = real(0.0)

    @inlined
    def add(g_sh, n, k, b, g):
        g_sh[n, k, 0] += b * g[0]
        g_sh[n, k, 1] += b * g[1]
        g_sh[n, k, 2] += b * g[2]

    @inlined
    def v_basis(sh, n, k, g):
        return sh[n, k, 0] * g[0] + sh[n, k, 1] * g[1] + sh[n, k, 2] * g[2]

    adjoint = build_color_gradient(real, add, v_basis)

    @inlined
    def color_gradient(sh, n, degree, x, y, z, g, g_sh):
        return adjoint(sh, n, degree, x, y, z, basis(x, y, z), g, g_sh, n, zero)

    return color_gradient


def _direction_gradients(real: type) -> tuple[Scalar, Scalar, Scalar]:
    """Gradients of the direction, degree by degree, from the gradients h of the harmonics."""
    _, c1, c_xy, c_zz, c_xx, c_yxx, c_xyz, c_yzz, c_zzz, c_zxx = (real(c) for c in SH_CONSTANTS)
    two, three, four, six, eight = real(2.0), real(3.0), real(4.0), real(6.0), real(8.0)

    @inlined
    def first(h1, h2, h3):
        return -c1 * h3, -c1 * h1, c1 * h2

    @inlined
    def second(x, y, z, h):
        return (
            c_xy * (y * h[0] - z * h[3]) - two * c_zz * x * h[2] + two * c_xx * x * h[4],
            c_xy * (x * h[0] - z * h[1]) - two * c_zz * y * h[2] - two * c_xx * y * h[4],
            -c_xy * (y * h[1] + x * h[3]) + four * c_zz * z * h[2],
        )

    @inlined
    def third(x, y, z, low, high):
        xx, yy, zz = x * x, y * y, z * z
        h9, h10, h11, h12 = low
        h13, h14, h15 = high
        flat = three * (xx - yy)
        return (
            -c_yxx * (six * x * y * h9 + flat * h15)
            + c_xyz * y * z * h10
            + c_yzz * (two * x * y * h11 - (four * zz - three * xx - yy) * h13)
            - six * c_zzz * x * z * h12
            + two * c_zxx * x * z * h14,
            c_yxx * (six * x * y * h15 - flat * h9)
            + c_xyz * x * z * h10
            + c_yzz * (two * x * y * h13 - (four * zz - xx - three * yy) * h11)
            - six * c_zzz * y * z * h12
            - two * c_zxx * y * z * h14,
            c_xyz * x * y * h10
            - eight * c_yzz * (y * z * h11 + x * z * h13)
            + c_zzz * (six * zz - three * (xx + yy)) * h12
            + c_zxx * (xx - yy) * h14,
        )

    return first, second, third
