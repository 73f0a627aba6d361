"""Gradients of what one camera sees of Gaussians, sixteen of them at once: the backward steps, in vectors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cpu_vector import select, square_root, store, vector_kind
from glassplat.kernels.maths.harmonics import color_gradient_with, harmonic_basis
from glassplat.kernels.maths.projection import shape_maths, vector_maths
from glassplat.kernels.project.cpu_lanes import LANES, channel_of, shapes, views
from glassplat.kernels.project.cpu_view import view_steps
from glassplat.kernels.project.gradient_steps import place_gradients

Step = Callable[..., Any]


class GradientSteps(NamedTuple):
    """Steps that take `LANES` Gaussians.

    Attributes:
        place_gradient: gradients of means (3), quaternions (4), log scales (3) and logits of opacities, and what each
            Gaussian adds to that of the camera (12); from columns of these, followed by the gradients of the means on
            screen (2), conics (3), depths and opacities, and the conics (3).
        color_gradient: from a table of coefficients and columns of means and of the gradients of colours, puts those of
            the coefficients into another table, and returns those of the vector from the camera to the mean.
    """

    place_gradient: Step
    color_gradient: Step


def gradient_steps(real: type) -> GradientSteps:
    """Builds the steps for `real`, np.float32 or np.float64."""
    return GradientSteps(_place_gradient(real), _color_gradient(real))


def _place_gradient(real: type) -> Step:
    pose = view_steps(real).pose
    dot, scaled_sum = vector_maths().dot, vector_maths().scaled_sum
    unit_quat_gradient, (full, load) = shape_maths(real).unit_quat_gradient, vector_kind(real, LANES)
    shape, view, zero, one = shapes(real), views(real), real(0.0), real(1.0)

    @inlined
    def free(x, held, tangent):
        return select((held >= tangent) & (held <= tangent), x, full(zero))

    placed = place_gradients(real, free)

    @inlined
    def place_gradient(columns, c, cam_from_world, intrinsics, lens):
        mean = load(columns, 0), load(columns, LANES), load(columns, 2 * LANES)
        quat, inverse_norm, scales, axes, opacity, _ = shape(columns)
        row_x, row_y, row_z, offset = pose(cam_from_world, c)
        position = dot(row_x, mean) + offset[0], dot(row_y, mean) + offset[1], dot(row_z, mean) + offset[2]
        rows = row_x, row_y, row_z
        g_mean2d = load(columns, 11 * LANES), load(columns, 12 * LANES)
        g_conic = load(columns, 13 * LANES), load(columns, 14 * LANES), load(columns, 15 * LANES)
        conic = load(columns, 18 * LANES), load(columns, 19 * LANES), load(columns, 20 * LANES)
        seen = view(rows, position, axes, intrinsics, lens, c)
        g, (r_x, r_y, r_z), (a_x, a_y, a_z) = placed(
            rows, position, seen, axes, intrinsics, c, g_mean2d, g_conic, load(columns, 16 * LANES), conic
        )
        g_mean = scaled_sum(g, row_x, row_y, row_z)
        turned = (
            (scales[0] * a_x[0], scales[0] * a_x[1], scales[0] * a_x[2]),
            (scales[1] * a_y[0], scales[1] * a_y[1], scales[1] * a_y[2]),
            (scales[2] * a_z[0], scales[2] * a_z[1], scales[2] * a_z[2]),
        )
        g_w, g_i, g_j, g_k = unit_quat_gradient(quat, inverse_norm, turned[0], turned[1], turned[2])
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


def _color_gradient(real: type) -> Step:
    (full, load), basis, channel = vector_kind(real, LANES), harmonic_basis(real), channel_of(real)
    tangential, zero, half, one = vector_maths().tangential, real(0.0), real(0.5), real(1.0)

    @inlined
    def put(table, at, k, b, g):
        store(table, at + 3 * k * LANES, b * g[0])
        store(table, at + (3 * k + 1) * LANES, b * g[1])
        store(table, at + (3 * k + 2) * LANES, b * g[2])

    @inlined
    def pull(table, at, k, g):
        begin = at + 3 * k * LANES
        return load(table, begin) * g[0] + load(table, begin + LANES) * g[1] + load(table, begin + 2 * LANES) * g[2]

    adjoint = color_gradient_with(real, put, pull)

    @inlined
    def color_gradient(table, at, columns, degree, lens, c):
        """Coefficients from index 0 of the table on, their gradients from `at` on."""
        x, y = load(columns, 0) - lens[c, 4], load(columns, LANES) - lens[c, 5]
        z, none = load(columns, 2 * LANES) - lens[c, 6], full(zero)
        inverse_length = one / square_root(x * x + y * y + z * z)
        x, y, z = x * inverse_length, y * inverse_length, z * inverse_length
        b = basis(x, y, z)
        g = (
            select(channel(table, 0, 0, degree, b) + half > zero, load(columns, 3 * LANES), none),
            select(channel(table, 0, 1, degree, b) + half > zero, load(columns, 4 * LANES), none),
            select(channel(table, 0, 2, degree, b) + half > zero, load(columns, 5 * LANES), none),
        )
        return tangential(inverse_length, adjoint(table, 0, degree, x, y, z, b, g, table, at, none), (x, y, z))

    return color_gradient
