"""Normals of Gaussians on the CPU, one Gaussian at a time."""

from __future__ import annotations

from functools import cache

import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, kernel
from glassplat.kernels.maths_normals import normal_maths
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


@cache
def facing_normals_forward(real: type) -> Kernel:
    """Fills the normals."""
    face = normal_maths(real).face

    @kernel("facing_normals_forward", real)
    def forward(quats, log_scales, means, eye, normals):
        for i in prange(quats.shape[0]):
            face(i, quats, log_scales, means, eye, normals)

    return forward


@cache
def facing_normals_backward(real: type) -> Kernel:
    """Fills the gradients of the quaternions."""
    face_gradient = normal_maths(real).face_gradient

    @kernel("facing_normals_backward", real)
    def backward(quats, log_scales, normals, v_normals, v_quats):
        for i in prange(quats.shape[0]):
            face_gradient(i, quats, log_scales, normals, v_normals, v_quats)

    return backward
