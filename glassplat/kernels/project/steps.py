"""Projection of one Gaussian into one camera, with its gradients, shared by the kernels."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from glassplat.kernels.backend.cpu import ONE, ZERO, inlined
from glassplat.kernels.maths import projection
from glassplat.kernels.maths.blending import ALPHA_MIN, Scalar
from glassplat.kernels.maths.harmonics import color_maths
from glassplat.kernels.maths.projection import combine, dot, dot_products, rotation, scaled, scaled_columns, scaled_sum

CHUNK = 512
"""Gaussians per task; affects the rounding of results, so do not tune it per machine."""
LENS_VALUES = 9
"""Tangent limits (4), camera centre (3), and maximum stretch of a sphere's footprint along x and y (2)."""


@inlined
def vec3(array, n):
    """Row n of an array [N, 3] as a tuple."""
    return array[n, 0], array[n, 1], array[n, 2]


@inlined
def rows_of(cam_from_world, c):
    """Rows of the upper 3x3 block of a camera matrix."""
    return (
        (cam_from_world[c, 0, 0], cam_from_world[c, 0, 1], cam_from_world[c, 0, 2]),
        (cam_from_world[c, 1, 0], cam_from_world[c, 1, 1], cam_from_world[c, 1, 2]),
        (cam_from_world[c, 2, 0], cam_from_world[c, 2, 1], cam_from_world[c, 2, 2]),
    )


@inlined
def in_camera(cam_from_world, c, mean):
    """Those rows, and a point in the frame of the camera."""
    rows = rows_of(cam_from_world, c)
    x, y, z = dot_products(mean, rows)
    return rows, (x + cam_from_world[c, 0, 3], y + cam_from_world[c, 1, 3], z + cam_from_world[c, 2, 3])


def build_shape(real: type) -> Scalar:
    """Builds (usable, opacity, unit quaternion, inverse norm, axes) of an ellipsoid."""
    sigmoid, unit_quat, zero = projection.build_sigmoid(real), projection.build_unit_quat(real), real(0.0)

    @inlined
    def shape(means, quats, log_scales, logit_opacities, n):
        quat, inverse_norm = unit_quat(quats[n, 0], quats[n, 1], quats[n, 2], quats[n, 3])
        scales = math.exp(log_scales[n, 0]), math.exp(log_scales[n, 1]), math.exp(log_scales[n, 2])
        raw = abs(means[n, 0]) + abs(means[n, 1]) + abs(means[n, 2]) + abs(logit_opacities[n])
        raw += abs(log_scales[n, 0]) + abs(log_scales[n, 1]) + abs(log_scales[n, 2])
        usable = projection.is_finite(raw) and inverse_norm > zero and projection.is_finite(inverse_norm)
        return usable, sigmoid(logit_opacities[n]), quat, inverse_norm, scaled_columns(scales, rotation(quat))

    return shape


def build_fill_lenses(real: type) -> Scalar:
    """Builds the step that writes `LENS_VALUES` numbers per camera."""
    tangent_limits, one = projection.build_tangent_limits(real), real(1.0)

    @inlined
    def skewed(row, row_z, tangent):
        """Length of a unit sphere's footprint in multiples of focal length over depth."""
        w = combine(one, row, -tangent, row_z)
        return math.sqrt(dot(w, w))

    @inlined
    def fill_lenses(lens, cam_from_world, intrinsics, width, height):
        num_cameras = cam_from_world.shape[0]
        for c in range(num_cameras):
            limits = tangent_limits(
                intrinsics[c, 0], intrinsics[c, 1], intrinsics[c, 2], intrinsics[c, 3], width, height
            )
            lens[c, 0], lens[c, 1], lens[c, 2], lens[c, 3] = limits
            # A footprint's length is convex in the tangent, so its maximum is at one of the limits.
            row_x, row_y, row_z = rows_of(cam_from_world, c)
            lens[c, 7] = max(skewed(row_x, row_z, limits[0]), skewed(row_x, row_z, limits[1]))
            lens[c, 8] = max(skewed(row_y, row_z, limits[2]), skewed(row_y, row_z, limits[3]))
            for j in range(3):
                lens[c, 4 + j] = -(
                    cam_from_world[c, 0, j] * cam_from_world[c, 0, 3]
                    + cam_from_world[c, 1, j] * cam_from_world[c, 1, 3]
                    + cam_from_world[c, 2, j] * cam_from_world[c, 2, 3]
                )

    return fill_lenses


