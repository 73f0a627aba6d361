"""Gradients of ray tracing on the GPU, with the same bits every time and without atomics.

What each ray meets is written down, ray by ray. A thread for each ray goes through its hits, front to back, adds up the
ray's own gradients, and leaves two numbers at each hit. Then hits are sorted by their Gaussians, and a warp for each
Gaussian works out what its hits give to it, 32 at a time, and adds that up in the order of the rays.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

from numba import cuda
from torch import Tensor

from glassplat.kernels.cpu.jit import inlined
from glassplat.kernels.cuda.launch import Kernel, kernel
from glassplat.kernels.maths.blending import ALPHA_MAX, Scalar
from glassplat.kernels.maths.harmonics import MAX_DEGREE, color_maths
from glassplat.kernels.maths.ray_hit import ray_hit_maths
from glassplat.kernels.trace.steps import ray_reader, shape_reader

WARP = 32
FRAME_AT, OPACITY_AT, GEOMETRY = 3, 12, 13
"""Columns of a row: gradients of mean (3), frame (9) and opacity."""
HARMONICS = (MAX_DEGREE + 1) ** 2
STRIDE = HARMONICS + 1
"""Of shared rows of harmonics, an odd number as that of `GEOMETRY`: lanes that write a column meet different banks."""


class Hits(NamedTuple):
    """What rays meet, ray by ray, from the nearest on.

    offsets [R + 1] int64: where each ray's hits begin.
    met, rays [H] int32: the Gaussian and the ray of a hit.
    alphas, weights [H]: what it covers, and its blending weight.
    pulls [H]: gradient of the objective with respect to its squared distance in deviations.
    """

    offsets: Tensor
    met: Tensor
    rays: Tensor
    alphas: Tensor
    weights: Tensor
    pulls: Tensor


def _color_pull(real: type) -> Scalar:
    """The value of a hit's colour to the objective and the gradient of the unit direction; adds that of harmonics."""
    color, color_gradient = color_maths(real)
    zero, half = real(0.0), real(0.5)

    @inlined
    def pull(sh, g, degree, unit, v_colors, r, weight, v_sh):
        red, green, blue = color(sh, g, degree, unit[0], unit[1], unit[2])
        red, green, blue = red + half, green + half, blue + half
        v_red = v_colors[r, 0] if red > zero else zero
        v_green = v_colors[r, 1] if green > zero else zero
        v_blue = v_colors[r, 2] if blue > zero else zero
        v_color = weight * v_red, weight * v_green, weight * v_blue
        v_unit = color_gradient(sh[g : g + 1], 0, degree, unit[0], unit[1], unit[2], v_color, v_sh)
        return v_red * red + v_green * green + v_blue * blue, v_unit

    return pull


@cache
def trace_pull_rays(real: type, flat: bool) -> Kernel:
    """Fills rays, weights and pulls of hits, and the gradients of origins and directions, zero where nothing is met."""
    ray, shape, color_pull = ray_reader(real), shape_reader(real), _color_pull(real)
    meet, meet_gradient = ray_hit_maths(real, flat)
    zero, half, one, most, nowhere = real(0.0), real(0.5), real(1.0), real(ALPHA_MAX), real("inf")

    @kernel(
        "trace_pull_rays_of_discs" if flat else "trace_pull_rays_of_ellipsoids",
        real,
        "real2 real3 real3 real2 real2 int long1 int1 int1 real1 real1 real1 "
        "real2 real1 real1 real2 real1 real1 real2 real2",
    )
    def pull(
        means, frames, sh, origins, directions, degree, starts, met, hit_rays, met_alphas, weights, pulls,
        colors, alphas, depths, v_colors, v_alphas, v_depths, v_origins, v_directions,
    ):  # fmt: skip
        # Nobody reads it, and the compiler leaves it out.
        v_sh = cuda.local.array((1, HARMONICS, 3), real)
        r = cuda.grid(1)
        if r >= origins.shape[0] or starts[r] == starts[r + 1]:
            return
        o, d, _, length, _ = ray(origins, directions, r)
        unit = d[0] / length, d[1] / length, d[2] / length
        # What is still to come, of the objective: all of it at first.
        behind = v_depths[r] * depths[r]
        for j in range(3):
            behind += v_colors[r, j] * colors[r, j]
        left, end, v_length = one, v_alphas[r] * (one - alphas[r]), zero
        by_origin, by_direction, by_unit = (zero, zero, zero), (zero, zero, zero), (zero, zero, zero)
        for place in range(starts[r], starts[r + 1]):
            g, alpha = met[place], met_alphas[place]
            offset, frame = shape(means, frames, g, o)
            t, q, _ = meet(offset, d, frame)
            weight, value, v_squared = alpha * left, zero, zero
            # On the threshold, another fusing of products and sums may find a disc seen from its edge.
            if t < nowhere:
                if degree >= 0:
                    value, v_unit = color_pull(sh, g, degree, unit, v_colors, r, weight, v_sh)
                    by_unit = by_unit[0] + v_unit[0], by_unit[1] + v_unit[1], by_unit[2] + v_unit[2]
                value += v_depths[r] * (t * length)
                behind -= weight * value
                if alpha < most:
                    v_squared = -half * alpha * (left * value + (end - behind) / (one - alpha))
                v_t = weight * v_depths[r]
                v_length += v_t * t
                v_o, v_d, _ = meet_gradient(offset, d, frame, t, q, v_t * length, v_squared)
                by_origin = by_origin[0] + v_o[0], by_origin[1] + v_o[1], by_origin[2] + v_o[2]
                by_direction = by_direction[0] + v_d[0], by_direction[1] + v_d[1], by_direction[2] + v_d[2]
            hit_rays[place], weights[place], pulls[place] = r, weight, v_squared
            left *= one - alpha
        along = unit[0] * by_unit[0] + unit[1] * by_unit[1] + unit[2] * by_unit[2]
        v_origins[r, 0], v_origins[r, 1], v_origins[r, 2] = by_origin
        v_directions[r, 0] = by_direction[0] + v_length * unit[0] + (by_unit[0] - unit[0] * along) / length
        v_directions[r, 1] = by_direction[1] + v_length * unit[1] + (by_unit[1] - unit[1] * along) / length
        v_directions[r, 2] = by_direction[2] + v_length * unit[2] + (by_unit[2] - unit[2] * along) / length

    return pull


