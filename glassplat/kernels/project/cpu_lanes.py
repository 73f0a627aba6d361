"""Projection of Gaussians into one camera, sixteen at once in SIMD lanes, and its gradients.

The maths of single Gaussians (`steps`) accepts vectors too, except for roots and limits.
"""

from __future__ import annotations

import math

import numpy as np

from glassplat.kernels.backend.cpu import ONE, inlined
from glassplat.kernels.backend.cpu_vector import (
    absolute,
    bits_of,
    exp,
    fraction,
    maximum,
    minimum,
    row_loader,
    select,
    split_triples,
    square_root,
    store,
    store_all,
    times_power_of_2,
    transpose,
    vector_kind,
)
from glassplat.kernels.maths import projection
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.harmonics import build_channel, build_color_gradient, harmonic_basis
from glassplat.kernels.maths.projection import dot, rotation, scaled_columns, scaled_sum
from glassplat.kernels.project.steps import MOST_SQUARED_DEVIATIONS, build_view, in_camera, place_gradients, vec3

LANES = 16
full, load = vector_kind(LANES)
load_rows = row_loader(LANES)
COLUMNS = 48
"""Maximum number of coefficients of a Gaussian."""


@inlined
def gather(columns, at, listed, first, last, array):
    """Copies triples of the Gaussians listed from `first` to `last` to three columns; the last one pads the lanes."""
    for i in range(LANES):
        n = listed[min(first + i, last)]
        for k in range(3):
            columns[(at + k) * LANES + i] = array[n, k]


@inlined
def gather_shapes(columns, listed, first, last, means, quats, log_scales, logit_opacities):
    """Copies all raw parameters but coefficients to columns, in the order expected by `place`."""
    for i in range(LANES):
        n = listed[min(first + i, last)]
        for k in range(3):
            columns[k * LANES + i], columns[(7 + k) * LANES + i] = means[n, k], log_scales[n, k]
        for k in range(4):
            columns[(3 + k) * LANES + i] = quats[n, k]
        columns[10 * LANES + i] = logit_opacities[n]


@inlined
def load_triples(array, n):
    """Loads three vectors from an array of triples, starting at Gaussian n."""
    at = 3 * n
    return split_triples(load(array, at), load(array, at + LANES), load(array, at + 2 * LANES))


def _exponential(real: type) -> Scalar:
    """Builds e^x; in single precision clamped to normal numbers, with a relative error below 3e-7."""
    # Taylor series of 2^f for f in [-1/2, 1/2].
    e0, e1, e2, e3, e4, e5, e6, e7 = (real(math.log(2.0) ** k / math.factorial(k)) for k in range(8))
    bits, half, zero, lowest, highest = real(1 / math.log(2.0)), real(0.5), real(0.0), real(-125.0), real(126.0)

    @inlined
    def fast(x):
        t = maximum(minimum(x * bits, full(highest)), full(lowest))
        near = t + select(t > zero, full(half), full(-half))
        f = t - (near - fraction(near))
        return times_power_of_2(((((((f * e7 + e6) * f + e5) * f + e4) * f + e3) * f + e2) * f + e1) * f + e0, near)

    return exp if real is np.float64 else fast


def may_show_of(real: type) -> Scalar:
    """Builds a conservative culling test: bits of Gaussians on the kept sides that may reach a camera's window."""
    exponential = _exponential(real)
    zero, one, low_pass, most_squared = real(0.0), real(1.0), real(projection.LOW_PASS), real(MOST_SQUARED_DEVIATIONS)

    @inlined
    def may_show(c, mean, log_scales, cam_from_world, intrinsics, lens, near, clip_planes, clips, windows):
        _, (x, y, depth) = in_camera(cam_from_world, c, mean)
        kept = depth > near
        if clips:
            kept = kept & (dot(vec3(clip_planes, c), mean) + clip_planes[c, 3] > zero)
        inverse_depth = one / depth
        u = x * inverse_depth * intrinsics[c, 0] + intrinsics[c, 2]
        v = y * inverse_depth * intrinsics[c, 1] + intrinsics[c, 3]
        past_x = maximum(windows[c, 0] - u, u - windows[c, 2])
        past_y = maximum(windows[c, 1] - v, v - windows[c, 3])
        size = exponential(maximum(maximum(log_scales[0], log_scales[1]), log_scales[2])) * inverse_depth
        wide, high = size * (intrinsics[c, 0] * lens[c, 7]), size * (intrinsics[c, 1] * lens[c, 8])
        # NaN is never culled here, which leaves the decision to the exact test.
        beside_x = (past_x > zero) & (past_x * past_x > (wide * wide + low_pass) * most_squared)
        beside_y = (past_y > zero) & (past_y * past_y > (high * high + low_pass) * most_squared)
        return bits_of(kept) & ~bits_of(beside_x | beside_y)

    return may_show


