"""Projection of one disc into one camera, shared by the kernels for CPU and GPU."""

from __future__ import annotations

import math

import numpy as np

from glassplat.kernels.backend.cpu import ONE, ZERO, inlined
from glassplat.kernels.maths import disc, projection
from glassplat.kernels.maths.blending import ALPHA_MIN, Scalar
from glassplat.kernels.maths.disc import MAP
from glassplat.kernels.maths.projection import combine, cross, dot, dot_products, is_finite, rotation, scaled_sum
from glassplat.kernels.project.steps import Footprint, in_camera


def _shape(real: type) -> Scalar:
    sigmoid, unit_quat = projection.build_sigmoid(real), projection.build_unit_quat(real)
    zero, most = real(0.0), real(disc.MOST_LOG_SCALE)

    @inlined
    def shape(means, quats, log_scales, logit_opacities, n):
        quat, inverse_norm = unit_quat(quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3])
        raw = abs(means[n, 0]) + abs(means[n, 1]) + abs(means[n, 2]) + abs(logit_opacities[n])
        usable = is_finite(raw) and inverse_norm > zero and is_finite(inverse_norm)
        usable = usable and abs(log_scales[n, 0]) <= most and abs(log_scales[n, 1]) <= most
        deviations = real(math.exp(log_scales[n, 0])), real(math.exp(log_scales[n, 1]))
        return usable, sigmoid(logit_opacities[n]), quat, inverse_norm, rotation(quat), deviations

    return shape


@inlined
def cull(c, n, outputs):
    """Writes zeros for one disc in one camera."""
    means2d, maps, depths, opacities, colors, normals, centers, conics, radii = outputs
    depths[c, n] = opacities[c, n] = 0
    for j in range(2):
        means2d[c, n, j] = centers[c, n, j] = radii[c, n, j] = 0
    for j in range(3):
        colors[c, n, j] = normals[c, n, j] = conics[c, n, j] = 0
    for j in range(MAP):
        maps[c, n, j] = 0


@inlined
def facing_sign(axis, mean, lens, c):
    """1 if a disc's axis points to the camera, else -1."""
    back = lens[c, 4] - mean[0], lens[c, 5] - mean[1], lens[c, 6] - mean[2]
    return -ONE if dot(back, axis) < ZERO else ONE


def _place(real: type) -> Scalar:
    is_not_edge_on, one, alpha_min = disc.build_is_not_edge_on(real), real(1.0), real(ALPHA_MIN)

    @inlined
    def place(c, n, mean, shaped, cam_from_world, intrinsics, lens, windows, size, near, outputs):
        _, opacity, _, _, axes, deviations = shaped
        means2d, maps, depths, opacities, _, normals, centers, conics, radii = outputs
        rows, m = in_camera(cam_from_world, c, mean)
        p, q = dot_products(axes[0], rows), dot_products(axes[1], rows)
        across = cross(p, q)
        if not (is_not_edge_on(across, m) and opacity > alpha_min and is_finite(m[2])):
            return
        fx, fy = intrinsics[c, 0], intrinsics[c, 1]
        found = disc.pixel_map(p, q, across, m, one / deviations[0], one / deviations[1], fx, fy)
        total = abs(found[0]) + abs(found[1]) + abs(found[2]) + abs(found[3]) + abs(found[4]) + abs(found[5])
        if not is_finite(total):
            return
        slope_u, slope_v = np.float64(p[2] * deviations[0]), np.float64(q[2] * deviations[1])
        nearest = np.float64(m[2]) - math.sqrt(disc.reach(opacity) * (slope_u * slope_u + slope_v * slope_v))
        dx, dy, xx, xy, yy, wide, high = disc.outline(found, opacity, nearest, np.float64(near), size[0], size[1])
        u, v = fx * m[0] / m[2] + intrinsics[c, 2], fy * m[1] / m[2] + intrinsics[c, 3]
        x, y = u + real(dx), v + real(dy)
        left, right, top, bottom = x - real(wide), x + real(wide), y - real(high), y + real(high)
        if xx == 0.0:
            reached = disc.crossing_box(m, p, q, deviations, disc.reach(opacity), np.float64(near), fx, fy)
            left, right = real(reached[0]) + intrinsics[c, 2], real(reached[1]) + intrinsics[c, 2]
            top, bottom = real(reached[2]) + intrinsics[c, 3], real(reached[3]) + intrinsics[c, 3]
        # Written so that NaN fails every comparison and the disc stays culled.
        across_window = right > windows[c, 0] and left < windows[c, 2]
        down_window = bottom > windows[c, 1] and top < windows[c, 3]
        if not (across_window and down_window and is_finite(u) and is_finite(v)):
            return
        side = facing_sign(axes[2], mean, lens, c)
        means2d[c, n, 0], means2d[c, n, 1], depths[c, n], opacities[c, n] = u, v, m[2], opacity
        centers[c, n, 0], centers[c, n, 1], radii[c, n, 0], radii[c, n, 1] = x, y, real(wide), real(high)
        conics[c, n, 0], conics[c, n, 1], conics[c, n, 2] = real(xx), real(xy), real(yy)
        for j in range(3):
            normals[c, n, j] = side * axes[2][j]
        maps[c, n, 0], maps[c, n, 1], maps[c, n, 2] = found[0], found[1], found[2]
        maps[c, n, 3], maps[c, n, 4], maps[c, n, 5] = found[3], found[4], found[5]

    return place


