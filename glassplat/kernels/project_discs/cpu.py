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
from glassplat.kernels.maths.harmonics import color_maths
from glassplat.kernels.maths.projection import shape_maths, vector_maths
from glassplat.kernels.project.cpu_view import CHUNK, LENS_VALUES, view_steps
from glassplat.kernels.project.gradient_steps import camera_sums, view_gradients
from glassplat.kernels.project.steps import culling
from glassplat.kernels.project_discs.steps import disc_steps
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
    vec3, _, _, _, fill_lenses, direction = view_steps(real)
    shape, cull, place, _ = disc_steps(real)
    in_front = culling(real)[1]
    is_finite = shape_maths(real).is_finite
    color = color_maths(real).color
    zero, half = real(0.0), real(0.5)
    chunk_size = CHUNK

    @kernel("project_discs_forward", real)
    def forward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows,
        width, height, degree, near, outputs,
    ):  # fmt: skip
        count, num_cameras = means.shape[0], cam_from_world.shape[0]
        lens = np.empty((num_cameras, LENS_VALUES), real)
        fill_lenses(lens, cam_from_world, intrinsics, width, height)
        clips = clip_planes.shape[0] > 0
        colors, radii = outputs[4], outputs[8]
        num_chunks = (count + chunk_size - 1) // chunk_size
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            for n in range(chunk * chunk_size, min(count, (chunk + 1) * chunk_size)):
                mean, wanted = vec3(means, n), False
                for c in range(num_cameras):
                    cull(c, n, outputs)
                    wanted |= in_front(c, mean, cam_from_world, near, clip_planes, clips)
                if not wanted:
                    continue
                usable, opacity, _, _, axes, deviations = shape(means, quats, log_scales, logit_opacities, n)
                for c in range(num_cameras):
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


def _disc_backward(real: type) -> Scalar:
    """One disc in all cameras: fills its gradients, which are zero beforehand."""
    vec3, pose, *_ = view_steps(real)
    shape, _, _, place_gradient = disc_steps(real)
    view_gradient, (add_place, add_view) = view_gradients(real), camera_sums(real)
    blend, scaled_sum = vector_maths().blend, vector_maths().scaled_sum
    unit_quat_gradient = shape_maths(real).unit_quat_gradient
    zero, one = real(0.0), real(1.0)

    @inlined
    def disc_backward(
        n, means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, lens, degree, radii, maps,
        cotangents, needs_camera, total, g_means, g_quats, g_log_scales, g_logit_opacities, g_sh,
    ):  # fmt: skip
        g_means2d, g_maps, g_depths, g_opacities, g_colors, g_normals = cotangents
        mean, g_mean, touched = vec3(means, n), (zero, zero, zero), False
        _, opacity, quat, inverse_norm, axes, deviations = shape(means, quats, log_scales, logit_opacities, n)
        g_opacity, g_u, g_v = zero, zero, zero
        ga_x, ga_y, ga_z = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        for c in range(cam_from_world.shape[0]):
            if not radii[c, n, 0] > zero:
                continue
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
                add_place(total[c], g_rows, g_center, mean)
            if degree >= 0:
                g_view = view_gradient(sh, n, degree, mean, lens, c, vec3(g_colors[c], n), g_sh)
                g_mean = blend(one, g_mean, one, g_view)
                if needs_camera:
                    add_view(total[c], cam_from_world, c, g_view)
        if touched:
            g_means[n, 0], g_means[n, 1], g_means[n, 2] = g_mean
            g_logit_opacities[n] = g_opacity * opacity * (one - opacity)
            g_log_scales[n, 0], g_log_scales[n, 1] = g_u, g_v
            g_quats[n, 0], g_quats[n, 1], g_quats[n, 2], g_quats[n, 3] = unit_quat_gradient(
                quat, inverse_norm, ga_x, ga_y, ga_z
            )

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
                    n, means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, lens, degree,
                    radii, maps, cotangents, needs_camera, totals[chunk],
                    g_means, g_quats, g_log_scales, g_logit_opacities, g_sh,
                )  # fmt: skip
        for chunk in range(num_chunks):
            for c in range(num_cameras):
                for i in range(12):
                    g_cameras[c, i] += totals[chunk, c, i]

    return backward
