"""Normals of Gaussians on the GPU: one thread for each Gaussian."""

from __future__ import annotations

from functools import cache

import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.cpu.facing_normals import shortest_axis
from glassplat.kernels.cuda.launch import Kernel, blocks_for, kernel
from glassplat.kernels.maths import shape_maths, vector_maths
from glassplat.kernels.tensor_checks import REAL_OF

THREADS = 128


def facing_normals(quats: Tensor, log_scales: Tensor, means: Tensor, eye: Tensor) -> Tensor:
    """As the operation."""
    normals = torch.empty_like(means)
    kernel_of = facing_normals_forward(REAL_OF[means.dtype])
    kernel_of(blocks_for(means.shape[0], THREADS), THREADS, quats, log_scales, means, eye, normals)
    return normals


def facing_normals_gradient(quats: Tensor, log_scales: Tensor, normals: Tensor, cotangent: Tensor) -> Tensor:
    """As `glassplat.kernels.cpu.facing_normals.facing_normals_gradient`."""
    v_quats = torch.empty_like(quats)
    kernel_of = facing_normals_backward(REAL_OF[quats.dtype])
    kernel_of(blocks_for(quats.shape[0], THREADS), THREADS, quats, log_scales, normals, cotangent, v_quats)
    return v_quats


@cache
def facing_normals_forward(real: type) -> Kernel:
    """Fills the normals."""
    maths, dot = shape_maths(real), vector_maths().dot
    unit_quat, rotation, is_finite = maths.unit_quat, maths.rotation, maths.is_finite
    zero, one = real(0.0), real(1.0)

    @kernel("facing_normals_forward", real, "real2 real2 real2 real1 real2")
    def forward(quats, log_scales, means, eye, normals):
        i = cuda.grid(1)
        if i >= quats.shape[0]:
            return
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

    return forward


@cache
def facing_normals_backward(real: type) -> Kernel:
    """Fills the gradients of the quaternions."""
    maths, dot = shape_maths(real), vector_maths().dot
    unit_quat, rotation, unit_quat_gradient = maths.unit_quat, maths.rotation, maths.unit_quat_gradient
    zero, one = real(0.0), real(1.0)

    @kernel("facing_normals_backward", real, "real2 real2 real2 real2 real2")
    def backward(quats, log_scales, normals, v_normals, v_quats):
        i, none = cuda.grid(1), (zero, zero, zero)
        if i >= quats.shape[0]:
            return
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

    return backward
