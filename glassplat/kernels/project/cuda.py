"""Projection on the GPU: one thread per Gaussian, which projects it into every camera of the batch.

Ellipsoids and discs differ only in their footprint: their kernels pass the arrays to the same steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cpu import inlined
from glassplat.kernels.backend.cuda import THREADS, Kernel, blocks_for, kernel
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.project import steps
from glassplat.kernels.project.cpu import DISC_WIDTHS, WIDTHS, new_outputs
from glassplat.kernels.project.disc_steps import discs
from glassplat.kernels.project.steps import LENS_VALUES, Footprint, vec3
from glassplat.kernels.records import REAL_OF
from glassplat.kernels.screen_statistics import Sums, Views

POSE = 12
"""Number of entries of a camera's gradient: rows of (3x3 block, translation)."""


def project(inputs: Sequence[Tensor], width: int, height: int, *, degree: int, near: float) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.project.cpu.project`."""
    outputs = new_outputs(inputs, WIDTHS)
    lens = _lenses(inputs[5], inputs[6], width, height)
    project_forward(REAL_OF[lens.dtype]).over(len(inputs[0]), *inputs, lens, degree, near, *outputs)
    return outputs


def project_discs(inputs: Sequence[Tensor], width: int, height: int, *, degree: int, near: float) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.project.cpu.project_discs`."""
    outputs = new_outputs(inputs, DISC_WIDTHS)
    lens = _lenses(inputs[5], inputs[6], width, height)
    launch = project_discs_forward(REAL_OF[lens.dtype]).over
    launch(len(inputs[0]), *inputs, lens, width, height, degree, near, *outputs)
    return outputs


def project_gradients(
    inputs: Sequence[Tensor], width: int, height: int, degree: int,
    *, radii: Tensor, cotangents: Sequence[Tensor], needs_camera: bool,
    accumulated: list[Tensor] | None = None,
) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """As `glassplat.kernels.project.cpu.project_gradients`."""
    found = _zeros_like(inputs[:5]) if accumulated is None else accumulated
    lens = _lenses(inputs[5], inputs[6], width, height)
    return _gradients(project_backward, inputs, lens, degree, (radii, *cotangents), needs_camera, found)


def project_discs_gradients(
    inputs: Sequence[Tensor], width: int, height: int, degree: int,
    *, seen: tuple[Tensor, Tensor], cotangents: Sequence[Tensor], needs_camera: bool,
) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """As `glassplat.kernels.project.cpu.project_discs_gradients`."""
    found = _zeros_like(inputs[:5])
    lens = _lenses(inputs[5], inputs[6], width, height)
    return _gradients(project_discs_backward, inputs, lens, degree, (*seen, *cotangents), needs_camera, found)


def _zeros_like(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Zeros of these shapes, all filled by one launch."""
    parts = tensors[0].new_zeros(sum(tensor.numel() for tensor in tensors)).split([t.numel() for t in tensors])
    return [part.view(tensor.shape) for part, tensor in zip(parts, tensors, strict=True)]


def _gradients(
    backward: Any, inputs: Sequence[Tensor], lens: Tensor, degree: int, given: Sequence[Tensor], needs_camera: bool,
    found: list[Tensor],
) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """Gradients of raw Gaussians, added to `found` in place, and of each camera [C, 12], summed over blocks."""
    means, num_cameras = inputs[0], inputs[5].shape[0]
    blocks = blocks_for(means.shape[0], THREADS)
    shape = (blocks, num_cameras, POSE) if needs_camera else (0, 0, 0)
    partial = torch.zeros(shape, dtype=torch.float64, device=means.device)
    backward(REAL_OF[means.dtype])(blocks, THREADS, *inputs, lens, degree, *given, needs_camera, *found, partial)
    return found, partial.sum(dim=0)


def _lenses(cam_from_world: Tensor, intrinsics: Tensor, width: int, height: int) -> Tensor:
    """Tangent limits, centre and stretch of every camera [C, 9]."""
    lens = cam_from_world.new_empty(cam_from_world.shape[0], LENS_VALUES)
    camera_lenses(REAL_OF[lens.dtype])(1, 1, lens, cam_from_world, intrinsics, width, height)
    return lens


