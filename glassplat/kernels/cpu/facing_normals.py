"""Normals of Gaussians on the CPU, one Gaussian at a time."""

from __future__ import annotations

from functools import cache

import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.maths import shape_maths, vector_maths
from glassplat.kernels.tensor_checks import REAL_OF


def facing_normals(quats: Tensor, log_scales: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """As the operation."""
    normals = torch.empty_like(means)
    tensors = (quats, log_scales, means, eye, normals)
    facing_normals_forward(REAL_OF[means.dtype])(*(tensor.numpy() for tensor in tensors))
    return normals


def facing_normals_gradient(quats: Tensor, log_scales: Tensor, normals: Tensor, cotangent: Tensor) -> Tensor:
    """Gradient of the quaternions, given the normals that the kernel found."""
    v_quats = torch.empty_like(quats)
    tensors = (quats, log_scales, normals, cotangent, v_quats)
    facing_normals_backward(REAL_OF[quats.dtype])(*(tensor.numpy() for tensor in tensors))
    return v_quats


@inlined
def shortest_axis(x, y, z):
    """Position of the smallest of three values, the first among equals."""
    if y < x:
        return 2 if z < y else 1
    return 2 if z < x else 0


@cache
def facing_normals_forward(real: type) -> Kernel:
    """Fills the normals."""
    maths, dot = shape_maths(real), vector_maths().dot
    unit_quat, rotation, is_finite = maths.unit_quat, maths.rotation, maths.is_finite
    zero, one = real(0.0), real(1.0)

    @kernel("facing_normals_forward", real)
    def forward(quats, log_scales, means, eye, normals):
        for i in prange(quats.shape[0]):
            quat, inverse_norm = unit_quat(quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3])
            if not (is_finite(inverse_norm) and inverse_norm > zero):
                normals[i, 0], normals[i, 1], normals[i, 2] = zero, zero, zero
                continue
            first, second, third = rotation(quat)
            shortest = shortest_axis(log_scales[i, 0], log_scales[i, 1], log_scales[i, 2])
            axis = first if shortest == 0 else second if shortest == 1 else third
            towards = eye[0] - means[i, 0], eye[1] - means[i, 1], eye[2] - means[i, 2]
            side = -one if dot(towards, axis) < zero else one
            normals[i, 0], normals[i, 1], normals[i, 2] = side * axis[0], side * axis[1], side * axis[2]

    return forward


@cache
def facing_normals_backward(real: type) -> Kernel:
    """Fills the gradients of the quaternions."""
    maths, dot = shape_maths(real), vector_maths().dot
    unit_quat, rotation, unit_quat_gradient = maths.unit_quat, maths.rotation, maths.unit_quat_gradient
    zero, one = real(0.0), real(1.0)

    @kernel("facing_normals_backward", real)
    def backward(quats, log_scales, normals, v_normals, v_quats):
        none = (zero, zero, zero)
        for i in prange(quats.shape[0]):
            normal = normals[i, 0], normals[i, 1], normals[i, 2]
            if dot(normal, normal) == zero:
                v_quats[i, 0], v_quats[i, 1], v_quats[i, 2], v_quats[i, 3] = zero, zero, zero, zero
                continue
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

    return backward
