"""Projection on the CPU: chunks of Gaussians, in every camera of the batch.

Chunks have a fixed size, whatever the number of threads. Of a chunk the Gaussians that may show are listed first, then
those that do, each time sixteen at once; colours come last, as coefficients are most of a Gaussian's memory.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, even_stride, inlined, kernel
from glassplat.kernels.backend.cpu_vector import absolute, bits_of, lowest_bit, maximum, store, store_all, vector_kind
from glassplat.kernels.maths.projection import screen_maths
from glassplat.kernels.project.cpu_backward import project_backward
from glassplat.kernels.project.cpu_lanes import COLUMNS, LANES, gather, gather_shapes, lane_steps
from glassplat.kernels.project.cpu_view import CHUNK, LENS_VALUES, view_steps
from glassplat.kernels.project.steps import culling
from glassplat.kernels.records import REAL_OF


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


def listing(real: type) -> Callable[..., Any]:
    """The step that lists the Gaussians of a chunk that may show in a camera."""
    load_triples, may_show, *_ = lane_steps(real)

    @inlined
    def list_candidates(
        listed, means, log_scales, ends, begin, end, c, cam_from_world, intrinsics, lens, near, clip_planes, clips,
        windows,
    ):  # fmt: skip
        """Returns how many there are; means and log scales are flat, `ends` is scratch."""
        found, count = 0, means.size // 3
        for n in range(begin, end, LANES):
            if n + LANES <= count:
                mean, scales = load_triples(means, n), load_triples(log_scales, n)
            else:
                for i in range(3 * LANES):
                    source = min(n + i // 3, count - 1) * 3 + i % 3
                    ends[i], ends[3 * LANES + i] = means[source], log_scales[source]
                mean, scales = load_triples(ends, 0), load_triples(ends, LANES)
            bits = may_show(
                c, mean, scales, cam_from_world, intrinsics, lens, near, clip_planes, clips, windows
            )  # fmt: skip
            bits &= (np.int64(1) << min(LANES, end - n)) - 1
            while bits != 0:
                listed[found] = n + lowest_bit(bits)
                bits &= bits - 1
                found += 1
        return found

    return list_candidates


def placing_listed(real: type) -> Callable[..., Any]:
    """The step that fills everything but the colours of those listed that are visible."""
    place, half_extents = lane_steps(real).place, screen_maths(real).half_extents
    zero = real(0.0)
    U, V, XX, XY, YY, DEPTH, OPACITY, WIDE, HIGH = (field * LANES for field in range(9))

    @inlined
    def place_listed(
        listed, found, columns, c, means, quats, log_scales, logit_opacities, cam_from_world, intrinsics, lens, windows,
        means2d, conics, depths, opacities, radii,
    ):  # fmt: skip
        """Returns how many there are, which the list holds then; `columns` is scratch."""
        shown = 0
        for first in range(0, found, LANES):
            last = min(first + LANES, found) - 1
            gather_shapes(columns, listed, first, last, means, quats, log_scales, logit_opacities)
            values, bits = place(columns, c, cam_from_world, intrinsics, lens)
            store_all(columns, 0, values)
            bits &= (np.int64(1) << (last + 1 - first)) - 1
            while bits != 0:
                i = lowest_bit(bits)
                bits &= bits - 1
                u, v, opacity = columns[U + i], columns[V + i], columns[OPACITY + i]
                reach_x, reach_y = half_extents(columns[WIDE + i], columns[HIGH + i], opacity)
                # Written so that NaN fails every comparison and the Gaussian stays culled.
                across = u + reach_x > windows[c, 0] and u - reach_x < windows[c, 2]
                down = v + reach_y > windows[c, 1] and v - reach_y < windows[c, 3]
                if across and down and reach_x > zero:
                    n = listed[first + i]
                    means2d[c, n, 0], means2d[c, n, 1] = u, v
                    conics[c, n, 0], conics[c, n, 1] = columns[XX + i], columns[XY + i]
                    conics[c, n, 2] = columns[YY + i]
                    depths[c, n], opacities[c, n] = columns[DEPTH + i], opacity
                    radii[c, n, 0], radii[c, n, 1] = reach_x, reach_y
                    listed[shown] = n
                    shown += 1
        return shown

    return place_listed


def coloring(real: type) -> Callable[..., Any]:
    """The step that fills the colours of those listed; whoever has none that is finite is culled."""
    *_, tabulate, color = lane_steps(real)
    cull, full = culling(real)[0], vector_kind(real, LANES).full
    zero, half, largest = real(0.0), real(0.5), real(np.finfo(real).max)

    @inlined
    def color_listed(
        listed, shown, columns, table, positions, c, degree, means, sh, row_size, lens,
        means2d, conics, depths, opacities, colors, radii,
    ):  # fmt: skip
        """`sh` is flat, with rows of `row_size`; columns, table and positions are scratch."""
        terms = (degree + 1) * (degree + 1)
        for first in range(0, shown, LANES):
            last = min(first + LANES, shown) - 1
            gather(columns, 0, listed, first, last, means)
            tabulate(table, listed, first, last, terms, sh, row_size, positions)
            red, green, blue = color(table, columns, 0, degree, lens, c)
            bits = bits_of(absolute(red) + absolute(green) + absolute(blue) <= largest)
            none = full(zero)
            store(columns, 0, maximum(red + half, none))
            store(columns, LANES, maximum(green + half, none))
            store(columns, 2 * LANES, maximum(blue + half, none))
            for i in range(last + 1 - first):
                n = listed[first + i]
                if (bits >> i) & 1:
                    colors[c, n, 0], colors[c, n, 1] = columns[i], columns[LANES + i]
                    colors[c, n, 2] = columns[2 * LANES + i]
                else:
                    cull(n, c, means2d, conics, depths, opacities, colors, radii)

    return color_listed


@cache
def project_forward(real: type) -> Kernel:
    """Fills means2d, conics, depths, opacities, colors and radii; zeros where a Gaussian is culled."""
    fill_lenses = view_steps(real).fill_lenses
    list_candidates, place_listed, color_listed = listing(real), placing_listed(real), coloring(real)
    zero, chunk_size = real(0.0), CHUNK

    @kernel("project_forward", real)
    def forward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, clip_planes, windows,
        width, height, degree, near, means2d, conics, depths, opacities, colors, radii,
    ):  # fmt: skip
        count, num_cameras = means.shape[0], cam_from_world.shape[0]
        lens = np.empty((num_cameras, LENS_VALUES), real)
        fill_lenses(lens, cam_from_world, intrinsics, width, height)
        clips = clip_planes.shape[0] > 0
        flat_means, flat_scales = means.reshape(means.size), log_scales.reshape(log_scales.size)
        flat_sh, row_size = sh.reshape(sh.size), 3 * sh.shape[1]
        num_chunks = (count + chunk_size - 1) // chunk_size
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            begin, end = chunk * chunk_size, min(count, (chunk + 1) * chunk_size)
            listed, positions = np.empty(chunk_size, np.int64), np.empty(LANES, np.int64)
            columns, table = np.empty(11 * LANES, real), np.empty(2 * COLUMNS * LANES, real)
            for c in range(num_cameras):
                means2d[c, begin:end], conics[c, begin:end], colors[c, begin:end] = zero, zero, zero
                depths[c, begin:end], opacities[c, begin:end], radii[c, begin:end] = zero, zero, zero
                found = list_candidates(
                    listed, flat_means, flat_scales, columns, begin, end, c, cam_from_world, intrinsics, lens, near,
                    clip_planes, clips, windows,
                )  # fmt: skip
                shown = place_listed(
                    listed, found, columns, c, means, quats, log_scales, logit_opacities, cam_from_world, intrinsics,
                    lens, windows, means2d, conics, depths, opacities, radii,
                )  # fmt: skip
                if degree >= 0:
                    color_listed(
                        listed, shown, columns, table, positions, c, degree, means, flat_sh, row_size, lens,
                        means2d, conics, depths, opacities, colors, radii,
                    )  # fmt: skip

    return forward