@cache
def camera_lenses(real: type) -> Kernel:
    """Fills the lenses of all cameras in one thread, because there are few."""
    fill_lenses = steps.build_fill_lenses(real)

    @kernel("camera_lenses", real, "real2 real3 real2 real real")
    def lenses(lens, cam_from_world, intrinsics, width, height):
        if cuda.grid(1) == 0:
            fill_lenses(lens, cam_from_world, intrinsics, width, height)

    return lenses


@cache
def project_forward(real: type) -> Kernel:
    """Fills means2d, conics, depths, opacities, colors and radii; zeros where an ellipsoid is culled."""
    project_one, zero = steps.build_project(real, steps.ellipsoids(real)), real(0.0)

    @kernel(
        "project_forward",
        real,
        "real2 real2 real2 real1 real3 real3 real2 real2 real2 real2 int real real3 real3 real2 real2 real3 real3",
    )
    def forward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows,
        lens, degree, near, means2d, conics, depths, opacities, colors, radii,
    ):  # fmt: skip
        n = cuda.grid(1)
        if n < means.shape[0]:
            inputs = means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows
            outputs = means2d, conics, depths, opacities, colors, radii
            project_one(n, inputs, lens, (zero, zero), degree, near, outputs)

    return forward


@cache
def project_discs_forward(real: type) -> Kernel:
    """Fills the fields of `ProjectedDiscs`; zeros where a disc is culled."""
    project_one = steps.build_project(real, discs(real))

    @kernel(
        "project_discs_forward",
        real,
        "real2 real2 real2 real1 real3 real3 real2 real2 real2 real2 real real int real "
        "real3 real3 real2 real2 real3 real3 real3 real3 real3",
    )
    def forward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows,
        lens, width, height, degree, near,
        means2d, maps, depths, opacities, colors, normals, centers, conics, radii,
    ):  # fmt: skip
        n = cuda.grid(1)
        if n < means.shape[0]:
            inputs = means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows
            outputs = means2d, maps, depths, opacities, colors, normals, centers, conics, radii
            project_one(n, inputs, lens, (width, height), degree, near, outputs)

    return forward


def _backward_body(real: type, footprint: Footprint) -> Scalar:
    """Builds the body of a backward kernel: sums Gaussians' gradients over cameras, and cameras' over a block."""
    zero, threads, pose = real(0.0), THREADS, POSE
    shape, finish, project_back = footprint.shape, footprint.finish, steps.build_project_back(real, footprint)

    @inlined
    def backward_body(
        means, quats, log_scales, logit_opacities, inputs, lens, degree, seen, cotangents, needs_camera, found, partial
    ):  # fmt: skip
        block_sums = cuda.shared.array((threads, pose), np.float64)
        total = cuda.local.array(pose, np.float64)
        radii, maps = seen
        g_means, g_quats, g_log_scales, g_logit_opacities, g_sh = found
        n, t = cuda.grid(1), cuda.threadIdx.x
        inside = n < means.shape[0]
        # Threads beyond the last Gaussian keep running, because the block sums need them.
        n = n if inside else means.shape[0] - 1
        mean, touched, none = vec3(means, n), False, (zero, zero, zero)
        shaped = shape(means, quats, log_scales, logit_opacities, n)
        sums = none, zero, (none, none, none), (zero, zero)
        for c in range(radii.shape[0]):
            for i in range(pose):
                total[i] = 0.0
            if inside and radii[c, n, 0] > zero:
                touched = True
                sums = project_back(
                    c, n, mean, shaped, inputs, lens, degree, maps, cotangents, needs_camera, total, sums, g_sh
                )
            if needs_camera:
                for i in range(pose):
                    block_sums[t, i] = total[i]
                cuda.syncthreads()
                if t < pose:
                    block_sum = 0.0
                    for j in range(threads):
                        block_sum += block_sums[j, t]
                    partial[cuda.blockIdx.x, c, t] = block_sum
                cuda.syncthreads()
        if touched:
            finish(n, shaped, sums, g_means, g_quats, g_log_scales, g_logit_opacities)

    return backward_body


