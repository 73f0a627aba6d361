"""The adjoint of the projection on the CPU, over the same chunks of Gaussians.

Gradients that many Gaussians share (those of the cameras) are summed per chunk and then over chunks in order, so that
results do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import prange

from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.maths.harmonics import color_maths
from glassplat.kernels.maths.projection import screen_maths, shape_maths, vector_maths
from glassplat.kernels.project.cpu_view import CHUNK, LENS_VALUES, view_steps


def place_gradients(real: type) -> Callable[..., Any]:
    """One Gaussian in one camera, without its colour."""
    dot, blend = vector_maths().dot, vector_maths().blend
    covariance_gradient, footprint_gradient = (
        screen_maths(real).covariance_gradient,
        screen_maths(real).footprint_gradient,
    )
    zero, one = real(0.0), real(1.0)

    @inlined
    def place_gradient(rows, position, seen, axes, intrinsics, c, g_mean2d, g_conic, g_depth, conic):
        """Gradients of the camera-space position, of the three rows (through the footprint) and of the axes."""
        tangent, held, (w_x, w_y), (v_x, v_y), _ = seen
        fx, fy, inverse_depth = intrinsics[c, 0], intrinsics[c, 1], one / position[2]
        scale_x, scale_y = fx * inverse_depth, fy * inverse_depth
        g_xx, g_xy, g_yy = covariance_gradient(conic[0], conic[1], conic[2], g_conic[0], g_conic[1], g_conic[2])
        gw_x, gw_y, g_axes = footprint_gradient(w_x, w_y, v_x, v_y, axes, g_xx, g_xy, g_yy)
        # w_x = (fx / z) (row_x - held_x row_z); where the tangent is held at its limit it passes no gradient.
        g_held_x = -scale_x * dot(gw_x, rows[2]) if held[0] == tangent[0] else zero
        g_held_y = -scale_y * dot(gw_y, rows[2]) if held[1] == tangent[1] else zero
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
    direction = view_steps(real).direction
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
        gx, gy, gz = color_gradient(sh, n, degree, x, y, z, passed, g_sh)
        radial = gx * x + gy * y + gz * z
        return (
            inverse_length * (gx - radial * x),
            inverse_length * (gy - radial * y),
            inverse_length * (gz - radial * z),
        )

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


def _color_backward(real: type) -> Callable[..., Any]:
    vec3 = view_steps(real).vec3
    blend = vector_maths().blend
    view_gradient, add_view = view_gradients(real), camera_sums(real)[1]
    zero, one = real(0.0), real(1.0)

    @inlined
    def color_backward(n, means, sh, cam_from_world, lens, degree, radii, g_colors, needs_camera, total, g_means, g_sh):
        """Adds to g_sh[n], and to g_means[n] what comes through the direction of view."""
        mean, g_mean, touched = vec3(means, n), (zero, zero, zero), False
        for c in range(cam_from_world.shape[0] if degree >= 0 else 0):
            g_color = vec3(g_colors[c], n)
            # A Gaussian that no pixel saw, as behind others, has nothing to pass on.
            idle = g_color[0] == zero and g_color[1] == zero and g_color[2] == zero
            if idle or not radii[c, n, 0] > zero:
                continue
            touched = True
            g_view = view_gradient(sh, n, degree, mean, lens, c, g_color, g_sh)
            g_mean = blend(one, g_mean, one, g_view)
            if needs_camera:
                add_view(total[c], cam_from_world, c, g_view)
        if touched:
            add_mean(g_means, n, g_mean)

    return color_backward


def _place_backward(real: type) -> Callable[..., Any]:
    vec3, pose, shape, view, *_ = view_steps(real)
    dot, blend, scaled_sum = vector_maths().dot, vector_maths().blend, vector_maths().scaled_sum
    place_gradient, add_shape_gradient, add_place = (
        place_gradients(real),
        shape_gradients(real),
        camera_sums(real)[0],
    )
    zero, one = real(0.0), real(1.0)

    @inlined
    def place_backward(
        n, means, quats, log_scales, logit_opacities, cam_from_world, intrinsics, lens, radii, conics,
        g_means2d, g_conics, g_depths, g_opacities, needs_camera, total,
        g_means, g_quats, g_log_scales, g_logit_opacities,
    ):  # fmt: skip
        """Adds to all gradients but that of the colour."""
        touched = False
        for c in range(cam_from_world.shape[0]):
            touched |= radii[c, n, 0] > zero
        if not touched:
            return
        mean, g_mean = vec3(means, n), (zero, zero, zero)
        _, opacity, quat, inverse_norm, axes = shape(means, quats, log_scales, logit_opacities, n)
        g_opacity, ga_x, ga_y, ga_z = zero, (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        for c in range(cam_from_world.shape[0]):
            if not radii[c, n, 0] > zero:
                continue
            row_x, row_y, row_z, offset = pose(cam_from_world, c)
            rows = (row_x, row_y, row_z)
            position = dot(row_x, mean) + offset[0], dot(row_y, mean) + offset[1], dot(row_z, mean) + offset[2]
            seen = view(rows, position, axes, intrinsics, lens, c)
            g_position, g_rows, g_axes = place_gradient(
                rows, position, seen, axes, intrinsics, c, (g_means2d[c, n, 0], g_means2d[c, n, 1]),
                vec3(g_conics[c], n), g_depths[c, n], vec3(conics[c], n),
            )  # fmt: skip
            g_mean = blend(one, g_mean, one, scaled_sum(g_position, row_x, row_y, row_z))
            ga_x, ga_y = blend(one, ga_x, one, g_axes[0]), blend(one, ga_y, one, g_axes[1])
            ga_z = blend(one, ga_z, one, g_axes[2])
            g_opacity += g_opacities[c, n]
            if needs_camera:
                add_place(total[c], g_rows, g_position, mean)
        add_mean(g_means, n, g_mean)
        add_shape_gradient(
            n, opacity, quat, inverse_norm, axes, g_opacity, (ga_x, ga_y, ga_z),
            g_quats, g_log_scales, g_logit_opacities,
        )  # fmt: skip

    return place_backward


@cache
def project_backward(real: type) -> Kernel:
    """Adds to the gradients of the Gaussians, or fills them where they are `fresh`, and adds to those of the cameras.

    These are [C, 12], rows of (3x3 block, translation).
    """
    fill_lenses = view_steps(real).fill_lenses
    color_backward, place_backward = _color_backward(real), _place_backward(real)
    chunk_size, zero = CHUNK, real(0.0)

    @kernel("project_backward", real)
    def backward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, width, height, degree, radii, conics,
        g_means2d, g_conics, g_depths, g_opacities, g_colors, needs_camera, fresh,
        g_means, g_quats, g_log_scales, g_logit_opacities, g_sh, g_cameras,
    ):  # fmt: skip
        count, num_cameras = means.shape[0], cam_from_world.shape[0]
        num_chunks = (count + chunk_size - 1) // chunk_size
        lens = np.empty((num_cameras, LENS_VALUES), real)
        fill_lenses(lens, cam_from_world, intrinsics, width, height)
        totals = np.zeros((num_chunks, num_cameras, 12))
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            begin, end = chunk * chunk_size, min(count, (chunk + 1) * chunk_size)
            if fresh:
                g_means[begin:end], g_quats[begin:end], g_log_scales[begin:end] = zero, zero, zero
                g_logit_opacities[begin:end], g_sh[begin:end] = zero, zero
            for n in range(begin, end):
                color_backward(
                    n, means, sh, cam_from_world, lens, degree, radii, g_colors, needs_camera, totals[chunk],
                    g_means, g_sh,
                )  # fmt: skip
            for n in range(begin, end):
                place_backward(
                    n, means, quats, log_scales, logit_opacities, cam_from_world, intrinsics, lens, radii, conics,
                    g_means2d, g_conics, g_depths, g_opacities, needs_camera, totals[chunk],
                    g_means, g_quats, g_log_scales, g_logit_opacities,
                )  # fmt: skip
        for chunk in range(num_chunks):
            for c in range(num_cameras):
                for i in range(12):
                    g_cameras[c, i] += totals[chunk, c, i]

    return backward