def shapes(real: type) -> Scalar:
    """Builds the step that activates columns of quaternions, log scales and logits, which follow the three of means.

    It returns unit quaternions, their inverse norms, scales, axes, opacities, and the sum of the raw magnitudes.
    """
    exponential, one = _exponential(real), real(1.0)

    @inlined
    def shape(columns):
        w, x = load(columns, 3 * LANES), load(columns, 4 * LANES)
        y, z = load(columns, 5 * LANES), load(columns, 6 * LANES)
        a, b, d = load(columns, 7 * LANES), load(columns, 8 * LANES), load(columns, 9 * LANES)
        logit = load(columns, 10 * LANES)
        inverse_norm = one / square_root(w * w + x * x + y * y + z * z)
        quat = w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm
        scales = exponential(a), exponential(b), exponential(d)
        axes = scaled_columns(scales, rotation(quat))
        raw = absolute(logit) + absolute(a) + absolute(b) + absolute(d)
        return quat, inverse_norm, scales, axes, one / (one + exponential(-logit)), raw

    return shape


@inlined
def _held(tangent, low, high):
    return minimum(maximum(tangent, full(low)), full(high))


def place_of(real: type) -> Scalar:
    """Builds the step that projects Gaussians, from columns of means (3), quaternions (4), log scales (3) and logits.

    It returns (mean x and y, conic xx, xy and yy, depth, opacity, covariance xx and yy), and bits of the finite ones.
    """
    shape, view = shapes(real), build_view(real, _held)
    zero, one, largest = real(0.0), real(1.0), real(np.finfo(real).max)

    @inlined
    def place(columns, c, cam_from_world, intrinsics, lens):
        mean = load(columns, 0), load(columns, LANES), load(columns, 2 * LANES)
        _, inverse_norm, _, axes, opacity, raw = shape(columns)
        rows, position = in_camera(cam_from_world, c, mean)
        depth = position[2]
        tangent, _, _, _, covariance = view(rows, position, axes, intrinsics, lens, c)
        xx, xy, yy, determinant = covariance
        u = tangent[0] * intrinsics[c, 0] + intrinsics[c, 2]
        v = tangent[1] * intrinsics[c, 1] + intrinsics[c, 3]
        inverse = one / determinant
        # Ordered comparisons, so that NaN anywhere culls.
        raw = raw + absolute(mean[0]) + absolute(mean[1]) + absolute(mean[2])
        sound = (raw <= largest) & (inverse_norm > zero) & (inverse_norm <= largest)
        sound = sound & (absolute(determinant) <= largest) & (absolute(depth) <= largest)
        return (u, v, yy * inverse, -xy * inverse, xx * inverse, depth, opacity, xx, yy), bits_of(sound)

    return place


@inlined
def _take(table, at, k, c):
    return load(table, at + (3 * k + c) * LANES)


channel = build_channel(_take)
"""One colour channel, from harmonics and table columns starting at an index."""


@inlined
def directions(means, lens, c):
    """Unit vectors from a camera's centre to columns of means, and their inverse lengths."""
    x = load(means, 0) - lens[c, 4]
    y, z = load(means, LANES) - lens[c, 5], load(means, 2 * LANES) - lens[c, 6]
    inverse_length = ONE / square_root(x * x + y * y + z * z)
    return (x * inverse_length, y * inverse_length, z * inverse_length), inverse_length


@inlined
def tabulate(table, listed, first, last, terms, sh, row_size, positions):
    """Copies the first `terms` coefficients of listed Gaussians, three numbers each, to columns of a table's first
    half; `sh` is flat, with rows of `row_size`.

    The second half of the table is scratch, for rows near the end of `sh`, where vector loads would overrun.
    """
    inside = listed[last] * row_size + (3 * terms + LANES - 1) // LANES * LANES <= sh.size
    for i in range(LANES):
        n = listed[min(first + i, last)]
        positions[i] = n * row_size
        if not inside:
            for k in range(3 * terms):
                table[COLUMNS * (LANES + i) + k] = sh[n * row_size + k]
            positions[i] = COLUMNS * (LANES + i)
    source = sh if inside else table
    for begin in range(0, 3 * terms, LANES):
        store_all(table, begin * LANES, transpose(load_rows(source, positions, begin)))