def build_direction(real: type) -> Scalar:
    """Builds the unit vector from a camera's centre to a mean, and its inverse length."""
    one = real(1.0)

    @inlined
    def direction(mean, lens, c):
        x, y, z = mean[0] - lens[c, 4], mean[1] - lens[c, 5], mean[2] - lens[c, 6]
        inverse_length = one / math.sqrt(x * x + y * y + z * z)
        return (x * inverse_length, y * inverse_length, z * inverse_length), inverse_length

    return direction


def build_view(real: type, clamped: Scalar) -> Scalar:
    """Builds `view` for scalars or vectors, given the function that clamps them."""
    screen_covariance, one = projection.build_screen_covariance(real), real(1.0)

    @inlined
    def view(rows, position, axes, intrinsics, lens, c):
        """Tangents, their clamped values, the footprint, and the axes and covariance in screen space."""
        inverse_depth = one / position[2]
        tangent_x, tangent_y = position[0] * inverse_depth, position[1] * inverse_depth
        held_x, held_y = clamped(tangent_x, lens[c, 0], lens[c, 1]), clamped(tangent_y, lens[c, 2], lens[c, 3])
        scale_x, scale_y = intrinsics[c, 0] * inverse_depth, intrinsics[c, 1] * inverse_depth
        w_x, w_y = projection.footprint(rows, scale_x, scale_y, held_x, held_y)
        v_x, v_y = dot_products(w_x, axes), dot_products(w_y, axes)
        return (tangent_x, tangent_y), (held_x, held_y), (w_x, w_y), (v_x, v_y), screen_covariance(v_x, v_y)

    return view


MOST_SQUARED_DEVIATIONS = 1.01 * 2.0 * math.log(1.0 / ALPHA_MIN)
"""Squared number of standard deviations at which even full opacity falls to `ALPHA_MIN`, plus one percent."""


def build_place(real: type) -> Scalar:
    """Builds `place` for ellipsoids: if one is visible in a camera, fills all its outputs but the colour."""
    view, half_extents = build_view(real, projection.clamp), projection.build_half_extents(real)
    zero, one = real(0.0), real(1.0)

    @inlined
    def place(c, n, mean, shaped, cam_from_world, intrinsics, lens, windows, size, near, outputs):
        means2d, conics, depths, opacities, _, radii = outputs
        _, opacity, _, _, axes = shaped
        rows, position = in_camera(cam_from_world, c, mean)
        depth = position[2]
        tangent, _, _, _, covariance = view(rows, position, axes, intrinsics, lens, c)
        xx, xy, yy, determinant = covariance
        u = intrinsics[c, 0] * tangent[0] + intrinsics[c, 2]
        v = intrinsics[c, 1] * tangent[1] + intrinsics[c, 3]
        reach_x, reach_y = half_extents(xx, yy, opacity)
        # Written so that NaN fails every comparison and the Gaussian stays culled.
        across = u + reach_x > windows[c, 0] and u - reach_x < windows[c, 2]
        down = v + reach_y > windows[c, 1] and v - reach_y < windows[c, 3]
        if across and down and reach_x > zero and projection.is_finite(determinant) and projection.is_finite(depth):
            inverse = one / determinant
            means2d[c, n, 0], means2d[c, n, 1] = u, v
            conics[c, n, 0], conics[c, n, 1], conics[c, n, 2] = yy * inverse, -xy * inverse, xx * inverse
            depths[c, n], opacities[c, n] = depth, opacity
            radii[c, n, 0], radii[c, n, 1] = reach_x, reach_y

    return place


