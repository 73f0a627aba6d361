"""Normals of Gaussians on the GPU: one thread for each Gaussian."""

from __future__ import annotations

from functools import cache

import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.cuda.launch import Kernel, blocks_for, kernel
from glassplat.kernels.maths_normals import normal_maths
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
    face = normal_maths(real).face

    @kernel("facing_normals_forward", real, "real2 real2 real2 real1 real2")
    def forward(quats, log_scales, means, eye, normals):
        i = cuda.grid(1)
        if i < quats.shape[0]:
            face(i, quats, log_scales, means, eye, normals)

    return forward


@cache
def facing_normals_backward(real: type) -> Kernel:
    """Fills the gradients of the quaternions."""
    face_gradient = normal_maths(real).face_gradient

    @kernel("facing_normals_backward", real, "real2 real2 real2 real2 real2")
    def backward(quats, log_scales, normals, v_normals, v_quats):
        i = cuda.grid(1)
        if i < quats.shape[0]:
            face_gradient(i, quats, log_scales, normals, v_normals, v_quats)

    return backward
