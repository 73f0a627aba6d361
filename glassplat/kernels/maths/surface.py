"""Scalar maths of surfaces: one Gaussian's colour, normal and strength, and their adjoint.

The functions read and write rows of arrays, so that one source compiles for the CPU and for CUDA.
"""

from __future__ import annotations

from typing import NamedTuple

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.projection import dot, shape_maths
from glassplat.kernels.records import NORMAL_AT, STRENGTH_AT, SURFACE_CHANNELS


class SurfaceMaths(NamedTuple):
    """Steps for Gaussian `i`, which must be visible.

    Attributes:
        describe: writes its channels, with a normal of zeros if its quaternion has no direction.
        describe_gradient: writes the gradients, given the channels written by `describe`.
    """

    describe: Scalar
    describe_gradient: Scalar


@inlined
def shortest_axis(x, y, z):
    """Index of the smallest of three values, the first among equals."""
    if y < x:
        return 2 if z < y else 1
    return 2 if z < x else 0


def _facing(real: type) -> tuple[Scalar, Scalar]:
    """The normal of a Gaussian, and its adjoint."""
    maths = shape_maths(real)
    unit_quat, rotation, is_finite = maths.unit_quat, maths.rotation, maths.is_finite
    unit_quat_gradient = maths.unit_quat_gradient
    zero, one = real(0.0), real(1.0)

    @inlined
    def chosen(which, a, b, c):
        # Weighted sums, because a branch would be unpredictable.
        first, second = real(which == 0), real(which == 1)
        third = one - first - second
        return (
            first * a[0] + second * b[0] + third * c[0],
            first * a[1] + second * b[1] + third * c[1],
            first * a[2] + second * b[2] + third * c[2],
        )

    @inlined
    def normal_of(i, quats, log_scales, means, camera_center):
        quat, inverse_norm = unit_quat(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3])
        if not (is_finite(inverse_norm) and inverse_norm > zero):
            return zero, zero, zero
        first, second, third = rotation(quat)
        shortest = shortest_axis(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
        axis = chosen(shortest, first, second, third)
        towards = camera_center[0] - means[i, 0], camera_center[1] - means[i, 1], camera_center[2] - means[i, 2]
        side = -one if dot(towards, axis) < zero else one
        return side * axis[0], side * axis[1], side * axis[2]

    @inlined
    def quat_gradient(i, quats, log_scales, normal, v_normal):
        none = (zero, zero, zero)
        if dot(normal, normal) == zero:
            return zero, zero, zero, zero
        quat, inverse_norm = unit_quat(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3])
        first, second, third = rotation(quat)
        shortest = shortest_axis(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
        axis = chosen(shortest, first, second, third)
        side = -one if dot(normal, axis) < zero else one
        v = side * v_normal[0], side * v_normal[1], side * v_normal[2]
        g0 = v if shortest == 0 else none
        g1 = v if shortest == 1 else none
        g2 = v if shortest == 2 else none
        return unit_quat_gradient(quat, inverse_norm, g0, g1, g2)

    return normal_of, quat_gradient


def surface_maths(real: type) -> SurfaceMaths:
    """Builds the functions for `real`, np.float32 or np.float64."""
    normal_of, quat_gradient = _facing(real)
    sigmoid, one = shape_maths(real).sigmoid, real(1.0)

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

    return SurfaceMaths(describe, describe_gradient)
