"""Projection of discs on the CPU: chunks of discs, every camera of the batch while a chunk is at hand.

Chunks have a fixed size, whatever the number of threads; gradients that many discs share (those of the cameras) are
summed per chunk and then over chunks in order.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, even_stride, inlined, kernel
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.disc import MAP
from glassplat.kernels.project.disc_steps import discs
from glassplat.kernels.project.steps import CHUNK, LENS_VALUES, projecting, projecting_back, view_steps
from glassplat.kernels.records import REAL_OF

WIDTHS = ((2,), (MAP,), (), (), (3,), (3,), (2,), (3,), (2,))
"""Trailing dimensions of the fields of `ProjectedDiscs`."""


def project_discs(inputs: Sequence[Tensor], width: int, height: int, *, degree: int, near: float) -> tuple[Tensor, ...]:
    """Fields of `ProjectedDiscs` from raw discs, poses, intrinsics, clip planes and windows; degree -1 is no colour."""
    means, cam_from_world = inputs[0], inputs[5]
    real, leading = REAL_OF[means.dtype], (cam_from_world.shape[0], means.shape[0])
    outputs = tuple(means.new_empty(*leading, *rest) for rest in WIDTHS)
    project_discs_forward(real)(
        *(tensor.numpy() for tensor in inputs), real(width), real(height), degree, real(near),
        tuple(tensor.numpy() for tensor in outputs),
    )  # fmt: skip
    return outputs


def project_discs_gradients(
    inputs: Sequence[Tensor], width: int, height: int, degree: int,
    *, seen: tuple[Tensor, Tensor], cotangents: Sequence[Tensor], needs_camera: bool,
) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """Gradients of raw discs and of each camera [C, 12]; `seen` are the radii and maps of the forward pass."""
    real = REAL_OF[inputs[0].dtype]
    found = [torch.zeros_like(tensor) for tensor in inputs[:5]]
    cameras = torch.zeros(inputs[5].shape[0], 12, dtype=torch.float64)
    project_discs_backward(real)(
        *(tensor.numpy() for tensor in inputs), real(width), real(height), degree,
        *(tensor.numpy() for tensor in seen), tuple(tensor.numpy() for tensor in cotangents), needs_camera,
        *(tensor.numpy() for tensor in (*found, cameras)),
    )  # fmt: skip
    return found, cameras


@cache
def project_discs_forward(real: type) -> Kernel:
    """Fills the fields of `ProjectedDiscs`; zeros where a disc is culled."""
    fill_lenses, project, chunk_size = view_steps(real).fill_lenses, projecting(real, discs(real)), CHUNK

    @kernel("project_discs_forward", real)
    def forward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows,
        width, height, degree, near, outputs,
    ):  # fmt: skip
        count = means.shape[0]
        lens = np.empty((cam_from_world.shape[0], LENS_VALUES), real)
        fill_lenses(lens, cam_from_world, intrinsics, width, height)
        inputs = means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows
        num_chunks = (count + chunk_size - 1) // chunk_size
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            for n in range(chunk * chunk_size, min(count, (chunk + 1) * chunk_size)):
                project(n, inputs, lens, (width, height), degree, near, outputs)

    return forward


def _disc_backward(real: type) -> Scalar:
    """One disc in all cameras: fills its gradients, which are zero beforehand."""
    vec3, footprint, zero = view_steps(real).vec3, discs(real), real(0.0)
    shape, finish, project_back = footprint.shape, footprint.finish, projecting_back(real, footprint)

    @inlined
    def disc_backward(
        n, means, quats, log_scales, logit_opacities, inputs, lens, degree, radii, maps,
        cotangents, needs_camera, total, g_means, g_quats, g_log_scales, g_logit_opacities, g_sh,
    ):  # fmt: skip
        mean, touched = vec3(means, n), False
        shaped, none = shape(means, quats, log_scales, logit_opacities, n), (zero, zero, zero)
        sums = none, zero, (none, none, none), (zero, zero)
        for c in range(radii.shape[0]):
            if not radii[c, n, 0] > zero:
                continue
            touched = True
            sums = project_back(
                c, n, mean, shaped, inputs, lens, degree, maps, cotangents, needs_camera, total[c], sums, g_sh
            )
        if touched:
            finish(n, shaped, sums, g_means, g_quats, g_log_scales, g_logit_opacities)

    return disc_backward


@cache
def project_discs_backward(real: type) -> Kernel:
    """Fills the gradients of the discs; adds those of the cameras to [C, 12], rows of (3x3 block, translation)."""
    fill_lenses, disc_backward = view_steps(real).fill_lenses, _disc_backward(real)
    chunk_size = CHUNK

    @kernel("project_discs_backward", real)
    def backward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, width, height, degree, radii, maps,
        cotangents, needs_camera, g_means, g_quats, g_log_scales, g_logit_opacities, g_sh, g_cameras,
    ):  # fmt: skip
        count, num_cameras = means.shape[0], cam_from_world.shape[0]
        num_chunks = (count + chunk_size - 1) // chunk_size
        lens = np.empty((num_cameras, LENS_VALUES), real)
        fill_lenses(lens, cam_from_world, intrinsics, width, height)
        totals = np.zeros((num_chunks, num_cameras, 12))
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            for n in range(chunk * chunk_size, min(count, (chunk + 1) * chunk_size)):
                disc_backward(
                    n, means, quats, log_scales, logit_opacities, (sh, cam_from_world, intrinsics), lens, degree,
                    radii, maps, cotangents, needs_camera, totals[chunk],
                    g_means, g_quats, g_log_scales, g_logit_opacities, g_sh,
                )  # fmt: skip
        for chunk in range(num_chunks):
            for c in range(num_cameras):
                for i in range(12):
                    g_cameras[c, i] += totals[chunk, c, i]

    return backward
