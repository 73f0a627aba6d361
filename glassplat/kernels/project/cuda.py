"""Projection on the GPU: one thread for each Gaussian, which looks at it through every camera of the batch."""

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
from glassplat.kernels.project.gradient_steps import (
    add_mean,
    camera_sums,
    place_gradients,
    shape_gradients,
    view_gradients,
)
from glassplat.kernels.project.steps import culling, placing
from glassplat.kernels.records import REAL_OF

THREADS = 128
POSE = 12
"""Entries of a camera's gradient: rows of (3x3 block, translation)."""


def project(inputs: Sequence[Tensor], width: int, height: int, *, degree: int, near: float) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.project.cpu.project`."""
    means, cam_from_world = inputs[0], inputs[5]
    real, count, num_cameras = REAL_OF[means.dtype], means.shape[0], cam_from_world.shape[0]
    outputs = tuple(means.new_empty(num_cameras, count, *rest) for rest in ((2,), (3,), (), (), (3,), (2,)))
    lens = _lenses(cam_from_world, inputs[6], width, height)
    project_forward(real)(blocks_for(count, THREADS), THREADS, *inputs, lens, degree, near, *outputs)
    return outputs


def project_gradients(
    inputs: Sequence[Tensor], width: int, height: int, degree: int,
    *, seen: tuple[Tensor, Tensor], cotangents: Sequence[Tensor], needs_camera: bool,
    known: list[Tensor] | None = None,
) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """As `glassplat.kernels.project.cpu.project_gradients`."""
    means, cam_from_world = inputs[0], inputs[5]
    real, num_cameras = REAL_OF[means.dtype], cam_from_world.shape[0]
    blocks = blocks_for(means.shape[0], THREADS)
    # Added to, and to clear them all at once is faster than one Gaussian at a time.
    found = [torch.zeros_like(tensor) for tensor in inputs[:5]] if known is None else known
    shape = (blocks, num_cameras, POSE) if needs_camera else (0, 0, 0)
    partial = torch.zeros(shape, dtype=torch.float64, device=means.device)
    lens = _lenses(cam_from_world, inputs[6], width, height)
    project_backward(real)(
        blocks, THREADS, *inputs, lens, degree, *seen, *cotangents, needs_camera, *found, partial
    )  # fmt: skip
    return found, partial.sum(dim=0)


def _lenses(cam_from_world: Tensor, intrinsics: Tensor, width: int, height: int) -> Tensor:
    """Tangent limits and centre of every camera [C, 7]."""
    lens = cam_from_world.new_empty(cam_from_world.shape[0], LENS_VALUES)
    camera_lenses(REAL_OF[lens.dtype])(1, 1, lens, cam_from_world, intrinsics, width, height)
    return lens


@cache
def camera_lenses(real: type) -> Kernel:
    """Fills the lenses of all cameras, of which there are few, in one thread."""
    fill_lenses = view_steps(real).fill_lenses

    @kernel("camera_lenses", real, "real2 real3 real2 real real")
    def lenses(lens, cam_from_world, intrinsics, width, height):
        if cuda.grid(1) == 0:
            fill_lenses(lens, cam_from_world, intrinsics, width, height)

    return lenses


@cache
def project_forward(real: type) -> Kernel:
    """Fills means2d, conics, depths, opacities, colors and radii; zeros where a Gaussian is culled."""
    vec3, _, shape, _, _, direction = view_steps(real)
    cull, in_front, _ = culling(real)
    place = placing(real)
    is_finite = shape_maths(real).is_finite
    color = color_maths(real).color
    zero, half = real(0.0), real(0.5)

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
        if n >= means.shape[0]:
            return
        clips = clip_planes.shape[0] > 0
        mean = vec3(means, n)
        usable, opacity, _, _, axes = shape(means, quats, log_scales, logit_opacities, n)
        for c in range(cam_from_world.shape[0]):
            cull(n, c, means2d, conics, depths, opacities, colors, radii)
            if not (usable and in_front(c, mean, cam_from_world, near, clip_planes, clips)):
                continue
            place(
                n, c, mean, opacity, axes, cam_from_world, intrinsics, lens, windows,
                means2d, conics, depths, opacities, radii,
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
                cull(n, c, means2d, conics, depths, opacities, colors, radii)

    return forward


@cache
def project_backward(real: type) -> Kernel:
    """Adds to the gradients of the Gaussians, and fills of each camera the sum over each block [blocks, C, 12]."""
    vec3, pose, shape, view, *_ = view_steps(real)
    maths = vector_maths()
    dot, blend, scaled_sum = maths.dot, maths.blend, maths.scaled_sum
    place_gradient, view_gradient = place_gradients(real), view_gradients(real)
    add_shape_gradient = shape_gradients(real)
    add_place, add_view = camera_sums(real)
    zero, one = real(0.0), real(1.0)

    @kernel(
        "project_backward",
        real,
        "real2 real2 real2 real1 real3 real3 real2 real2 int real3 real3 "
        "real3 real3 real2 real2 real3 bool real2 real2 real2 real1 real3 double3",
    )
    def backward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, lens, degree, radii, conics,
        g_means2d, g_conics, g_depths, g_opacities, g_colors, needs_camera,
        g_means, g_quats, g_log_scales, g_logit_opacities, g_sh, partial,
    ):  # fmt: skip
        sums = cuda.shared.array((THREADS, POSE), np.float64)
        total = cuda.local.array(POSE, np.float64)
        n, t = cuda.grid(1), cuda.threadIdx.x
        inside = n < means.shape[0]
        # Threads beyond the last Gaussian stay for the sums of the block.
        n = n if inside else means.shape[0] - 1
        mean, g_mean, touched = vec3(means, n), (zero, zero, zero), False
        _, opacity, quat, inverse_norm, axes = shape(means, quats, log_scales, logit_opacities, n)
        g_opacity, ga_x, ga_y, ga_z = zero, (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        for c in range(cam_from_world.shape[0]):
            for i in range(POSE):
                total[i] = 0.0
            if inside and radii[c, n, 0] > zero:
                touched = True
                g_color = g_colors[c, n, 0], g_colors[c, n, 1], g_colors[c, n, 2]
                if degree >= 0 and (g_color[0] != zero or g_color[1] != zero or g_color[2] != zero):
                    g_view = view_gradient(sh, n, degree, mean, lens, c, g_color, g_sh)
                    g_mean = blend(one, g_mean, one, g_view)
                    if needs_camera:
                        add_view(total, cam_from_world, c, g_view)
                row_x, row_y, row_z, offset = pose(cam_from_world, c)
                rows = (row_x, row_y, row_z)
                position = dot(row_x, mean) + offset[0], dot(row_y, mean) + offset[1], dot(row_z, mean) + offset[2]
                seen = view(rows, position, axes, intrinsics, lens, c)
                g_position, g_rows, g_axes = place_gradient(
                    rows, position, seen, axes, intrinsics, c, (g_means2d[c, n, 0], g_means2d[c, n, 1]),
                    (g_conics[c, n, 0], g_conics[c, n, 1], g_conics[c, n, 2]), g_depths[c, n],
                    (conics[c, n, 0], conics[c, n, 1], conics[c, n, 2]),
                )  # fmt: skip
                g_mean = blend(one, g_mean, one, scaled_sum(g_position, row_x, row_y, row_z))
                ga_x, ga_y = blend(one, ga_x, one, g_axes[0]), blend(one, ga_y, one, g_axes[1])
                ga_z = blend(one, ga_z, one, g_axes[2])
                g_opacity += g_opacities[c, n]
                if needs_camera:
                    add_place(total, g_rows, g_position, mean)
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
        if touched:
            add_mean(g_means, n, g_mean)
            add_shape_gradient(
                n, opacity, quat, inverse_norm, axes, g_opacity, (ga_x, ga_y, ga_z),
                g_quats, g_log_scales, g_logit_opacities,
            )  # fmt: skip

    return backward
