"""Steps of the adjoint of the projection, of one Gaussian: for discs and for the GPU; some of them of vectors too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.maths.harmonics import color_maths
from glassplat.kernels.maths.projection import screen_maths, shape_maths, vector_maths
from glassplat.kernels.project.cpu_view import view_steps


def place_gradients(real: type, free: Callable[..., Any] | None = None) -> Callable[..., Any]:
    """One Gaussian in one camera, without its colour; or vectors of them.

    Of vectors, `free(x, held, tangent)` is x where a tangent is not held at a limit, and 0 elsewhere.
    """
    dot, blend = vector_maths().dot, vector_maths().blend
    covariance_gradient, footprint_gradient = (
        screen_maths(real).covariance_gradient,
        screen_maths(real).footprint_gradient,
    )
    zero, one = real(0.0), real(1.0)

    @inlined
    def free_number(x, held, tangent):
        return x if held == tangent else zero

    free = free_number if free is None else free

    @inlined
    def place_gradient(rows, position, seen, axes, intrinsics, c, g_mean2d, g_conic, g_depth, conic):
        """Gradients of the camera-space position, of the three rows (through the footprint) and of the axes."""
        tangent, held, (w_x, w_y), (v_x, v_y), _ = seen
        fx, fy, inverse_depth = intrinsics[c, 0], intrinsics[c, 1], one / position[2]
        scale_x, scale_y = fx * inverse_depth, fy * inverse_depth
        g_xx, g_xy, g_yy = covariance_gradient(conic[0], conic[1], conic[2], g_conic[0], g_conic[1], g_conic[2])
        gw_x, gw_y, g_axes = footprint_gradient(w_x, w_y, v_x, v_y, axes, g_xx, g_xy, g_yy)
        # w_x = (fx / z) (row_x - held_x row_z); where the tangent is held at its limit it passes no gradient.
        g_held_x = free(-scale_x * dot(gw_x, rows[2]), held[0], tangent[0])
        g_held_y = free(-scale_y * dot(gw_y, rows[2]), held[1], tangent[1])
        g_tangent_x, g_tangent_y = fx * g_mean2d[0] + g_held_x, fy * g_mean2d[1] + g_held_y
        g_log_depth = dot(gw_x, w_x) + dot(gw_y, w_y) + g_tangent_x * tangent[0] + g_tangent_y * tangent[1]
        g_position = inverse_depth * g_tangent_x, inverse_depth * g_tangent_y, g_depth - inverse_depth * g_log_depth
        g_row_x, g_row_y = blend(scale_x, gw_x, zero, gw_x), blend(scale_y, gw_y, zero, gw_y)
        g_row_z = blend(-scale_x * held[0], gw_x, -scale_y * held[1], gw_y)
        return g_position, (g_row_x, g_row_y, g_row_z), g_axes

    return place_gradient


def camera_sums(real: type) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Adding to a camera's gradient [12], rows of (3x3 block, translation), in double precision."""
    dot, blend = vector_maths().dot, vector_maths().blend
    one = real(1.0)

    @inlined
    def add_place(total, g_rows, g_position, mean):
        for i in range(3):
            g_row = g_rows[0] if i == 0 else (g_rows[1] if i == 1 else g_rows[2])
            g_i = g_position[0] if i == 0 else (g_position[1] if i == 1 else g_position[2])
            from_row = blend(one, g_row, g_i, mean)
            total[4 * i + 0] += np.float64(from_row[0])
            total[4 * i + 1] += np.float64(from_row[1])
            total[4 * i + 2] += np.float64(from_row[2])
            total[4 * i + 3] += np.float64(g_i)

    @inlined
    def add_view(total, cam_from_world, c, g_view):
        # The centre is -A^T t: with mean - centre = mean + A^T t, row i gets t_i g_view and t_i gets row_i . g_view.
        for i in range(3):
            row = cam_from_world[c, i, 0], cam_from_world[c, i, 1], cam_from_world[c, i, 2]
            translation = cam_from_world[c, i, 3]
            total[4 * i + 0] += np.float64(translation * g_view[0])
            total[4 * i + 1] += np.float64(translation * g_view[1])
            total[4 * i + 2] += np.float64(translation * g_view[2])
            total[4 * i + 3] += np.float64(dot(row, g_view))

    return add_place, add_view


def view_gradients(real: type) -> Callable[..., Any]:
    """The colour of one Gaussian in one camera."""
    direction, tangential = view_steps(real).direction, vector_maths().tangential
    color, color_gradient = color_maths(real)
    zero, half = real(0.0), real(0.5)

    @inlined
    def view_gradient(sh, n, degree, mean, lens, c, g_color, g_sh):
        """Adds to g_sh[n]; returns the gradient of the vector from the camera centre to the mean."""
        (x, y, z), inverse_length = direction(mean, lens, c)
        red, green, blue = color(sh, n, degree, x, y, z)
        passed = (
            g_color[0] if red + half > zero else zero,
            g_color[1] if green + half > zero else zero,
            g_color[2] if blue + half > zero else zero,
        )
        return tangential(inverse_length, color_gradient(sh, n, degree, x, y, z, passed, g_sh), (x, y, z))

    return view_gradient


def shape_gradients(real: type) -> Callable[..., Any]:
    """From the gradients of opacity and axes to those of the raw parameters."""
    dot, blend = vector_maths().dot, vector_maths().blend
    maths = shape_maths(real)
    rotation, unit_quat_gradient = maths.rotation, maths.unit_quat_gradient
    zero, one = real(0.0), real(1.0)

    @inlined
    def add_shape_gradient(
        n, opacity, quat, inverse_norm, axes, g_opacity, g_axes, g_quats, g_log_scales, g_logit_opacities
    ):
        x, y, z = rotation(quat)
        g_logit_opacities[n] += g_opacity * opacity * (one - opacity)
        g_log_scales[n, 0] += dot(axes[0], g_axes[0])
        g_log_scales[n, 1] += dot(axes[1], g_axes[1])
        g_log_scales[n, 2] += dot(axes[2], g_axes[2])
        g_x, g_y, g_z = (
            blend(dot(axes[0], x), g_axes[0], zero, x),
            blend(dot(axes[1], y), g_axes[1], zero, y),
            blend(dot(axes[2], z), g_axes[2], zero, z),
        )
        g_w, g_i, g_j, g_k = unit_quat_gradient(quat, inverse_norm, g_x, g_y, g_z)
        g_quats[n, 0] += g_w
        g_quats[n, 1] += g_i
        g_quats[n, 2] += g_j
        g_quats[n, 3] += g_k

    return add_shape_gradient


@inlined
def add_mean(g_means, n, g_mean):
    """Adds to row n of the gradient of the means."""
    g_means[n, 0] += g_mean[0]
    g_means[n, 1] += g_mean[1]
    g_means[n, 2] += g_mean[2]