@inlined
def disc_map(array, c, n):
    """The map of a disc in a camera, or its gradient."""
    return array[c, n, 0], array[c, n, 1], array[c, n, 2], array[c, n, 3], array[c, n, 4], array[c, n, 5]


@inlined
def place_gradient(c, n, mean, shaped, cam_from_world, intrinsics, lens, maps, cotangents):
    """As in `Footprint`."""
    g_means2d, g_maps, g_depths, _, _, g_normals = cotangents
    axes, deviations = shaped[4], shaped[5]
    rows, m = in_camera(cam_from_world, c, mean)
    p, q = dot_products(axes[0], rows), dot_products(axes[1], rows)
    across = cross(p, q)
    fx, fy, inverse = intrinsics[c, 0], intrinsics[c, 1], ONE / m[2]
    found, g_map = disc_map(maps, c, n), disc_map(g_maps, c, n)
    g_p, g_q, g_m, g_u, g_v = disc.map_gradient(
        p, q, m, across, found, ONE / deviations[0], ONE / deviations[1], fx, fy, g_map
    )
    g_x, g_y = g_means2d[c, n, 0] * fx * inverse, g_means2d[c, n, 1] * fy * inverse
    behind = (g_x * m[0] + g_y * m[1]) * inverse
    g_center = g_m[0] + g_x, g_m[1] + g_y, g_m[2] + g_depths[c, n] - behind
    side = facing_sign(axes[2], mean, lens, c)
    g_axes = (
        scaled_sum(g_p, rows),
        scaled_sum(g_q, rows),
        (side * g_normals[c, n, 0], side * g_normals[c, n, 1], side * g_normals[c, n, 2]),
    )
    g_rows = (
        combine(g_p[0], axes[0], g_q[0], axes[1]),
        combine(g_p[1], axes[0], g_q[1], axes[1]),
        combine(g_p[2], axes[0], g_q[2], axes[1]),
    )
    return g_center, g_rows, g_axes, (g_u, g_v)


@inlined
def finish(n, shaped, sums, g_means, g_quats, g_log_scales, g_logit_opacities):
    """As in `Footprint`."""
    _, opacity, quat, inverse_norm, _, _ = shaped
    g_mean, g_opacity, g_axes, g_scales = sums
    g_means[n, 0], g_means[n, 1], g_means[n, 2] = g_mean
    g_logit_opacities[n] = g_opacity * opacity * (ONE - opacity)
    g_log_scales[n, 0], g_log_scales[n, 1] = g_scales
    g_w, g_i, g_j, g_k = projection.unit_quat_gradient(quat, inverse_norm, g_axes)
    g_quats[n, 0], g_quats[n, 1], g_quats[n, 2], g_quats[n, 3] = g_w, g_i, g_j, g_k


def discs(real: type) -> Footprint:
    """Builds the footprint of discs for CPU or GPU; their `shape` returns two deviations as its last entry."""
    return Footprint(_shape(real), cull, _place(real), place_gradient, finish)