@inlined
def cull(c, n, outputs):
    """Writes zeros for one ellipsoid in one camera."""
    means2d, conics, depths, opacities, colors, radii = outputs
    depths[c, n] = opacities[c, n] = 0
    for j in range(2):
        means2d[c, n, j] = radii[c, n, j] = 0
    for j in range(3):
        conics[c, n, j] = colors[c, n, j] = 0


@inlined
def in_front(c, mean, cam_from_world, near, clip_planes, clips):
    """Return whether a point is beyond the near plane and on the kept side of the clip plane, if there is one."""
    row_z = cam_from_world[c, 2, 0], cam_from_world[c, 2, 1], cam_from_world[c, 2, 2]
    if not dot(row_z, mean) + cam_from_world[c, 2, 3] > near:
        return False
    return not clips or dot(vec3(clip_planes, c), mean) + clip_planes[c, 3] > ZERO


def place_gradients(real: type, free: Scalar | None = None) -> Scalar:
    """Builds the gradient of one Gaussian in one camera, without its colour, for scalars or vectors.

    For vectors, `free(x, held, tangent)` is x where a tangent is not clamped to a limit, and 0 elsewhere.
    """
    covariance_gradient, zero, one = projection.build_covariance_gradient(real), real(0.0), real(1.0)

    @inlined
    def free_number(x, held, tangent):
        return x if held == tangent else zero

    free = free_number if free is None else free

    @inlined
    def place_gradient(rows, position, seen, axes, intrinsics, c, g_mean2d, g_conic, g_depth):
        """Gradients of the camera-space position, of the three rows (through the footprint) and of the axes."""
        tangent, held, (w_x, w_y), (v_x, v_y), covariance = seen
        fx, fy, inverse_depth = intrinsics[c, 0], intrinsics[c, 1], one / position[2]
        scale_x, scale_y = fx * inverse_depth, fy * inverse_depth
        g_covariance = covariance_gradient(covariance, g_conic[0], g_conic[1], g_conic[2])
        gw_x, gw_y, g_axes = projection.footprint_gradient(w_x, w_y, v_x, v_y, axes, g_covariance)
        # w_x = (fx / z) (row_x - held_x row_z); a tangent clamped to its limit passes no gradient.
        g_held_x = free(-scale_x * dot(gw_x, rows[2]), held[0], tangent[0])
        g_held_y = free(-scale_y * dot(gw_y, rows[2]), held[1], tangent[1])
        g_tangent_x, g_tangent_y = fx * g_mean2d[0] + g_held_x, fy * g_mean2d[1] + g_held_y
        g_log_depth = dot(gw_x, w_x) + dot(gw_y, w_y) + g_tangent_x * tangent[0] + g_tangent_y * tangent[1]
        g_position = inverse_depth * g_tangent_x, inverse_depth * g_tangent_y, g_depth - inverse_depth * g_log_depth
        g_row_z = combine(-scale_x * held[0], gw_x, -scale_y * held[1], gw_y)
        return g_position, (scaled(scale_x, gw_x), scaled(scale_y, gw_y), g_row_z), g_axes

    return place_gradient


@inlined
def add_place(total, g_rows, g_position, mean):
    """Adds to a camera's gradient [12], rows of (3x3 block, translation), in double precision."""
    for i in range(3):
        g_row = g_rows[0] if i == 0 else (g_rows[1] if i == 1 else g_rows[2])
        g_i = g_position[0] if i == 0 else (g_position[1] if i == 1 else g_position[2])
        from_row = combine(ONE, g_row, g_i, mean)
        total[4 * i + 0] += np.float64(from_row[0])
        total[4 * i + 1] += np.float64(from_row[1])
        total[4 * i + 2] += np.float64(from_row[2])
        total[4 * i + 3] += np.float64(g_i)


