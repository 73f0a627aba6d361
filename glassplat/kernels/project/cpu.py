"""Projection on the CPU: chunks of Gaussians, every camera of the batch while a chunk is at hand.

Chunks have a fixed size, whatever the number of threads. Places come first and colours second: coefficients are most of
a Gaussian's memory, and a loop that only fetches them lets the processor wait for several at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, inlined, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.maths.harmonics import color_maths
from glassplat.kernels.maths.projection import ALPHA_MIN, LOW_PASS, screen_maths, shape_maths, vector_maths
from glassplat.kernels.project.cpu_backward import project_backward
from glassplat.kernels.project.cpu_view import CHUNK, LENS_VALUES, view_steps
from glassplat.kernels.tensor_checks import REAL_OF


def project(inputs: Sequence[Tensor], width: int, height: int, *, degree: int, near: float) -> tuple[Tensor, ...]:
    """Fields of `Projected` from raw Gaussians, poses, intrinsics, clip planes and windows; degree -1 is no colour."""
    means, cam_from_world = inputs[0], inputs[5]
    real, leading = REAL_OF[means.dtype], (cam_from_world.shape[0], means.shape[0])
    outputs = tuple(means.new_empty(*leading, *rest) for rest in ((2,), (3,), (), (), (3,), (2,)))
    project_forward(real)(
        *(tensor.numpy() for tensor in inputs), real(width), real(height), degree, real(near),
        *(tensor.numpy() for tensor in outputs),
    )  # fmt: skip
    return outputs


def project_gradients(
    inputs: Sequence[Tensor], width: int, height: int, degree: int,
    *, seen: tuple[Tensor, Tensor], cotangents: Sequence[Tensor], needs_camera: bool,
    known: list[Tensor] | None = None,
) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """Gradients of raw Gaussians and of each camera [C, 12]; `seen` are the radii and conics of the forward pass.

    Those of the Gaussians are added to what is `known`, in place.
    """
    real = REAL_OF[inputs[0].dtype]
    found = [torch.empty_like(tensor) for tensor in inputs[:5]] if known is None else known
    cameras = torch.zeros(inputs[5].shape[0], 12, dtype=torch.float64)
    project_backward(real)(
        *(tensor.numpy() for tensor in inputs), real(width), real(height), degree,
        *(tensor.numpy() for tensor in (*seen, *cotangents)), needs_camera, known is None,
        *(tensor.numpy() for tensor in (*found, cameras)),
    )  # fmt: skip
    return found, cameras


def placing(real: type) -> Callable[..., Any]:
    """One Gaussian in one camera: fills everything but the colour, where it is visible."""
    _, pose, _, view, *_ = view_steps(real)
    dot = vector_maths().dot
    half_extents = screen_maths(real).half_extents
    is_finite = shape_maths(real).is_finite
    zero, one = real(0.0), real(1.0)

    @inlined
    def place(
        n, c, mean, opacity, axes, cam_from_world, intrinsics, lens, windows,
        means2d, conics, depths, opacities, radii,
    ):  # fmt: skip
        row_x, row_y, row_z, offset = pose(cam_from_world, c)
        depth = dot(row_z, mean) + offset[2]
        position = dot(row_x, mean) + offset[0], dot(row_y, mean) + offset[1], depth
        tangent, _, _, _, covariance = view((row_x, row_y, row_z), position, axes, intrinsics, lens, c)
        xx, xy, yy, determinant = covariance
        u = intrinsics[c, 0] * tangent[0] + intrinsics[c, 2]
        v = intrinsics[c, 1] * tangent[1] + intrinsics[c, 3]
        reach_x, reach_y = half_extents(xx, yy, opacity)
        # Written so that NaN fails every comparison and the Gaussian stays culled.
        across = u + reach_x > windows[c, 0] and u - reach_x < windows[c, 2]
        down = v + reach_y > windows[c, 1] and v - reach_y < windows[c, 3]
        if across and down and reach_x > zero and is_finite(determinant) and is_finite(depth):
            inverse = one / determinant
            means2d[c, n, 0], means2d[c, n, 1] = u, v
            conics[c, n, 0], conics[c, n, 1], conics[c, n, 2] = yy * inverse, -xy * inverse, xx * inverse
            depths[c, n], opacities[c, n] = depth, opacity
            radii[c, n, 0], radii[c, n, 1] = reach_x, reach_y

    return place


def culling(real: type) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """Writing zeros for one Gaussian in one camera, whether it is on the kept sides, and whether it may show at all."""
    vec3, pose, *_ = view_steps(real)
    dot = vector_maths().dot
    zero, one, low_pass = real(0.0), real(1.0), real(LOW_PASS)
    # A coverage of at most 1 sinks to ALPHA_MIN within this squared number of standard deviations; a percent is slack.
    most_deviations = real(1.01 * 2.0 * math.log(1.0 / ALPHA_MIN))

    @inlined
    def cull(n, c, means2d, conics, depths, opacities, colors, radii):
        depths[c, n] = opacities[c, n] = zero
        means2d[c, n, 0] = means2d[c, n, 1] = radii[c, n, 0] = radii[c, n, 1] = zero
        for j in range(3):
            conics[c, n, j] = colors[c, n, j] = zero

    @inlined
    def in_front(c, mean, cam_from_world, near, clip_planes, clips):
        row_z = cam_from_world[c, 2, 0], cam_from_world[c, 2, 1], cam_from_world[c, 2, 2]
        if not dot(row_z, mean) + cam_from_world[c, 2, 3] > near:
            return False
        return not clips or dot(vec3(clip_planes, c), mean) + clip_planes[c, 3] > zero

    @inlined
    def may_show(n, c, mean, log_scales, cam_from_world, intrinsics, lens, near, clip_planes, clips, windows):
        """Whether a Gaussian is on the kept sides, and a sphere around it comes near the window: cheap and safe."""
        if not in_front(c, mean, cam_from_world, near, clip_planes, clips):
            return False
        row_x, row_y, row_z, offset = pose(cam_from_world, c)
        depth = dot(row_z, mean) + offset[2]
        inverse_depth = one / depth
        u = intrinsics[c, 0] * (dot(row_x, mean) + offset[0]) * inverse_depth + intrinsics[c, 2]
        v = intrinsics[c, 1] * (dot(row_y, mean) + offset[1]) * inverse_depth + intrinsics[c, 3]
        past_x, past_y = max(windows[c, 0] - u, u - windows[c, 2]), max(windows[c, 1] - v, v - windows[c, 3])
        size = math.exp(max(log_scales[n, 0], log_scales[n, 1], log_scales[n, 2])) * inverse_depth
        wide, high = size * intrinsics[c, 0] * lens[c, 7], size * intrinsics[c, 1] * lens[c, 8]
        # Written so that NaN leaves the decision to the exact test.
        beside = past_x > zero and past_x * past_x > most_deviations * (wide * wide + low_pass)
        return not (beside or (past_y > zero and past_y * past_y > most_deviations * (high * high + low_pass)))

    return cull, in_front, may_show


@cache
def project_forward(real: type) -> Kernel:
    """Fills means2d, conics, depths, opacities, colors and radii; zeros where a Gaussian is culled."""
    vec3, _, shape, _, fill_lenses, direction = view_steps(real)
    cull, _, may_show = culling(real)
    place = placing(real)
    is_finite = shape_maths(real).is_finite
    color = color_maths(real).color
    zero, half, candidate = real(0.0), real(0.5), real(-1.0)
    chunk_size = CHUNK

    @kernel("project_forward", real)
    def forward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows,
        width, height, degree, near, means2d, conics, depths, opacities, colors, radii,
    ):  # fmt: skip
        count, num_cameras = means.shape[0], cam_from_world.shape[0]
        lens = np.empty((num_cameras, LENS_VALUES), real)
        fill_lenses(lens, cam_from_world, intrinsics, width, height)
        clips = clip_planes.shape[0] > 0
        num_chunks = (count + chunk_size - 1) // chunk_size
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            begin, end = chunk * chunk_size, min(count, (chunk + 1) * chunk_size)
            for n in range(begin, end):
                mean = vec3(means, n)
                wanted = False
                for c in range(num_cameras):
                    cull(n, c, means2d, conics, depths, opacities, colors, radii)
                    if may_show(
                        n, c, mean, log_scales, cam_from_world, intrinsics, lens, near, clip_planes, clips, windows
                    ):
                        radii[c, n, 0] = candidate
                        wanted = True
                if not wanted:
                    continue
                usable, opacity, _, _, axes = shape(means, quats, log_scales, logit_opacities, n)
                for c in range(num_cameras):
                    if not radii[c, n, 0] < zero:
                        continue
                    radii[c, n, 0] = zero
                    if usable:
                        place(
                            n, c, mean, opacity, axes, cam_from_world, intrinsics, lens, windows,
                            means2d, conics, depths, opacities, radii,
                        )  # fmt: skip
            for c in range(num_cameras if degree >= 0 else 0):
                for n in range(begin, end):
                    if not radii[c, n, 0] > zero:
                        continue
                    (x, y, z), _ = direction(vec3(means, n), lens, c)
                    red, green, blue = color(sh, n, degree, x, y, z)
                    if is_finite(abs(red) + abs(green) + abs(blue)):
                        colors[c, n, 0] = max(red + half, zero)
                        colors[c, n, 1] = max(green + half, zero)
                        colors[c, n, 2] = max(blue + half, zero)
                    else:
                        cull(n, c, means2d, conics, depths, opacities, colors, radii)

    return forward
