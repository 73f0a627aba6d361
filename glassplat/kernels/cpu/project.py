"""Projection on the CPU: one pass over the Gaussians, every camera of the batch while a Gaussian is at hand.

Gaussians are taken in chunks of a fixed size, whatever the number of threads. Gradients that many Gaussians share (those
of the cameras) are summed per chunk and then over chunks in order, so that results do not depend on the threads.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import prange

from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.maths import screen_maths, shape_maths, vector_maths
from glassplat.kernels.maths_sh import color_maths

CHUNK = 512
"""Gaussians per task; part of the result's rounding, so not to be tuned per machine."""


class _Steps(NamedTuple):
    """The parts that forward and backward share.

    Attributes:
        vec3: row n of an array [N, 3] as a tuple.
        pose: rows of the upper 3x3 block of a camera matrix, and its translation.
        shape: (usable, opacity, unit quaternion, inverse norm, axes) of a Gaussian.
        view: what a camera sees of a Gaussian before its colour.
        lenses: per camera the tangent limits and the centre, [C, 7].
    """

    vec3: Callable[..., Any]
    pose: Callable[..., Any]
    shape: Callable[..., Any]
    view: Callable[..., Any]
    lenses: Callable[..., Any]


def _steps(real: type) -> _Steps:
    vec3, pose = _loads()
    return _Steps(vec3, pose, _shape(real), _view(real), _lenses(real))


def _loads() -> tuple[Callable[..., Any], Callable[..., Any]]:
    @inlined
    def vec3(array, n):
        return array[n, 0], array[n, 1], array[n, 2]

    @inlined
    def pose(cam_from_world, c):
        row_x = cam_from_world[c, 0, 0], cam_from_world[c, 0, 1], cam_from_world[c, 0, 2]
        row_y = cam_from_world[c, 1, 0], cam_from_world[c, 1, 1], cam_from_world[c, 1, 2]
        row_z = cam_from_world[c, 2, 0], cam_from_world[c, 2, 1], cam_from_world[c, 2, 2]
        return row_x, row_y, row_z, (cam_from_world[c, 0, 3], cam_from_world[c, 1, 3], cam_from_world[c, 2, 3])

    return vec3, pose


def _shape(real: type) -> Callable[..., Any]:
    sigmoid, is_finite, unit_quat, rotation, _ = shape_maths(real)
    zero = real(0.0)

    @inlined
    def shape(means, quats, log_scales, logit_opacities, n):
        quat, inverse_norm = unit_quat(quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3])
        column_x, column_y, column_z = rotation(quat)
        s_x, s_y, s_z = math.exp(log_scales[n, 0]), math.exp(log_scales[n, 1]), math.exp(log_scales[n, 2])
        axes = (
            (s_x * column_x[0], s_x * column_x[1], s_x * column_x[2]),
            (s_y * column_y[0], s_y * column_y[1], s_y * column_y[2]),
            (s_z * column_z[0], s_z * column_z[1], s_z * column_z[2]),
        )
        raw = abs(means[n, 0]) + abs(means[n, 1]) + abs(means[n, 2]) + abs(logit_opacities[n])
        raw += abs(log_scales[n, 0]) + abs(log_scales[n, 1]) + abs(log_scales[n, 2])
        usable = is_finite(raw) and inverse_norm > zero and is_finite(inverse_norm)
        return usable, sigmoid(logit_opacities[n]), quat, inverse_norm, axes

    return shape


def _lenses(real: type) -> Callable[..., Any]:
    tangent_limits, *_ = screen_maths(real)

    @inlined
    def lenses(cam_from_world, intrinsics, width, height):
        num_cameras = cam_from_world.shape[0]
        lens = np.empty((num_cameras, 7), real)
        for c in range(num_cameras):
            limits = tangent_limits(
                intrinsics[c, 0], intrinsics[c, 1], intrinsics[c, 2], intrinsics[c, 3], width, height
            )
            lens[c, 0], lens[c, 1], lens[c, 2], lens[c, 3] = limits
            for j in range(3):
                lens[c, 4 + j] = -(
                    cam_from_world[c, 0, j] * cam_from_world[c, 0, 3]
                    + cam_from_world[c, 1, j] * cam_from_world[c, 1, 3]
                    + cam_from_world[c, 2, j] * cam_from_world[c, 2, 3]
                )
        return lens

    return lenses