def color_of(real: type) -> Scalar:
    """Builds the step that evaluates colours from a table of coefficients."""
    basis = harmonic_basis(real)

    @inlined
    def color(table, means, degree, lens, c):
        """(Red, green, blue) before offset and clamp, from columns of coefficients and of means."""
        (x, y, z), _ = directions(means, lens, c)
        b = basis(x, y, z)
        return channel(table, 0, 0, degree, b), channel(table, 0, 1, degree, b), channel(table, 0, 2, degree, b)

    return color


def place_gradient_of(real: type) -> Scalar:
    """Builds the adjoint of `place`, from the same columns, followed by the gradients of 2D means (2), conics (3),
    depths and opacities.

    It returns the gradients of the first columns (11), and each Gaussian's contribution to that of the camera (12).
    """
    shape, view, zero, one = shapes(real), build_view(real, _held), real(0.0), real(1.0)

    @inlined
    def free(x, held, tangent):
        return select((held >= tangent) & (held <= tangent), x, full(zero))

    placed = place_gradients(real, free)

    @inlined
    def place_gradient(columns, c, cam_from_world, intrinsics, lens):
        mean = load(columns, 0), load(columns, LANES), load(columns, 2 * LANES)
        quat, inverse_norm, scales, axes, opacity, _ = shape(columns)
        rows, position = in_camera(cam_from_world, c, mean)
        g_mean2d = load(columns, 11 * LANES), load(columns, 12 * LANES)
        g_conic = load(columns, 13 * LANES), load(columns, 14 * LANES), load(columns, 15 * LANES)
        seen = view(rows, position, axes, intrinsics, lens, c)
        g, (r_x, r_y, r_z), (a_x, a_y, a_z) = placed(
            rows, position, seen, axes, intrinsics, c, g_mean2d, g_conic, load(columns, 16 * LANES)
        )
        g_mean = scaled_sum(g, rows)
        g_w, g_i, g_j, g_k = projection.unit_quat_gradient(quat, inverse_norm, scaled_columns(scales, (a_x, a_y, a_z)))
        g_logit = load(columns, 17 * LANES) * opacity * (one - opacity)
        own = (
            g_mean[0], g_mean[1], g_mean[2], g_w, g_i, g_j, g_k,
            dot(axes[0], a_x), dot(axes[1], a_y), dot(axes[2], a_z), g_logit,
        )  # fmt: skip
        x, y, z = mean
        camera = (
            r_x[0] + g[0] * x, r_x[1] + g[0] * y, r_x[2] + g[0] * z, g[0],
            r_y[0] + g[1] * x, r_y[1] + g[1] * y, r_y[2] + g[1] * z, g[1],
            r_z[0] + g[2] * x, r_z[1] + g[2] * y, r_z[2] + g[2] * z, g[2],
        )  # fmt: skip
        return own, camera

    return place_gradient


@inlined
def _put(table, at, k, b, g):
    store(table, at + 3 * k * LANES, b * g[0])
    store(table, at + (3 * k + 1) * LANES, b * g[1])
    store(table, at + (3 * k + 2) * LANES, b * g[2])


@inlined
def _v_basis(table, at, k, g):
    begin = at + 3 * k * LANES
    return load(table, begin) * g[0] + load(table, begin + LANES) * g[1] + load(table, begin + 2 * LANES) * g[2]


def color_gradient_of(real: type) -> Scalar:
    """Builds the adjoint of `color`, from a table of coefficients and columns of means and of gradients of colours.

    It writes the gradients of the coefficients to the second half of the table, and returns those of the vector from
    the camera to the mean.
    """
    adjoint = build_color_gradient(real, _put, _v_basis)
    basis, whole, zero, half = harmonic_basis(real), COLUMNS * LANES, real(0.0), real(0.5)

    @inlined
    def color_gradient(table, columns, degree, lens, c):
        ((x, y, z), inverse_length), none = directions(columns, lens, c), full(zero)
        b = basis(x, y, z)
        g = (
            select(channel(table, 0, 0, degree, b) + half > zero, load(columns, 3 * LANES), none),
            select(channel(table, 0, 1, degree, b) + half > zero, load(columns, 4 * LANES), none),
            select(channel(table, 0, 2, degree, b) + half > zero, load(columns, 5 * LANES), none),
        )
        return projection.tangential(
            inverse_length, adjoint(table, 0, degree, x, y, z, b, g, table, whole, none), (x, y, z)
        )

    return color_gradient
