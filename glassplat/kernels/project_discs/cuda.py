"""Projection of discs on the GPU: one thread for each disc, which looks at it through every camera of the batch."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.backend.cuda import Kernel, blocks_for, kernel
from glassplat.kernels.maths.harmonics import color_maths
from glassplat.kernels.maths.projection import shape_maths, vector_maths
from glassplat.kernels.project.cpu_view import LENS_VALUES, view_steps
from glassplat.kernels.project.cuda import camera_lenses
from glassplat.kernels.project.gradient_steps import camera_sums, view_gradients
from glassplat.kernels.project.steps import culling
from glassplat.kernels.project_discs.cpu import WIDTHS
from glassplat.kernels.project_discs.steps import disc_steps
from glassplat.kernels.records import REAL_OF

THREADS = 128
POSE = 12
"""Entries of a camera's gradient: rows of (3x3 block, translation)."""


def project_discs(inputs: Sequence[Tensor], width: int, height: int, *, degree: int, near: float) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.project_discs.cpu.project_discs`."""
    means, cam_from_world = inputs[0], inputs[5]
    real, count, num_cameras = REAL_OF[means.dtype], means.shape[0], cam_from_world.shape[0]
    outputs = tuple(means.new_empty(num_cameras, count, *rest) for rest in WIDTHS)
    lens = _lenses(cam_from_world, inputs[6], width, height)
    project_discs_forward(real)(
        blocks_for(count, THREADS), THREADS, *inputs, lens, width, height, degree, near, *outputs
    )  # fmt: skip
    return outputs


def project_discs_gradients(
    inputs: Sequence[Tensor], width: int, height: int, degree: int,
    *, seen: tuple[Tensor, Tensor], cotangents: Sequence[Tensor], needs_camera: bool,
) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """As `glassplat.kernels.project_discs.cpu.project_discs_gradients`."""
    means, cam_from_world = inputs[0], inputs[5]
    real, num_cameras = REAL_OF[means.dtype], cam_from_world.shape[0]
    blocks = blocks_for(means.shape[0], THREADS)
    found = [torch.zeros_like(tensor) for tensor in inputs[:5]]
    shape = (blocks, num_cameras, POSE) if needs_camera else (0, 0, 0)
    partial = torch.zeros(shape, dtype=torch.float64, device=means.device)
    lens = _lenses(cam_from_world, inputs[6], width, height)
    project_discs_backward(real)(
        blocks, THREADS, *inputs, lens, degree, *seen, *cotangents, needs_camera, *found, partial
    )  # fmt: skip
    return found, partial.sum(dim=0)


def _lenses(cam_from_world: Tensor, intrinsics: Tensor, width: int, height: int) -> Tensor:
    lens = cam_from_world.new_empty(cam_from_world.shape[0], LENS_VALUES)
    camera_lenses(REAL_OF[lens.dtype])(1, 1, lens, cam_from_world, intrinsics, width, height)
    return lens


@cache
def project_discs_forward(real: type) -> Kernel:
    """Fills the fields of `ProjectedDiscs`; zeros where a disc is culled."""
    vec3, _, _, _, _, direction = view_steps(real)
    shape, cull, place, _ = disc_steps(real)
    in_front = culling(real)[1]
    is_finite = shape_maths(real).is_finite
    color = color_maths(real).color
    zero, half = real(0.0), real(0.5)

    @kernel(
        "project_discs_forward",
        real,
        "real2 real2 real2 real1 real3 real3 real2 real2 real2 real2 int int int real "
        "real3 real3 real2 real2 real3 real3 real3 real3 real3",
    )
    def forward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows,
        lens, width, height, degree, near,
        means2d, maps, depths, opacities, colors, normals, centers, conics, radii,
    ):  # fmt: skip
        n = cuda.grid(1)
        if n >= means.shape[0]:
            return
        outputs = (means2d, maps, depths, opacities, colors, normals, centers, conics, radii)
        clips = clip_planes.shape[0] > 0
        mean = vec3(means, n)
        usable, opacity, _, _, axes, deviations = shape(means, quats, log_scales, logit_opacities, n)
        for c in range(cam_from_world.shape[0]):
            cull(c, n, outputs)
            if not (usable and in_front(c, mean, cam_from_world, near, clip_planes, clips)):
                continue
            place(
                c, n, mean, opacity, axes, deviations, cam_from_world, intrinsics, lens, windows,
                (width, height), near, outputs,
            )  # fmt: skip
            if degree < 0 or not radii[c, n, 0] > zero:
                continue
            (x, y, z), _ = direction(mean, lens, c)
            red, green, blue = color(sh, n, degree, x, y, z)
            if is_finite(abs(red) + abs(green) + abs(blue)):
                colors[c, n, 0] = max(red + half, zero)
                colors[c, n, 1] = max(green + half, zero)
                colors[c, n, 2] = max(blue + half, zero)
            else:
                cull(c, n, outputs)

    return forward


@cache
def project_discs_backward(real: type) -> Kernel:
    """Fills the gradients of the discs, which are zero beforehand, and each camera's sum per block [blocks, C, 12]."""
    vec3, pose, *_ = view_steps(real)
    shape, _, _, place_gradient = disc_steps(real)
    view_gradient, (add_place, add_view) = view_gradients(real), camera_sums(real)
    blend, scaled_sum = vector_maths().blend, vector_maths().scaled_sum
    unit_quat_gradient = shape_maths(real).unit_quat_gradient
    zero, one = real(0.0), real(1.0)

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
        sums = cuda.shared.array((THREADS, POSE), np.float64)
        total = cuda.local.array(POSE, np.float64)
        n, t = cuda.grid(1), cuda.threadIdx.x
        inside = n < means.shape[0]
        # Threads beyond the last disc stay for the sums of the block.
        n = n if inside else means.shape[0] - 1
        mean, g_mean, touched = vec3(means, n), (zero, zero, zero), False
        _, opacity, quat, inverse_norm, axes, deviations = shape(means, quats, log_scales, logit_opacities, n)
        g_opacity, g_u, g_v = zero, zero, zero
        ga_x, ga_y, ga_z = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        for c in range(cam_from_world.shape[0]):
            for i in range(POSE):
                total[i] = 0.0
            if inside and radii[c, n, 0] > zero:
                touched = True
                g_center, g_rows, g_axes, g_scales = place_gradient(
                    c, n, mean, axes, deviations, cam_from_world, intrinsics, lens, maps,
                    g_means2d, g_maps, g_depths, g_normals,
                )  # fmt: skip
                row_x, row_y, row_z, _ = pose(cam_from_world, c)
                g_mean = blend(one, g_mean, one, scaled_sum(g_center, row_x, row_y, row_z))
                ga_x, ga_y = blend(one, ga_x, one, g_axes[0]), blend(one, ga_y, one, g_axes[1])
                ga_z = blend(one, ga_z, one, g_axes[2])
                g_u, g_v, g_opacity = g_u + g_scales[0], g_v + g_scales[1], g_opacity + g_opacities[c, n]
                if needs_camera:
                    add_place(total, g_rows, g_center, mean)
                if degree >= 0:
                    g_color = g_colors[c, n, 0], g_colors[c, n, 1], g_colors[c, n, 2]
                    g_view = view_gradient(sh, n, degree, mean, lens, c, g_color, g_sh)
                    g_mean = blend(one, g_mean, one, g_view)
                    if needs_camera:
                        add_view(total, cam_from_world, c, g_view)
            if needs_camera:
                for i in range(POSE):
                    sums[t, i] = total[i]
                cuda.syncthreads()
                if t < POSE:
                    block_sum = 0.0
                    for j in range(THREADS):
                        block_sum += sums[j, t]
                    partial[cuda.blockIdx.x, c, t] = block_sum
                cuda.syncthreads()
        if not (inside and touched):
            return
        g_means[n, 0], g_means[n, 1], g_means[n, 2] = g_mean
        g_logit_opacities[n] = g_opacity * opacity * (one - opacity)
        g_log_scales[n, 0], g_log_scales[n, 1] = g_u, g_v
        g_quats[n, 0], g_quats[n, 1], g_quats[n, 2], g_quats[n, 3] = unit_quat_gradient(
            quat, inverse_norm, ga_x, ga_y, ga_z
        )

    return backward
