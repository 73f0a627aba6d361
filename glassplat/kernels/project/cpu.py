"""Projection on the CPU: chunks of Gaussians into every camera of the batch.

Chunks have a fixed size, independent of the number of threads. In each chunk, the Gaussians that may be visible are
listed first, then those that are, sixteen at once in SIMD lanes. Colours come last, because coefficients are most of a
Gaussian's memory. The backward pass uses the same chunks. Gradients of the cameras are summed per chunk and then over
chunks in order, so that results do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, even_stride, inlined, kernel
from glassplat.kernels.backend.cpu_vector import (
    absolute,
    bits_of,
    lowest_bit,
    maximum,
    store,
    store_all,
    transpose,
)
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.disc import MAP
from glassplat.kernels.maths.projection import build_half_extents
from glassplat.kernels.project import cpu_lanes as lanes
from glassplat.kernels.project import steps
from glassplat.kernels.project.cpu_lanes import COLUMNS, LANES, full, gather, gather_shapes, load, load_rows
from glassplat.kernels.project.disc_steps import discs
from glassplat.kernels.project.steps import CHUNK, LENS_VALUES, vec3
from glassplat.kernels.records import REAL_OF

WIDTHS, DISC_WIDTHS = ((2,), (3,), (), (), (3,), (2,)), ((2,), (MAP,), (), (), (3,), (3,), (2,), (3,), (2,))
"""Trailing dimensions of the fields of `Projected` and of `ProjectedDiscs`."""


def new_outputs(inputs: Sequence[Tensor], widths: Sequence[tuple[int, ...]]) -> tuple[Tensor, ...]:
    """Uninitialised tensors for the results of a projection."""
    means, cam_from_world = inputs[0], inputs[5]
    return tuple(means.new_empty(cam_from_world.shape[0], means.shape[0], *rest) for rest in widths)


def project_discs(inputs: Sequence[Tensor], width: int, height: int, *, degree: int, near: float) -> tuple[Tensor, ...]:
    """Fields of `ProjectedDiscs` from raw discs, poses, intrinsics, clip planes, windows; degree -1 skips colours."""
    real, outputs = REAL_OF[inputs[0].dtype], new_outputs(inputs, DISC_WIDTHS)
    project_discs_forward(real)(*inputs, real(width), real(height), degree, real(near), outputs)
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
        *inputs, real(width), real(height), degree, *seen, tuple(cotangents), needs_camera, *found, cameras
    )
    return found, cameras


@cache
def project_discs_forward(real: type) -> Kernel:
    """Fills the fields of `ProjectedDiscs`; zeros where a disc is culled."""
    fill_lenses, project, chunk_size = steps.build_fill_lenses(real), steps.build_project(real, discs(real)), CHUNK

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
    """Fills the gradients, initially zero, of one disc from all cameras."""
    footprint, zero = discs(real), real(0.0)
    shape, finish, project_back = footprint.shape, footprint.finish, steps.build_project_back(real, footprint)

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
    fill_lenses, disc_backward = steps.build_fill_lenses(real), _disc_backward(real)
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


__all__ = ["project", "project_discs", "project_discs_gradients", "project_gradients"]

OWN, SHARED = 11, 12
"""Number of gradients of a Gaussian without its coefficients, and of its contributions to a camera's gradient."""


def _place_backward(real: type) -> Scalar:
    place_gradient = lanes.place_gradient_of(real)

    @inlined
    def place_backward(
        listed, shown, columns, c, means, quats, log_scales, logit_opacities, cam_from_world, intrinsics, lens,
        g_means2d, g_conics, g_depths, g_opacities, needs_camera, total,
        g_means, g_quats, g_log_scales, g_logit_opacities,
    ):  # fmt: skip
        """Adds the gradients, other than those of colours, of the listed Gaussians; `columns` is scratch."""
        for first in range(0, shown, LANES):
            last = min(first + LANES, shown) - 1
            gather_shapes(columns, listed, first, last, means, quats, log_scales, logit_opacities)
            for i in range(LANES):
                n = listed[min(first + i, last)]
                for k in range(3):
                    columns[(13 + k) * LANES + i] = g_conics[c, n, k]
                columns[11 * LANES + i], columns[12 * LANES + i] = g_means2d[c, n, 0], g_means2d[c, n, 1]
                columns[16 * LANES + i], columns[17 * LANES + i] = g_depths[c, n], g_opacities[c, n]
            own, shared = place_gradient(columns, c, cam_from_world, intrinsics, lens)
            store_all(columns, 0, own)
            store_all(columns, OWN * LANES, shared)
            for i in range(last + 1 - first):
                n = listed[first + i]
                for k in range(3):
                    g_means[n, k] += columns[k * LANES + i]
                    g_log_scales[n, k] += columns[(7 + k) * LANES + i]
                for k in range(4):
                    g_quats[n, k] += columns[(3 + k) * LANES + i]
                g_logit_opacities[n] += columns[10 * LANES + i]
                if needs_camera:
                    for k in range(SHARED):
                        total[k] += np.float64(columns[(OWN + k) * LANES + i])

    return place_backward


