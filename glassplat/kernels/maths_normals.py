"""Scalar maths of normals: one Gaussian's shortest axis, turned to the camera, and its adjoint.

The functions read and write rows of arrays, so that one source compiles for the CPU and for CUDA.
"""

from __future__ import annotations

from typing import NamedTuple

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.maths import shape_maths, vector_maths
from glassplat.kernels.maths_blend import Scalar


class NormalMaths(NamedTuple):
    """Steps for Gaussian `i`.

    Attributes:
        face: writes its normal; zeros where its quaternion has no direction.
        face_gradient: writes the gradient of its quaternion, given the normal that `face` has written.
    """

    face: Scalar
    face_gradient: Scalar


@inlined
def shortest_axis(x, y, z):  # type: ignore[no-untyped-def]
    """Position of the smallest of three values, the first among equals."""
    if y < x:
        return 2 if z < y else 1
    return 2 if z < x else 0


def normal_maths(real: type) -> NormalMaths:
    """Builds the functions for `real`, np.float32 or np.float64."""
    maths, dot = shape_maths(real), vector_maths().dot
    unit_quat, rotation, is_finite = maths.unit_quat, maths.rotation, maths.is_finite
    unit_quat_gradient = maths.unit_quat_gradient
    zero, one = real(0.0), real(1.0)

    @inlined
    def face(i, quats, log_scales, means, eye, normals):  # type: ignore[no-untyped-def]
        quat, inverse_norm = unit_quat(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3])
        if not (is_finite(inverse_norm) and inverse_norm > zero):
            normals[i, 0], normals[i, 1], normals[i, 2] = zero, zero, zero
            return
        first, second, third = rotation(quat)
        shortest = shortest_axis(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
        axis = first if shortest == 0 else second if shortest == 1 else third
        towards = eye[0] - means[i, 0], eye[1] - means[i, 1], eye[2] - means[i, 2]
        side = -one if dot(towards, axis) < zero else one
        normals[i, 0], normals[i, 1], normals[i, 2] = side * axis[0], side * axis[1], side * axis[2]

    @inlined
    def face_gradient(i, quats, log_scales, normals, v_normals, v_quats):  # type: ignore[no-untyped-def]
        none = (zero, zero, zero)
        normal = normals[i, 0], normals[i, 1], normals[i, 2]
        if dot(normal, normal) == zero:
            v_quats[i, 0], v_quats[i, 1], v_quats[i, 2], v_quats[i, 3] = zero, zero, zero, zero
            return
        quat, inverse_norm = unit_quat(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3])
        first, second, third = rotation(quat)
        shortest = shortest_axis(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
        axis = first if shortest == 0 else second if shortest == 1 else third
        side = -one if dot(normal, axis) < zero else one
        v = side * v_normals[i, 0], side * v_normals[i, 1], side * v_normals[i, 2]
        g0 = v if shortest == 0 else none
        g1 = v if shortest == 1 else none
        g2 = v if shortest == 2 else none
        g = unit_quat_gradient(quat, inverse_norm, g0, g1, g2)
        v_quats[i, 0], v_quats[i, 1], v_quats[i, 2], v_quats[i, 3] = g

    return NormalMaths(face, face_gradient)