def _view(real: type) -> Callable[..., Any]:
    along = vector_maths().along
    _, clamped, footprint, screen_covariance, *_ = screen_maths(real)
    one = real(1.0)

    @inlined
    def view(rows, position, axes, intrinsics, lens, c):
        """Tangents, their clamped values, the footprint, the axes on screen and the covariance there."""
        inverse_depth = one / position[2]
        tangent_x, tangent_y = position[0] * inverse_depth, position[1] * inverse_depth
        held_x, held_y = clamped(tangent_x, lens[c, 0], lens[c, 1]), clamped(tangent_y, lens[c, 2], lens[c, 3])
        scale_x, scale_y = intrinsics[c, 0] * inverse_depth, intrinsics[c, 1] * inverse_depth
        w_x, w_y = footprint(rows[0], rows[1], rows[2], scale_x, scale_y, held_x, held_y)
        v_x, v_y = along(w_x, axes[0], axes[1], axes[2]), along(w_y, axes[0], axes[1], axes[2])
        return (tangent_x, tangent_y), (held_x, held_y), (w_x, w_y), (v_x, v_y), screen_covariance(v_x, v_y)

    return view


@cache
def project_forward(real: type) -> Kernel:
    """Fills means2d, conics, depths, opacities, colors and radii; zeros where a Gaussian is culled."""
    vec3, pose, shape, view, lenses = _steps(real)
    dot = vector_maths().dot
    half_extents = screen_maths(real).half_extents
    is_finite = shape_maths(real).is_finite
    color = color_maths(real).color
    zero, half, one = real(0.0), real(0.5), real(1.0)

    @inlined
    def color_of(sh, n, degree, mean, lens, c):
        if degree < 0:
            return zero, zero, zero
        x, y, z = mean[0] - lens[c, 4], mean[1] - lens[c, 5], mean[2] - lens[c, 6]
        shrink = one / math.sqrt(x * x + y * y + z * z)
        r, g, b = color(sh, n, degree, x * shrink, y * shrink, z * shrink)
        return r + half, g + half, b + half

    @inlined
    def cull(n, c, means2d, conics, depths, opacities, colors, radii):
        depths[c, n] = opacities[c, n] = zero
        means2d[c, n, 0] = means2d[c, n, 1] = radii[c, n, 0] = radii[c, n, 1] = zero
        for j in range(3):
            conics[c, n, j] = colors[c, n, j] = zero

    @kernel("project_forward", real)
    def forward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes,
        width, height, degree, near, means2d, conics, depths, opacities, colors, radii,
    ):  # fmt: skip
        count, num_cameras = means.shape[0], cam_from_world.shape[0]
        lens = lenses(cam_from_world, intrinsics, width, height)
        clips = clip_planes.shape[0] > 0
        for chunk in prange((count + CHUNK - 1) // CHUNK):
            for n in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                mean = vec3(means, n)
                usable, opacity, _, _, axes = shape(means, quats, log_scales, logit_opacities, n)
                for c in range(num_cameras):
                    cull(n, c, means2d, conics, depths, opacities, colors, radii)
                    row_x, row_y, row_z, offset = pose(cam_from_world, c)
                    depth = dot(row_z, mean) + offset[2]
                    if not (usable and depth > near):
                        continue
                    if clips and not dot(vec3(clip_planes, c), mean) + clip_planes[c, 3] > zero:
                        continue
                    position = dot(row_x, mean) + offset[0], dot(row_y, mean) + offset[1], depth
                    tangent, _, _, _, covariance = view((row_x, row_y, row_z), position, axes, intrinsics, lens, c)
                    xx, xy, yy, determinant = covariance
                    u = intrinsics[c, 0] * tangent[0] + intrinsics[c, 2]
                    v = intrinsics[c, 1] * tangent[1] + intrinsics[c, 3]
                    reach_x, reach_y = half_extents(xx, yy, opacity)
                    # Written so that NaN fails every comparison and the Gaussian stays culled.
                    on_screen = u + reach_x > zero and u - reach_x < width and v + reach_y > zero and v - reach_y < height
                    if not (on_screen and reach_x > zero and is_finite(determinant) and is_finite(depth)):
                        continue
                    red, green, blue = color_of(sh, n, degree, mean, lens, c)
                    if not is_finite(abs(red) + abs(green) + abs(blue)):
                        continue
                    means2d[c, n, 0], means2d[c, n, 1] = u, v
                    inverse = one / determinant
                    conics[c, n, 0], conics[c, n, 1], conics[c, n, 2] = yy * inverse, -xy * inverse, xx * inverse
                    depths[c, n], opacities[c, n] = depth, opacity
                    colors[c, n, 0], colors[c, n, 1], colors[c, n, 2] = max(red, zero), max(green, zero), max(blue, zero)
                    radii[c, n, 0], radii[c, n, 1] = reach_x, reach_y

    return forward


@cache
def project_backward(real: type) -> Kernel:
    """Fills the gradients of the Gaussians; adds those of the cameras to [C, 12], rows of (3x3 block, translation)."""
    vec3, pose, shape, view, lenses = _steps(real)
    vectors, screen = vector_maths(), screen_maths(real)
    dot, blend, scaled_sum = vectors.dot, vectors.blend, vectors.scaled_sum
    covariance_gradient, footprint_gradient = screen.covariance_gradient, screen.footprint_gradient
    unit_quat_gradient, rotation = shape_maths(real).unit_quat_gradient, shape_maths(real).rotation
    color, color_gradient = color_maths(real)
    zero, half, one = real(0.0), real(0.5), real(1.0)

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
        g_z = -inverse_depth * (
            dot(gw_x, w_x) + dot(gw_y, w_y) + g_tangent_x * tangent[0] + g_tangent_y * tangent[1]
        )
        g_position = inverse_depth * g_tangent_x, inverse_depth * g_tangent_y, g_z + g_depth
        g_row_x, g_row_y = blend(scale_x, gw_x, zero, gw_x), blend(scale_y, gw_y, zero, gw_y)
        g_row_z = blend(-scale_x * held[0], gw_x, -scale_y * held[1], gw_y)
        return g_position, (g_row_x, g_row_y, g_row_z), g_axes

    @inlined
    def add_camera_row(total, i, g_row, g_position, mean, g_view, translation):
        for_mean = blend(g_position, mean, translation, g_view)
        total[4 * i + 0] += np.float64(g_row[0] + for_mean[0])
        total[4 * i + 1] += np.float64(g_row[1] + for_mean[1])
        total[4 * i + 2] += np.float64(g_row[2] + for_mean[2])

    @inlined
    def view_gradient(sh, n, degree, mean, lens, c, g_color, g_sh):
        """Adds to g_sh[n]; returns the gradient of the vector from the camera centre to the mean."""
        if degree < 0:
            return zero, zero, zero
        x, y, z = mean[0] - lens[c, 4], mean[1] - lens[c, 5], mean[2] - lens[c, 6]
        shrink = one / math.sqrt(x * x + y * y + z * z)
        x, y, z = x * shrink, y * shrink, z * shrink
        red, green, blue = color(sh, n, degree, x, y, z)
        passed = (
            g_color[0] if red + half > zero else zero,
            g_color[1] if green + half > zero else zero,
            g_color[2] if blue + half > zero else zero,
        )
        gx, gy, gz = color_gradient(sh, n, degree, x, y, z, passed, g_sh)
        radial = gx * x + gy * y + gz * z
        return shrink * (gx - radial * x), shrink * (gy - radial * y), shrink * (gz - radial * z)

    @inlined
    def store_shape(n, opacity, quat, inverse_norm, axes, g_opacity, g_axes, g_quats, g_log_scales, g_logits):
        columns = rotation(quat)
        g_logits[n] = g_opacity * opacity * (one - opacity)
        g_log_scales[n, 0], g_log_scales[n, 1], g_log_scales[n, 2] = (
            dot(axes[0], g_axes[0]), dot(axes[1], g_axes[1]), dot(axes[2], g_axes[2])
        )  # fmt: skip
        s_x, s_y, s_z = dot(axes[0], columns[0]), dot(axes[1], columns[1]), dot(axes[2], columns[2])
        g_quat = unit_quat_gradient(
            quat, inverse_norm,
            blend(s_x, g_axes[0], zero, columns[0]),
            blend(s_y, g_axes[1], zero, columns[1]),
            blend(s_z, g_axes[2], zero, columns[2]),
        )  # fmt: skip
        g_quats[n, 0], g_quats[n, 1], g_quats[n, 2], g_quats[n, 3] = g_quat

    @kernel("project_backward", real)
    def backward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, width, height, degree, radii, conics,
        g_means2d, g_conics, g_depths, g_opacities, g_colors, needs_camera,
        g_means, g_quats, g_log_scales, g_logits, g_sh, g_cameras,
    ):  # fmt: skip
        count, num_cameras = means.shape[0], cam_from_world.shape[0]
        num_chunks = (count + CHUNK - 1) // CHUNK
        lens = lenses(cam_from_world, intrinsics, width, height)
        partial = np.zeros((num_chunks, num_cameras, 12))
        nothing = (zero, zero, zero)
        for chunk in prange(num_chunks):
            for n in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                g_sh[n] = zero
                g_mean, g_opacity = nothing, zero
                ga_x, ga_y, ga_z = nothing, nothing, nothing
                seen_at_all = False
                for c in range(num_cameras):
                    seen_at_all |= radii[c, n, 0] > zero
                if not seen_at_all:
                    g_logits[n] = zero
                    for j in range(3):
                        g_means[n, j] = g_log_scales[n, j] = zero
                    g_quats[n] = zero
                    continue
                mean = vec3(means, n)
                _, opacity, quat, inverse_norm, axes = shape(means, quats, log_scales, logit_opacities, n)
                for c in range(num_cameras):
                    if not radii[c, n, 0] > zero:
                        continue
                    rows_and_offset = pose(cam_from_world, c)
                    row_x, row_y, row_z, offset = rows_and_offset
                    rows = (row_x, row_y, row_z)
                    position = dot(row_x, mean) + offset[0], dot(row_y, mean) + offset[1], dot(row_z, mean) + offset[2]
                    seen = view(rows, position, axes, intrinsics, lens, c)
                    g_position, g_rows, g_axes = place_gradient(
                        rows, position, seen, axes, intrinsics, c, (g_means2d[c, n, 0], g_means2d[c, n, 1]),
                        vec3(g_conics[c], n), g_depths[c, n], vec3(conics[c], n),
                    )  # fmt: skip
                    g_view = view_gradient(sh, n, degree, mean, lens, c, vec3(g_colors[c], n), g_sh)
                    from_place = scaled_sum(g_position, row_x, row_y, row_z)
                    g_mean = (
                        g_mean[0] + from_place[0] + g_view[0],
                        g_mean[1] + from_place[1] + g_view[1],
                        g_mean[2] + from_place[2] + g_view[2],
                    )
                    ga_x, ga_y, ga_z = (
                        blend(one, ga_x, one, g_axes[0]), blend(one, ga_y, one, g_axes[1]), blend(one, ga_z, one, g_axes[2])
                    )  # fmt: skip
                    g_opacity += g_opacities[c, n]
                    if needs_camera:
                        # The centre is -A^T t: mean - centre = mean + A^T t, so row i also gets t_i g_view.
                        total = partial[chunk, c]
                        for_offset = dot(row_x, g_view), dot(row_y, g_view), dot(row_z, g_view)
                        add_camera_row(total, 0, g_rows[0], g_position[0], mean, g_view, offset[0])
                        add_camera_row(total, 1, g_rows[1], g_position[1], mean, g_view, offset[1])
                        add_camera_row(total, 2, g_rows[2], g_position[2], mean, g_view, offset[2])
                        total[3] += np.float64(g_position[0] + for_offset[0])
                        total[7] += np.float64(g_position[1] + for_offset[1])
                        total[11] += np.float64(g_position[2] + for_offset[2])
                g_means[n, 0], g_means[n, 1], g_means[n, 2] = g_mean
                store_shape(
                    n, opacity, quat, inverse_norm, axes, g_opacity, (ga_x, ga_y, ga_z), g_quats, g_log_scales, g_logits
                )
        for chunk in range(num_chunks):
            for c in range(num_cameras):
                for i in range(12):
                    g_cameras[c, i] += partial[chunk, c, i]

    return backward