@inlined
def _add_coefficients(listed, first, last, table, positions, terms, g_sh, row_size):
    """Adds the second half of the table, one column per coefficient, to `g_sh`, which is flat."""
    whole = COLUMNS * LANES
    if row_size != COLUMNS:
        for i in range(last + 1 - first):
            for k in range(3 * terms):
                g_sh[listed[first + i] * row_size + k] += table[whole + k * LANES + i]
        return
    for i in range(LANES):
        positions[i] = i * LANES
    for begin in range(0, 3 * terms, LANES):
        for k in range(3 * terms, begin + LANES):
            table[whole + k * LANES : whole + (k + 1) * LANES] = 0
        store_all(table, 0, transpose(load_rows(table, positions, whole + begin * LANES)))
        for i in range(last + 1 - first):
            at = listed[first + i] * row_size + begin
            store(g_sh, at, load(g_sh, at) + load(table, i * LANES))


def _color_backward(real: type) -> Scalar:
    color_gradient, zero = lanes.color_gradient_of(real), real(0.0)

    @inlined
    def color_backward(
        listed, shown, columns, table, positions, c, degree, means, sh, row_size, cam_from_world, lens,
        g_colors, needs_camera, total, g_means, g_sh,
    ):  # fmt: skip
        """Adds the gradients of the listed Gaussians' colours; `sh` and `g_sh` are flat; the list is overwritten."""
        touched = 0
        for at in range(shown):
            n = listed[at]
            # Gaussians without a colour gradient, such as occluded ones, are skipped.
            if not (g_colors[c, n, 0] == zero and g_colors[c, n, 1] == zero and g_colors[c, n, 2] == zero):
                listed[touched] = n
                touched += 1
        terms = (degree + 1) * (degree + 1)
        sum_x, sum_y, sum_z = 0.0, 0.0, 0.0
        for first in range(0, touched, LANES):
            last = min(first + LANES, touched) - 1
            gather(columns, 0, listed, first, last, means)
            gather(columns, 3, listed, first, last, g_colors[c])
            lanes.tabulate(table, listed, first, last, terms, sh, row_size, positions)
            x, y, z = color_gradient(table, columns, degree, lens, c)
            store(columns, 0, x)
            store(columns, LANES, y)
            store(columns, 2 * LANES, z)
            _add_coefficients(listed, first, last, table, positions, terms, g_sh, row_size)
            for i in range(last + 1 - first):
                n = listed[first + i]
                for k in range(3):
                    g_means[n, k] += columns[k * LANES + i]
                sum_x += np.float64(columns[i])
                sum_y += np.float64(columns[LANES + i])
                sum_z += np.float64(columns[2 * LANES + i])
        if needs_camera:
            steps.add_view(total, cam_from_world, c, (sum_x, sum_y, sum_z))

    return color_backward


@cache
def project_backward(real: type) -> Kernel:
    """Adds to the gradients of the Gaussians, or fills them if they are `fresh`, and adds to those of the cameras.

    The latter are [C, 12], rows of (3x3 block, translation).
    """
    fill_lenses = steps.build_fill_lenses(real)
    color_backward, place_backward = _color_backward(real), _place_backward(real)
    chunk_size, zero = CHUNK, real(0.0)

    @kernel("project_backward", real)
    def backward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, width, height, degree, radii,
        g_means2d, g_conics, g_depths, g_opacities, g_colors, needs_camera, fresh,
        g_means, g_quats, g_log_scales, g_logit_opacities, g_sh, g_cameras,
    ):  # fmt: skip
        count, num_cameras = means.shape[0], cam_from_world.shape[0]
        num_chunks = (count + chunk_size - 1) // chunk_size
        lens = np.empty((num_cameras, LENS_VALUES), real)
        fill_lenses(lens, cam_from_world, intrinsics, width, height)
        flat_sh, flat_g_sh, row_size = sh.reshape(sh.size), g_sh.reshape(g_sh.size), 3 * sh.shape[1]
        totals = np.zeros((num_chunks, num_cameras, 12))
        stride = even_stride(num_chunks)
        for task in prange(num_chunks):
            chunk = task * stride % num_chunks
            begin, end = chunk * chunk_size, min(count, (chunk + 1) * chunk_size)
            if fresh:
                g_means[begin:end], g_quats[begin:end], g_log_scales[begin:end] = zero, zero, zero
                g_logit_opacities[begin:end], g_sh[begin:end] = zero, zero
            listed, positions = np.empty(chunk_size, np.int64), np.empty(LANES, np.int64)
            columns, table = np.empty((OWN + SHARED) * LANES, real), np.empty(2 * COLUMNS * LANES, real)
            for c in range(num_cameras):
                shown = 0
                for n in range(begin, end):
                    listed[shown] = n
                    shown += radii[c, n, 0] > zero
                place_backward(
                    listed, shown, columns, c, means, quats, log_scales, logit_opacities, cam_from_world, intrinsics,
                    lens, g_means2d, g_conics, g_depths, g_opacities, needs_camera, totals[chunk, c],
                    g_means, g_quats, g_log_scales, g_logit_opacities,
                )  # fmt: skip
                if degree >= 0:
                    color_backward(
                        listed, shown, columns, table, positions, c, degree, means, flat_sh, row_size, cam_from_world,
                        lens, g_colors, needs_camera, totals[chunk, c], g_means, flat_g_sh,
                    )  # fmt: skip
        for chunk in range(num_chunks):
            for c in range(num_cameras):
                for i in range(12):
                    g_cameras[c, i] += totals[chunk, c, i]

    return backward


