"""What one camera sees of Gaussians, sixteen of them at once: the steps of the forward kernel, in vectors.

The same maths as for one of them (`cpu_view`), which takes vectors as it takes numbers, but for roots and limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cpu_vector import (
    absolute,
    bits_of,
    exp,
    fraction,
    maximum,
    minimum,
    row_loader,
    select,
    square_root,
    store_all,
    thirds,
    times_power_of_2,
    transposed,
    vector_kind,
)
from glassplat.kernels.maths.harmonics import channel_with, harmonic_basis
from glassplat.kernels.maths.projection import LOW_PASS, shape_maths, vector_maths
from glassplat.kernels.project.cpu_view import view_steps, view_with
from glassplat.kernels.project.steps import MOST_DEVIATIONS

LANES = 16
COLUMNS = 48
"""Coefficients of a Gaussian at most."""

Step = Callable[..., Any]


class LaneSteps(NamedTuple):
    """Steps that take `LANES` Gaussians.

    Attributes:
        load_triples: three vectors from an array of triples, of the Gaussians from one on.
        may_show: bits of those that are on the kept sides of a camera, and come near its window: safe, not exact.
        place: (means on screen x and y, conic xx, xy and yy, depth, opacity, covariance xx and yy), and bits of those
            that have finite ones; from columns of means (3), quaternions (4), log scales (3) and logits of opacities.
        tabulate: puts the first coefficients of listed Gaussians, in columns, into the first half of a table.
        color: (red, green, blue) of such columns, before offset and clamp, for columns of means.
    """

    load_triples: Step
    may_show: Step
    place: Step
    tabulate: Step
    color: Step


@inlined
def gather(columns, at, listed, first, last, array):
    """Puts triples of the Gaussians listed from `first` on into three columns; the one at `last` stands in for more."""
    for i in range(LANES):
        n = listed[min(first + i, last)]
        for k in range(3):
            columns[(at + k) * LANES + i] = array[n, k]


@inlined
def gather_shapes(columns, listed, first, last, means, quats, log_scales, logit_opacities):
    """Puts all raw parameters but coefficients into columns, as `place` takes them."""
    for i in range(LANES):
        n = listed[min(first + i, last)]
        for k in range(3):
            columns[k * LANES + i], columns[(7 + k) * LANES + i] = means[n, k], log_scales[n, k]
        for k in range(4):
            columns[(3 + k) * LANES + i] = quats[n, k]
        columns[10 * LANES + i] = logit_opacities[n]


def lane_steps(real: type) -> LaneSteps:
    """Builds the steps for `real`, np.float32 or np.float64."""
    return LaneSteps(_load_triples(real), _may_show(real), _place(real), *_color(real))


def _load_triples(real: type) -> Step:
    load = vector_kind(real, LANES).load

    @inlined
    def load_triples(array, n):
        at = 3 * n
        return thirds(load(array, at), load(array, at + LANES), load(array, at + 2 * LANES))

    return load_triples


def _exponential(real: type) -> Step:
    """e^x; in single precision held within the normal numbers, relative error below 3e-7."""
    full = vector_kind(real, LANES).full
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


def _may_show(real: type) -> Step:
    vec3, pose, *_ = view_steps(real)
    dot = vector_maths().dot
    exponential = _exponential(real)
    zero, one, low_pass, most_deviations = real(0.0), real(1.0), real(LOW_PASS), real(MOST_DEVIATIONS)

    @inlined
    def may_show(c, mean, log_scales, cam_from_world, intrinsics, lens, near, clip_planes, clips, windows):
        row_x, row_y, row_z, offset = pose(cam_from_world, c)
        depth = dot(row_z, mean) + offset[2]
        kept = depth > near
        if clips:
            kept = kept & (dot(vec3(clip_planes, c), mean) + clip_planes[c, 3] > zero)
        inverse_depth = one / depth
        u = (dot(row_x, mean) + offset[0]) * inverse_depth * intrinsics[c, 0] + intrinsics[c, 2]
        v = (dot(row_y, mean) + offset[1]) * inverse_depth * intrinsics[c, 1] + intrinsics[c, 3]
        past_x = maximum(windows[c, 0] - u, u - windows[c, 2])
        past_y = maximum(windows[c, 1] - v, v - windows[c, 3])
        size = exponential(maximum(maximum(log_scales[0], log_scales[1]), log_scales[2])) * inverse_depth
        wide, high = size * (intrinsics[c, 0] * lens[c, 7]), size * (intrinsics[c, 1] * lens[c, 8])
        # NaN is beside nothing, which leaves the decision to the exact test.
        beside_x = (past_x > zero) & (past_x * past_x > (wide * wide + low_pass) * most_deviations)
        beside_y = (past_y > zero) & (past_y * past_y > (high * high + low_pass) * most_deviations)
        return bits_of(kept) & ~bits_of(beside_x | beside_y)

    return may_show


def shapes(real: type) -> Step:
    """The step that takes columns of quaternions, log scales and logits, after three others.

    It gives unit quaternions, their inverse norms, scales, axes, opacities, and the sum of the raw magnitudes.
    """
    rotation, exponential, load, one = (
        shape_maths(real).rotation,
        _exponential(real),
        vector_kind(real, LANES).load,
        real(1.0),
    )

    @inlined
    def shape(columns):
        w, x = load(columns, 3 * LANES), load(columns, 4 * LANES)
        y, z = load(columns, 5 * LANES), load(columns, 6 * LANES)
        a, b, d = load(columns, 7 * LANES), load(columns, 8 * LANES), load(columns, 9 * LANES)
        logit = load(columns, 10 * LANES)
        inverse_norm = one / square_root(w * w + x * x + y * y + z * z)
        quat = w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm
        column_x, column_y, column_z = rotation(quat)
        s_x, s_y, s_z = exponential(a), exponential(b), exponential(d)
        axes = (
            (s_x * column_x[0], s_x * column_x[1], s_x * column_x[2]),
            (s_y * column_y[0], s_y * column_y[1], s_y * column_y[2]),
            (s_z * column_z[0], s_z * column_z[1], s_z * column_z[2]),
        )
        raw = absolute(logit) + absolute(a) + absolute(b) + absolute(d)
        return quat, inverse_norm, (s_x, s_y, s_z), axes, one / (one + exponential(-logit)), raw

    return shape


def views(real: type) -> Step:
    """As `ViewSteps.view`, of vectors."""
    full = vector_kind(real, LANES).full

    @inlined
    def held(tangent, low, high):
        return minimum(maximum(tangent, full(low)), full(high))

    return view_with(real, held)


def _place(real: type) -> Step:
    pose, dot = view_steps(real).pose, vector_maths().dot
    shape, view, load = shapes(real), views(real), vector_kind(real, LANES).load
    zero, one, largest = real(0.0), real(1.0), real(np.finfo(real).max)

    @inlined
    def place(columns, c, cam_from_world, intrinsics, lens):
        mean = load(columns, 0), load(columns, LANES), load(columns, 2 * LANES)
        _, inverse_norm, _, axes, opacity, raw = shape(columns)
        row_x, row_y, row_z, offset = pose(cam_from_world, c)
        depth = dot(row_z, mean) + offset[2]
        position = dot(row_x, mean) + offset[0], dot(row_y, mean) + offset[1], depth
        tangent, _, _, _, covariance = view((row_x, row_y, row_z), position, axes, intrinsics, lens, c)
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


def channel_of(real: type) -> Step:
    """The step that gives one colour from harmonics and a table, whose columns begin at an index."""
    load = vector_kind(real, LANES).load

    @inlined
    def take(table, at, k, c):
        return load(table, at + (3 * k + c) * LANES)

    return channel_with(take)


def _color(real: type) -> tuple[Step, Step]:
    load_rows, load, basis = row_loader(real, LANES), vector_kind(real, LANES).load, harmonic_basis(real)
    channel, one, whole = channel_of(real), real(1.0), COLUMNS * LANES

    @inlined
    def tabulate(table, listed, first, last, terms, sh, row_size, positions):
        """Of the first `terms` coefficients, three numbers each; `sh` is flat, with rows of `row_size`.

        The second half of the table is scratch, for rows so near the end of `sh` that whole vectors would reach beyond.
        """
        inside = listed[last] * row_size + (3 * terms + LANES - 1) // LANES * LANES <= sh.size
        for i in range(LANES):
            n = listed[min(first + i, last)]
            positions[i] = n * row_size
            if not inside:
                for k in range(3 * terms):
                    table[whole + i * COLUMNS + k] = sh[n * row_size + k]
                positions[i] = whole + i * COLUMNS
        source = sh if inside else table
        for begin in range(0, 3 * terms, LANES):
            store_all(table, begin * LANES, transposed(load_rows(source, positions, begin)))

    @inlined
    def color(table, means, at, degree, lens, c):
        x = load(means, 0) - lens[c, 4]
        y, z = load(means, LANES) - lens[c, 5], load(means, 2 * LANES) - lens[c, 6]
        inverse_length = one / square_root(x * x + y * y + z * z)
        b = basis(x * inverse_length, y * inverse_length, z * inverse_length)
        return (
            channel(table, at, 0, degree, b),
            channel(table, at, 1, degree, b),
            channel(table, at, 2, degree, b),
        )

    return tabulate, color