@inlined
def add_view(total, cam_from_world, c, g_view):
    """Adds the contribution of a colour, through the camera's centre."""
    # The centre is -A^T t: with mean - centre = mean + A^T t, row i gets t_i g_view and t_i gets row_i . g_view.
    for i in range(3):
        row = cam_from_world[c, i, 0], cam_from_world[c, i, 1], cam_from_world[c, i, 2]
        translation = cam_from_world[c, i, 3]
        total[4 * i + 0] += np.float64(translation * g_view[0])
        total[4 * i + 1] += np.float64(translation * g_view[1])
        total[4 * i + 2] += np.float64(translation * g_view[2])
        total[4 * i + 3] += np.float64(dot(row, g_view))


def view_gradients(real: type) -> Scalar:
    """Builds the gradient of the colour of one Gaussian in one camera."""
    direction, (color, color_gradient) = build_direction(real), color_maths(real)
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
        return projection.tangential(inverse_length, color_gradient(sh, n, degree, x, y, z, passed, g_sh), (x, y, z))

    return view_gradient


class Footprint(NamedTuple):
    """The steps in which the projections of ellipsoids and discs differ.

    Inputs are raw Gaussians, poses, intrinsics, clip planes and windows. The first five outputs and cotangents are
    centres, conics or maps, depths, opacities and colours; the last output is the radii.

    Attributes:
        shape: (usable, opacity, unit quaternion, inverse norm, axes, ...) of a Gaussian.
        cull: writes zeros for one Gaussian in one camera.
        place: fills all outputs but the colour if the Gaussian is visible; otherwise its radii stay zero.
        place_gradient: gradients of (the centre in camera space, the rows of the pose without the centre's part, the
            three axes, two log scales).
        finish: writes the gradients of a Gaussian, except those of its coefficients, given those of (mean, opacity,
            axes, two log scales).
    """

    shape: Scalar
    cull: Scalar
    place: Scalar
    place_gradient: Scalar
    finish: Scalar


def ellipsoids(real: type) -> Footprint:
    """Builds the footprint of ellipsoids, for one at a time."""
    return Footprint(build_shape(real), cull, build_place(real), _ellipsoid_gradient(real), finish_ellipsoid)


def _ellipsoid_gradient(real: type) -> Scalar:
    view, placed, zero = build_view(real, projection.clamp), place_gradients(real), real(0.0)

    @inlined
    def place_gradient(c, n, mean, shaped, cam_from_world, intrinsics, lens, maps, cotangents):
        g_means2d, g_conics, g_depths, _, _ = cotangents
        axes = shaped[4]
        rows, position = in_camera(cam_from_world, c, mean)
        g_position, g_rows, g_axes = placed(
            rows, position, view(rows, position, axes, intrinsics, lens, c), axes, intrinsics, c,
            (g_means2d[c, n, 0], g_means2d[c, n, 1]), (g_conics[c, n, 0], g_conics[c, n, 1], g_conics[c, n, 2]),
            g_depths[c, n],
        )  # fmt: skip
        return g_position, g_rows, g_axes, (zero, zero)

    return place_gradient


@inlined
def finish_ellipsoid(n, shaped, sums, g_means, g_quats, g_log_scales, g_logit_opacities):
    """Adds, because projections of the same Gaussians may share their gradients."""
    _, opacity, quat, inverse_norm, axes = shaped
    g_mean, g_opacity, g_axes, _ = sums
    x, y, z = rotation(quat)
    g_means[n, 0] += g_mean[0]
    g_means[n, 1] += g_mean[1]
    g_means[n, 2] += g_mean[2]
    g_logit_opacities[n] += g_opacity * opacity * (ONE - opacity)
    g_log_scales[n, 0] += dot(axes[0], g_axes[0])
    g_log_scales[n, 1] += dot(axes[1], g_axes[1])
    g_log_scales[n, 2] += dot(axes[2], g_axes[2])
    lengths = dot(axes[0], x), dot(axes[1], y), dot(axes[2], z)
    g_w, g_i, g_j, g_k = projection.unit_quat_gradient(quat, inverse_norm, scaled_columns(lengths, g_axes))
    g_quats[n, 0] += g_w
    g_quats[n, 1] += g_i
    g_quats[n, 2] += g_j
    g_quats[n, 3] += g_k


