"""Steps of the forward projection that take one Gaussian: where a thread has one, and for discs."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.maths.projection import ALPHA_MIN, LOW_PASS, screen_maths, shape_maths, vector_maths
from glassplat.kernels.project.cpu_view import view_steps

MOST_DEVIATIONS = 1.01 * 2.0 * math.log(1.0 / ALPHA_MIN)
"""Squared number of standard deviations within which any coverage sinks to `ALPHA_MIN`; a percent is slack."""


def placing(real: type) -> Callable[..., Any]:
    """One Gaussian in one camera: fills everything but the colour, where it is visible."""
    _, pose, _, view, *_ = view_steps(real)
    dot = vector_maths().dot
    half_extents = screen_maths(real).half_extents
    is_finite = shape_maths(real).is_finite
    zero, one = real(0.0), real(1.0)

    @inlined
    def place(
        n, c, mean, opacity, axes, cam_from_world, intrinsics, lens, windows,
        means2d, conics, depths, opacities, radii,
    ):  # fmt: skip
        row_x, row_y, row_z, offset = pose(cam_from_world, c)
        depth = dot(row_z, mean) + offset[2]
        position = dot(row_x, mean) + offset[0], dot(row_y, mean) + offset[1], depth
        tangent, _, _, _, covariance = view((row_x, row_y, row_z), position, axes, intrinsics, lens, c)
        xx, xy, yy, determinant = covariance
        u = intrinsics[c, 0] * tangent[0] + intrinsics[c, 2]
        v = intrinsics[c, 1] * tangent[1] + intrinsics[c, 3]
        reach_x, reach_y = half_extents(xx, yy, opacity)
        # Written so that NaN fails every comparison and the Gaussian stays culled.
        across = u + reach_x > windows[c, 0] and u - reach_x < windows[c, 2]
        down = v + reach_y > windows[c, 1] and v - reach_y < windows[c, 3]
        if across and down and reach_x > zero and is_finite(determinant) and is_finite(depth):
            inverse = one / determinant
            means2d[c, n, 0], means2d[c, n, 1] = u, v
            conics[c, n, 0], conics[c, n, 1], conics[c, n, 2] = yy * inverse, -xy * inverse, xx * inverse
            depths[c, n], opacities[c, n] = depth, opacity
            radii[c, n, 0], radii[c, n, 1] = reach_x, reach_y

    return place


def culling(real: type) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """Writing zeros for one Gaussian in one camera, whether it is on the kept sides, and whether it may show at all."""
    vec3, pose, *_ = view_steps(real)
    dot = vector_maths().dot
    zero, one, low_pass, most_deviations = real(0.0), real(1.0), real(LOW_PASS), real(MOST_DEVIATIONS)

    @inlined
    def cull(n, c, means2d, conics, depths, opacities, colors, radii):
        depths[c, n] = opacities[c, n] = zero
        means2d[c, n, 0] = means2d[c, n, 1] = radii[c, n, 0] = radii[c, n, 1] = zero
        for j in range(3):
            conics[c, n, j] = colors[c, n, j] = zero

    @inlined
    def in_front(c, mean, cam_from_world, near, clip_planes, clips):
        row_z = cam_from_world[c, 2, 0], cam_from_world[c, 2, 1], cam_from_world[c, 2, 2]
        if not dot(row_z, mean) + cam_from_world[c, 2, 3] > near:
            return False
        return not clips or dot(vec3(clip_planes, c), mean) + clip_planes[c, 3] > zero

    @inlined
    def may_show(n, c, mean, log_scales, cam_from_world, intrinsics, lens, near, clip_planes, clips, windows):
        """Whether a Gaussian is on the kept sides, and a sphere around it comes near the window: cheap and safe."""
        if not in_front(c, mean, cam_from_world, near, clip_planes, clips):
            return False
        row_x, row_y, row_z, offset = pose(cam_from_world, c)
        depth = dot(row_z, mean) + offset[2]
        inverse_depth = one / depth
        u = intrinsics[c, 0] * (dot(row_x, mean) + offset[0]) * inverse_depth + intrinsics[c, 2]
        v = intrinsics[c, 1] * (dot(row_y, mean) + offset[1]) * inverse_depth + intrinsics[c, 3]
        past_x, past_y = max(windows[c, 0] - u, u - windows[c, 2]), max(windows[c, 1] - v, v - windows[c, 3])
        size = math.exp(max(log_scales[n, 0], log_scales[n, 1], log_scales[n, 2])) * inverse_depth
        wide, high = size * intrinsics[c, 0] * lens[c, 7], size * intrinsics[c, 1] * lens[c, 8]
        # Written so that NaN leaves the decision to the exact test.
        beside = past_x > zero and past_x * past_x > most_deviations * (wide * wide + low_pass)
        return not (beside or (past_y > zero and past_y * past_y > most_deviations * (high * high + low_pass)))

    return cull, in_front, may_show
