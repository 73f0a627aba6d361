"""Scalar maths of surfaces: one Gaussian's colour, normal and strength, and their adjoint.

The functions read and write rows of arrays, so that one source compiles for the CPU and for CUDA.
"""

from __future__ import annotations

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.maths import projection
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.projection import dot, rotation, scaled, scaled_sum
from glassplat.kernels.records import NORMAL_AT, STRENGTH_AT, SURFACE_CHANNELS


@inlined
def shortest_axis(x, y, z):
    """Index of the smallest of three values, the first among equals."""
    if y < x:
        return 2 if z < y else 1
    return 2 if z < x else 0


def _facing(real: type) -> tuple[Scalar, Scalar]:
    """The normal of a Gaussian, and its adjoint."""
    unit_quat, zero, one = projection.build_unit_quat(real), real(0.0), real(1.0)

    @inlined
    def chosen(which, columns):
        # A weighted sum, because a branch would be unpredictable.
        first, second = real(which == 0), real(which == 1)
        return scaled_sum((first, second, one - first - second), columns)

    @inlined
    def normal_of(i, quats, log_scales, means, camera_center):
        quat, inverse_norm = unit_quat(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3])
        if not (projection.is_finite(inverse_norm) and inverse_norm > zero):
            return zero, zero, zero
        shortest = shortest_axis(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
        axis = chosen(shortest, rotation(quat))
        towards = camera_center[0] - means[i, 0], camera_center[1] - means[i, 1], camera_center[2] - means[i, 2]
        side = -one if dot(towards, axis) < zero else one
        return scaled(side, axis)

    @inlined
    def quat_gradient(i, quats, log_scales, normal, v_normal):
        none = (zero, zero, zero)
        if dot(normal, normal) == zero:
            return zero, zero, zero, zero
        quat, inverse_norm = unit_quat(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3])
        shortest = shortest_axis(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
        axis = chosen(shortest, rotation(quat))
        side = -one if dot(normal, axis) < zero else one
        v = scaled(side, v_normal)
        g_columns = v if shortest == 0 else none, v if shortest == 1 else none, v if shortest == 2 else none
        return projection.unit_quat_gradient(quat, inverse_norm, g_columns)

    return normal_of, quat_gradient


def surface_maths(real: type) -> tuple[Scalar, Scalar]:
    """Builds the steps for Gaussian `i`, which must be visible.

    `describe` writes its channels, with a normal of zeros if its quaternion has no direction. `describe_gradient`
    writes the gradients, given these channels.
    """
    (normal_of, quat_gradient), sigmoid, one = _facing(real), projection.build_sigmoid(real), real(1.0)

    @inlined
    def describe(i, colors, quats, log_scales, means, logit_strengths, camera_center, extra, channels):
        normal = normal_of(i, quats, log_scales, means, camera_center)
        for d in range(3):
            channels[i, d], channels[i, NORMAL_AT + d] = colors[i, d], normal[d]
        channels[i, STRENGTH_AT] = sigmoid(logit_strengths[i])
        for e in range(extra.shape[1]):
            channels[i, SURFACE_CHANNELS + e] = extra[i, e]

    @inlined
    def describe_gradient(
        i, quats, log_scales, channels, v_channels, v_colors, v_quats, v_logit_strengths, v_extra
    ):  # fmt: skip
        normal = channels[i, NORMAL_AT], channels[i, NORMAL_AT + 1], channels[i, NORMAL_AT + 2]
        v_normal = v_channels[i, NORMAL_AT], v_channels[i, NORMAL_AT + 1], v_channels[i, NORMAL_AT + 2]
        g = quat_gradient(i, quats, log_scales, normal, v_normal)
        v_quats[i, 0], v_quats[i, 1], v_quats[i, 2], v_quats[i, 3] = g
        for d in range(3):
            v_colors[i, d] = v_channels[i, d]
        strength = channels[i, STRENGTH_AT]
        v_logit_strengths[i] = v_channels[i, STRENGTH_AT] * strength * (one - strength)
        for e in range(v_extra.shape[1]):
            v_extra[i, e] = v_channels[i, SURFACE_CHANNELS + e]

    return describe, describe_gradient