def build_project(real: type, kind: Footprint) -> Scalar:
    """Builds the step that fills the outputs of one Gaussian in all cameras, zeros where it is culled."""
    (shape, cull, place, *_), direction, (color, _) = kind, build_direction(real), color_maths(real)
    zero, half = real(0.0), real(0.5)

    @inlined
    def project(n, inputs, lens, size, degree, near, outputs):
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows = inputs
        colors, radii = outputs[4], outputs[-1]
        clips, mean, wanted = clip_planes.shape[0] > 0, vec3(means, n), False
        for c in range(cam_from_world.shape[0]):
            cull(c, n, outputs)
            wanted |= in_front(c, mean, cam_from_world, near, clip_planes, clips)
        if not wanted:
            return
        shaped = shape(means, quats, log_scales, logit_opacities, n)
        for c in range(cam_from_world.shape[0]):
            if not (shaped[0] and in_front(c, mean, cam_from_world, near, clip_planes, clips)):
                continue
            place(c, n, mean, shaped, cam_from_world, intrinsics, lens, windows, size, near, outputs)
            if degree < 0 or not radii[c, n, 0] > zero:
                continue
            (x, y, z), _ = direction(mean, lens, c)
            red, green, blue = color(sh, n, degree, x, y, z)
            if projection.is_finite(abs(red) + abs(green) + abs(blue)):
                colors[c, n, 0] = max(red + half, zero)
                colors[c, n, 1] = max(green + half, zero)
                colors[c, n, 2] = max(blue + half, zero)
            else:
                cull(c, n, outputs)

    return project


def build_project_back(real: type, kind: Footprint) -> Scalar:
    """Builds the step that adds one visible Gaussian's gradients to the inputs of `finish`, and to its camera's."""
    place_gradient, view_gradient = kind.place_gradient, view_gradients(real)
    zero, one = real(0.0), real(1.0)

    @inlined
    def project_back(c, n, mean, shaped, inputs, lens, degree, maps, cotangents, needs_camera, total, sums, g_sh):
        """Inputs are coefficients, poses and intrinsics; `maps` are those of discs, or None."""
        sh, cam_from_world, intrinsics = inputs
        g_opacities, g_colors = cotangents[3], cotangents[4]
        g_mean, g_opacity, (ga_x, ga_y, ga_z), (g_u, g_v) = sums
        g_center, g_rows, g_axes, g_scales = place_gradient(
            c, n, mean, shaped, cam_from_world, intrinsics, lens, maps, cotangents
        )
        g_mean = combine(one, g_mean, one, scaled_sum(g_center, rows_of(cam_from_world, c)))
        ga_x, ga_y = combine(one, ga_x, one, g_axes[0]), combine(one, ga_y, one, g_axes[1])
        ga_z = combine(one, ga_z, one, g_axes[2])
        g_u, g_v, g_opacity = g_u + g_scales[0], g_v + g_scales[1], g_opacity + g_opacities[c, n]
        if needs_camera:
            add_place(total, g_rows, g_center, mean)
        g_color = g_colors[c, n, 0], g_colors[c, n, 1], g_colors[c, n, 2]
        if degree >= 0 and (g_color[0] != zero or g_color[1] != zero or g_color[2] != zero):
            g_view = view_gradient(sh, n, degree, mean, lens, c, g_color, g_sh)
            g_mean = combine(one, g_mean, one, g_view)
            if needs_camera:
                add_view(total, cam_from_world, c, g_view)
        return g_mean, g_opacity, (ga_x, ga_y, ga_z), (g_u, g_v)

    return project_back
