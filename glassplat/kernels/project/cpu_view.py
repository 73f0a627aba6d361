"""How one camera sees one Gaussian: what the forward and the backward kernel of the projection share."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.maths.projection import screen_maths, shape_maths, vector_maths

CHUNK = 512
"""Gaussians per task; part of the result's rounding, so not to be tuned per machine."""
LENS_VALUES = 9
"""Tangent limits (4), camera centre (3), and how much longer than a sphere its footprint may get along x and y (2)."""


class ViewSteps(NamedTuple):
    """Parts of the kernels, which read the arrays that the scalar maths does not know.

    Attributes:
        vec3: row n of an array [N, 3] as a tuple.
        pose: rows of the upper 3x3 block of a camera matrix, and its translation.
        shape: (usable, opacity, unit quaternion, inverse norm, axes) of a Gaussian.
        view: what a camera sees of a Gaussian before its colour.
        fill_lenses: writes `LENS_VALUES` numbers per camera.
        direction: unit vector from a camera's centre to a mean, and its inverse length.
    """

    vec3: Callable[..., Any]
    pose: Callable[..., Any]
    shape: Callable[..., Any]
    view: Callable[..., Any]
    fill_lenses: Callable[..., Any]
    direction: Callable[..., Any]


def view_steps(real: type) -> ViewSteps:
    """Builds the parts for `real`, np.float32 or np.float64."""
    vec3, pose = _loads()
    return ViewSteps(vec3, pose, _shape(real), view_with(real, screen_maths(real).clamped), *_lenses(real))


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


def _lenses(real: type) -> tuple[Callable[..., Any], Callable[..., Any]]:
    tangent_limits, *_ = screen_maths(real)
    vectors = vector_maths()
    dot, blend = vectors.dot, vectors.blend
    _, pose = _loads()
    one = real(1.0)

    @inlined
    def skewed(row, row_z, tangent):
        """Length of a footprint in multiples of focal length over depth."""
        w = blend(one, row, -tangent, row_z)
        return math.sqrt(dot(w, w))

    @inlined
    def fill_lenses(lens, cam_from_world, intrinsics, width, height):
        num_cameras = cam_from_world.shape[0]
        for c in range(num_cameras):
            limits = tangent_limits(
                intrinsics[c, 0], intrinsics[c, 1], intrinsics[c, 2], intrinsics[c, 3], width, height
            )
            lens[c, 0], lens[c, 1], lens[c, 2], lens[c, 3] = limits
            # A footprint's length is convex in the tangent, so it is greatest at one of the limits.
            row_x, row_y, row_z, _ = pose(cam_from_world, c)
            lens[c, 7] = max(skewed(row_x, row_z, limits[0]), skewed(row_x, row_z, limits[1]))
            lens[c, 8] = max(skewed(row_y, row_z, limits[2]), skewed(row_y, row_z, limits[3]))
            for j in range(3):
                lens[c, 4 + j] = -(
                    cam_from_world[c, 0, j] * cam_from_world[c, 0, 3]
                    + cam_from_world[c, 1, j] * cam_from_world[c, 1, 3]
                    + cam_from_world[c, 2, j] * cam_from_world[c, 2, 3]
                )

    @inlined
    def direction(mean, lens, c):
        x, y, z = mean[0] - lens[c, 4], mean[1] - lens[c, 5], mean[2] - lens[c, 6]
        inverse_length = one / math.sqrt(x * x + y * y + z * z)
        return (x * inverse_length, y * inverse_length, z * inverse_length), inverse_length

    return fill_lenses, direction


def view_with(real: type, clamped: Callable[..., Any]) -> Callable[..., Any]:
    """What a camera sees, of numbers or of vectors, with the function that holds them between two limits."""
    along = vector_maths().along
    _, _, footprint, screen_covariance, *_ = screen_maths(real)
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