def project(inputs: Sequence[Tensor], width: int, height: int, *, degree: int, near: float) -> tuple[Tensor, ...]:
    """Fields of `Projected` from raw Gaussians, poses, intrinsics, clip planes and windows; degree -1 skips colours."""
    real, outputs = REAL_OF[inputs[0].dtype], new_outputs(inputs, WIDTHS)
    project_forward(real)(*inputs, real(width), real(height), degree, real(near), *outputs)
    return outputs


def project_gradients(
    inputs: Sequence[Tensor], width: int, height: int, degree: int,
    *, radii: Tensor, cotangents: Sequence[Tensor], needs_camera: bool,
    accumulated: list[Tensor] | None = None,
) -> tuple[list[Tensor], Tensor]:  # fmt: skip
    """Gradients of raw Gaussians and of each camera [C, 12]; `radii` are those of the forward pass.

    Gradients of the Gaussians are added to those in `accumulated`, in place.
    """
    real = REAL_OF[inputs[0].dtype]
    found = [torch.empty_like(tensor) for tensor in inputs[:5]] if accumulated is None else accumulated
    cameras = torch.zeros(inputs[5].shape[0], 12, dtype=torch.float64)
    project_backward(real)(
        *inputs, real(width), real(height), degree, radii, *cotangents, needs_camera, accumulated is None,
        *found, cameras,
    )  # fmt: skip
    return found, cameras


def build_list_candidates(real: type) -> Scalar:
    """Builds the step that lists the Gaussians of a chunk that may be visible in a camera."""
    may_show = lanes.may_show_of(real)

    @inlined
    def list_candidates(
        listed, means, log_scales, ends, begin, end, c, cam_from_world, intrinsics, lens, near, clip_planes, clips,
        windows,
    ):  # fmt: skip
        """Returns the number of candidates; means and log scales are flat, `ends` is scratch."""
        found, count = 0, means.size // 3
        for n in range(begin, end, LANES):
            if n + LANES <= count:
                mean, scales = lanes.load_triples(means, n), lanes.load_triples(log_scales, n)
            else:
                for i in range(3 * LANES):
                    source = min(n + i // 3, count - 1) * 3 + i % 3
                    ends[i], ends[3 * LANES + i] = means[source], log_scales[source]
                mean, scales = lanes.load_triples(ends, 0), lanes.load_triples(ends, LANES)
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


def build_place_listed(real: type) -> Scalar:
    """Builds the step that fills all outputs but the colours, for the visible ones of the listed Gaussians."""
    place, half_extents = lanes.place_of(real), build_half_extents(real)
    zero = real(0.0)
    U, V, XX, XY, YY, DEPTH, OPACITY, WIDE, HIGH = (field * LANES for field in range(9))

    @inlined
    def place_listed(
        listed, found, columns, c, means, quats, log_scales, logit_opacities, cam_from_world, intrinsics, lens, windows,
        means2d, conics, depths, opacities, radii,
    ):  # fmt: skip
        """Returns the number of visible Gaussians and keeps them in the list; `columns` is scratch."""
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


def build_color_listed(real: type) -> Scalar:
    """Builds the step that fills the colours of listed Gaussians; those with a non-finite colour are culled."""
    color, zero, half, largest = lanes.color_of(real), real(0.0), real(0.5), real(np.finfo(real).max)

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
            lanes.tabulate(table, listed, first, last, terms, sh, row_size, positions)
            red, green, blue = color(table, columns, degree, lens, c)
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
                    steps.cull(c, n, (means2d, conics, depths, opacities, colors, radii))

    return color_listed


@cache
def project_forward(real: type) -> Kernel:
    """Fills means2d, conics, depths, opacities, colors and radii; zeros where a Gaussian is culled."""
    fill_lenses = steps.build_fill_lenses(real)
    list_candidates, place_listed = build_list_candidates(real), build_place_listed(real)
    color_listed, zero, chunk_size = build_color_listed(real), real(0.0), CHUNK

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
