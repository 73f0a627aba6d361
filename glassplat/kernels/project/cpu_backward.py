"""The adjoint of the projection on the CPU, over the same chunks of Gaussians, sixteen of them at once.

Gradients that many Gaussians share (those of the cameras) are summed per chunk and then over chunks in order, so that
results do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numba import prange

from glassplat.kernels.backend.cpu import Kernel, even_stride, inlined, kernel
from glassplat.kernels.backend.cpu_vector import row_loader, store, store_all, transposed, vector_kind
from glassplat.kernels.project.cpu_backward_lanes import gradient_steps
from glassplat.kernels.project.cpu_lanes import COLUMNS, LANES, gather, gather_shapes, lane_steps
from glassplat.kernels.project.cpu_view import CHUNK, LENS_VALUES, view_steps
from glassplat.kernels.project.gradient_steps import camera_sums

OWN, SHARED = 11, 12
"""Gradients of a Gaussian without its coefficients, and what it adds to those of a camera."""


def _place_backward(real: type) -> Callable[..., Any]:
    place_gradient = gradient_steps(real).place_gradient

    @inlined
    def place_backward(
        listed, shown, columns, c, means, quats, log_scales, logit_opacities, cam_from_world, intrinsics, lens, conics,
        g_means2d, g_conics, g_depths, g_opacities, needs_camera, total,
        g_means, g_quats, g_log_scales, g_logit_opacities,
    ):  # fmt: skip
        """Adds to all gradients but that of the colour, of those listed; `columns` is scratch."""
        for first in range(0, shown, LANES):
            last = min(first + LANES, shown) - 1
            gather_shapes(columns, listed, first, last, means, quats, log_scales, logit_opacities)
            for i in range(LANES):
                n = listed[min(first + i, last)]
                for k in range(3):
                    columns[(13 + k) * LANES + i], columns[(18 + k) * LANES + i] = g_conics[c, n, k], conics[c, n, k]
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


def _add_coefficients(real: type) -> Callable[..., Any]:
    load_rows, load, whole = row_loader(real, LANES), vector_kind(real, LANES).load, COLUMNS * LANES

    @inlined
    def add_coefficients(listed, first, last, table, positions, terms, g_sh, row_size):
        """Adds the second half of the table, a column for each of the first coefficients; `g_sh` is flat."""
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
            store_all(table, 0, transposed(load_rows(table, positions, whole + begin * LANES)))
            for i in range(last + 1 - first):
                at = listed[first + i] * row_size + begin
                store(g_sh, at, load(g_sh, at) + load(table, i * LANES))

    return add_coefficients


def _color_backward(real: type) -> Callable[..., Any]:
    tabulate, color_gradient = lane_steps(real).tabulate, gradient_steps(real).color_gradient
    add_coefficients, add_view = _add_coefficients(real), camera_sums(real)[1]
    zero, whole = real(0.0), COLUMNS * LANES

    @inlined
    def color_backward(
        listed, shown, columns, table, positions, c, degree, means, sh, row_size, cam_from_world, lens,
        g_colors, needs_camera, total, g_means, g_sh,
    ):  # fmt: skip
        """Adds what comes from the colours of those listed; `sh` and `g_sh` are flat, the list is used up."""
        touched = 0
        for at in range(shown):
            n = listed[at]
            # A Gaussian that no pixel saw, as behind others, has nothing to pass on.
            if not (g_colors[c, n, 0] == zero and g_colors[c, n, 1] == zero and g_colors[c, n, 2] == zero):
                listed[touched] = n
                touched += 1
        terms = (degree + 1) * (degree + 1)
        sum_x, sum_y, sum_z = 0.0, 0.0, 0.0
        for first in range(0, touched, LANES):
            last = min(first + LANES, touched) - 1
            gather(columns, 0, listed, first, last, means)
            gather(columns, 3, listed, first, last, g_colors[c])
            tabulate(table, listed, first, last, terms, sh, row_size, positions)
            x, y, z = color_gradient(table, whole, columns, degree, lens, c)
            store(columns, 0, x)
            store(columns, LANES, y)
            store(columns, 2 * LANES, z)
            add_coefficients(listed, first, last, table, positions, terms, g_sh, row_size)
            for i in range(last + 1 - first):
                n = listed[first + i]
                for k in range(3):
                    g_means[n, k] += columns[k * LANES + i]
                sum_x += np.float64(columns[i])
                sum_y += np.float64(columns[LANES + i])
                sum_z += np.float64(columns[2 * LANES + i])
        if needs_camera:
            add_view(total, cam_from_world, c, (sum_x, sum_y, sum_z))

    return color_backward


@cache
def project_backward(real: type) -> Kernel:
    """Adds to the gradients of the Gaussians, or fills them where they are `fresh`, and adds to those of the cameras.

    These are [C, 12], rows of (3x3 block, translation).
    """
    fill_lenses = view_steps(real).fill_lenses
    color_backward, place_backward = _color_backward(real), _place_backward(real)
    chunk_size, zero = CHUNK, real(0.0)

    @kernel("project_backward", real)
    def backward(
        means, quats, log_scales, logit_opacities, sh, cam_from_world, intrinsics, width, height, degree, radii, conics,
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
                    lens, conics, g_means2d, g_conics, g_depths, g_opacities, needs_camera, totals[chunk, c],
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