@cache
def trace_pull_gaussians(real: type, flat: bool) -> Kernel:
    """Fills the gradients of Gaussians that rays meet, one block of one warp for each; the others' are zero before."""
    ray, shape, color_pull = ray_reader(real), shape_reader(real), _color_pull(real)
    meet, meet_gradient = ray_hit_maths(real, flat)
    zero, two, nowhere = real(0.0), real(2.0), real("inf")

    @inlined
    def fill(row, offset, d, frame, length, weight, v_depth, v_squared, opacity):
        """The gradients of one hit's mean, frame and opacity."""
        t, q, _ = meet(offset, d, frame)
        if not t < nowhere:
            for j in range(GEOMETRY):
                row[j] = zero
            return
        # Tuples are indexed by constants only: a variable index compiles to a switch.
        v_o, _, v_frame = meet_gradient(offset, d, frame, t, q, weight * v_depth * length, v_squared)
        row[0], row[1], row[2] = -v_o[0], -v_o[1], -v_o[2]
        row[FRAME_AT], row[FRAME_AT + 1], row[FRAME_AT + 2] = v_frame[0]
        row[FRAME_AT + 3], row[FRAME_AT + 4], row[FRAME_AT + 5] = v_frame[1]
        row[FRAME_AT + 6], row[FRAME_AT + 7], row[FRAME_AT + 8] = v_frame[2]
        row[OPACITY_AT] = -two * v_squared / opacity

    @kernel(
        "trace_pull_discs" if flat else "trace_pull_ellipsoids",
        real,
        "real2 real3 real1 real3 real2 real2 int long1 long1 int1 real1 real1 real2 real1 real2 real3 real1 real3",
    )
    def pull(
        means, frames, opacities, sh, origins, directions, degree, order, starts, hit_rays, weights, pulls,
        v_colors, v_depths, v_means, v_frames, v_opacities, v_sh,
    ):  # fmt: skip
        rows = cuda.shared.array((WARP, GEOMETRY), real)
        harmonics = cuda.shared.array((WARP, STRIDE, 3), real)
        g, lane = cuda.blockIdx.x, cuda.threadIdx.x
        begin, end = starts[g], starts[g + 1]
        if begin == end:
            return
        geometry, first_color, second_color = zero, zero, zero
        used = 3 * (degree + 1) * (degree + 1)
        for first in range(begin, end, WARP):
            if first + lane < end:
                hit = order[first + lane]
                r, weight = hit_rays[hit], weights[hit]
                o, d, _, length, _ = ray(origins, directions, r)
                offset, frame = shape(means, frames, g, o)
                fill(rows[lane], offset, d, frame, length, weight, v_depths[r], pulls[hit], opacities[g])
                if degree >= 0:
                    for k in range(HARMONICS):
                        for j in range(3):
                            harmonics[lane, k, j] = zero
                    unit = d[0] / length, d[1] / length, d[2] / length
                    color_pull(sh, g, degree, unit, v_colors, r, weight, harmonics[lane : lane + 1])
            cuda.syncthreads()
            for i in range(min(WARP, end - first)):
                if lane < GEOMETRY:
                    geometry += rows[i, lane]
                if lane < used:
                    first_color += harmonics[i, lane // 3, lane % 3]
                if lane + WARP < used:
                    second_color += harmonics[i, (lane + WARP) // 3, (lane + WARP) % 3]
            cuda.syncthreads()
        if lane < FRAME_AT:
            v_means[g, lane] = geometry
        elif lane < OPACITY_AT:
            v_frames[g, (lane - FRAME_AT) // 3, (lane - FRAME_AT) % 3] = geometry
        elif lane == OPACITY_AT:
            v_opacities[g] = geometry
        if lane < used:
            v_sh[g, lane // 3, lane % 3] = first_color
        if lane + WARP < used:
            v_sh[g, (lane + WARP) // 3, (lane + WARP) % 3] = second_color

    return pull