@cache
def project_backward(real: type) -> Kernel:
    """Adds to the gradients of ellipsoids, and fills each block's sums for each camera [blocks, C, 12]."""
    backward_body = _backward_body(real, steps.ellipsoids(real))

    @kernel(
        "project_backward",
        real,
        "real2 real2 real2 real1 real3 real3 real2 real2 int real3 "
        "real3 real3 real2 real2 real3 bool real2 real2 real2 real1 real3 double3",
    )
    def backward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, lens, degree, radii,
        g_means2d, g_conics, g_depths, g_opacities, g_colors, needs_camera,
        g_means, g_quats, g_log_scales, g_logit_opacities, g_sh, partial,
    ):  # fmt: skip
        backward_body(
            means, quats, log_scales, logit_opacities, (sh, cam_from_world, intrinsics), lens, degree, (radii, None),
            (g_means2d, g_conics, g_depths, g_opacities, g_colors), needs_camera,
            (g_means, g_quats, g_log_scales, g_logit_opacities, g_sh), partial,
        )  # fmt: skip

    return backward


@cache
def project_discs_backward(real: type) -> Kernel:
    """Fills the gradients, initially zero, of discs, and each block's sums for each camera [blocks, C, 12]."""
    backward_body = _backward_body(real, discs(real))

    @kernel(
        "project_discs_backward",
        real,
        "real2 real2 real2 real1 real3 real3 real2 real2 int real3 real3 "
        "real3 real3 real2 real2 real3 real3 bool real2 real2 real2 real1 real3 double3",
    )
    def backward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, lens, degree, radii, maps,
        g_means2d, g_maps, g_depths, g_opacities, g_colors, g_normals, needs_camera,
        g_means, g_quats, g_log_scales, g_logit_opacities, g_sh, partial,
    ):  # fmt: skip
        backward_body(
            means, quats, log_scales, logit_opacities, (sh, cam_from_world, intrinsics), lens, degree, (radii, maps),
            (g_means2d, g_maps, g_depths, g_opacities, g_colors, g_normals), needs_camera,
            (g_means, g_quats, g_log_scales, g_logit_opacities, g_sh), partial,
        )  # fmt: skip

    return backward


def add_views(sums: Sums, views: Views) -> None:
    """As `glassplat.kernels.screen_statistics.add_views`, for checked tensors."""
    count, weight, factor = sums.view_count.shape[1], None, 1.0
    if isinstance(views.weight, Tensor):
        # A scalar stays on the GPU, because reading it would synchronise.
        weight = views.weight.contiguous() if views.weight.dim() else views.weight.reshape(1, 1)
    else:
        factor = views.weight
    given = (*sums, *(tensor.detach().contiguous() for tensor in views[:3]), weight, factor)
    launch = add_views_kernel(REAL_OF[sums.view_count.dtype]).over
    launch(count, *given, views.width, views.height, 1 + views.direct)


@cache
def add_views_kernel(real: type) -> Kernel:
    """Adds to the first `rows` rows of the sums, with one thread per Gaussian."""
    half, zero = real(0.5), real(0.0)

    @kernel("screen_statistics", real, "real2 real2 real2 real3 real3 real3 real2 real real real int")
    def add(
        gradient_sum, absgrad_sum, view_count, v_means2d, v_absgrad, radii, weight, factor, width, height, rows
    ):  # fmt: skip
        n = cuda.grid(1)
        if n >= view_count.shape[1]:
            return
        right, down = half * width, half * height
        gradient, absgrad, seen = zero, zero, zero
        for c in range(radii.shape[0]):
            if radii[c, n, 0] > zero and radii[c, n, 1] > zero:
                x, y = right * v_means2d[c, n, 0], down * v_means2d[c, n, 1]
                gradient += math.sqrt(x * x + y * y)
                x, y = right * v_absgrad[c, n, 0], down * v_absgrad[c, n, 1]
                absgrad += math.sqrt(x * x + y * y)
                seen += weight[c, n] if weight.size > 1 else weight[0, 0] if weight.size == 1 else factor
        for row in range(rows):
            gradient_sum[row, n] += gradient
            absgrad_sum[row, n] += absgrad
            view_count[row, n] += seen

    return add
