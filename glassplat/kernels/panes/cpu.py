"""Panes on the CPU: ray hits, blending, derivatives of the blend by its layers, and edges shared by the layers.

Rays are intersected with rectangles row by row, where everything but one division is affine. Blending processes runs of
pixels of one row and one pane. A run is first copied into *planes* of one flat buffer, one plane per quantity. Their
offsets are known to the compiler, so that it can vectorise the colour-space curves. `layer_derivatives` computes the
greys of a row first, for the same reason.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from glassplat.kernels.backend.cpu import ONE, ZERO, Kernel, even_stride, inlined, kernel
from glassplat.kernels.backend.cpu_vector import (
    bits_of,
    deinterleave,
    interleave,
    join_triples,
    split_triples,
    store,
    store_all,
    vector_kind,
)
from glassplat.kernels.maths.blending import Scalar
from glassplat.kernels.maths.images import color_space_maths
from glassplat.kernels.maths.pane import DARKEST, build_blend_channel, pane_maths, weighted_edges
from glassplat.kernels.records import DAZZLING, REAL_OF, TILE, PaneHits


def pane_hits(
    inputs: Sequence[Tensor], width: int, height: int, mask: Tensor | None, beyond: PaneHits | None
) -> PaneHits:
    """Nearest panes, from the fields of `Panes` and the intrinsics."""
    centers = inputs[0]
    count, real = centers.shape[0], REAL_OF[centers.dtype]
    index = torch.empty(height, width, dtype=torch.int32)
    depth = centers.new_empty(height, width)
    tiles = torch.zeros(count, -(-height // TILE), -(-width // TILE), dtype=torch.bool)
    windows = centers.new_zeros(count, 4)
    visible = centers.new_empty(0, 0) if mask is None else mask
    before = (index.new_empty(0, 0), centers.new_empty(0, 0)) if beyond is None else (beyond.pane, beyond.depth)
    pane_hits_forward(real)(*inputs, visible, *before, index, depth, tiles, windows)
    return PaneHits(index, depth, tiles, windows)


@cache
def pane_hits_forward(real: type) -> Kernel:
    """Fills the index, the depth, the tiles and the windows of the panes."""
    half, one, zero, far = real(0.5), real(1.0), real(0.0), real(np.inf)

    @kernel("pane_hits", real)
    def forward(
        centers, normals, axes, half_sizes, intrinsics, mask, before, depth_before, index, depth_of, tiles, windows
    ):  # fmt: skip
        height, width = index.shape
        count = centers.shape[0]
        spans: NDArray[Any] = np.empty((height, count, 2), np.int32)
        for tile_row in prange((height + TILE - 1) // TILE):
            least: NDArray[Any] = np.zeros(width, real)
            own: NDArray[Any] = np.full(width, -1, np.int32)
            for row in range(tile_row * TILE, min(height, tile_row * TILE + TILE)):
                y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
                nearest = depth_of[row]
                nearest[:] = far
                index[row, :] = -1
                if before.size:
                    least[:], own[:] = depth_before[row], before[row]
                for k in range(count):
                    n, u, v, c = normals[k], axes[k, 0], axes[k, 1], centers[k]
                    distance = c[0] * n[0] + c[1] * n[1] + c[2] * n[2]
                    along_u, along_v = c[0] * u[0] + c[1] * u[1] + c[2] * u[2], c[0] * v[0] + c[1] * v[1] + c[2] * v[2]
                    n_x, n_row = n[0], n[1] * y + n[2]
                    u_x, u_row = u[0], u[1] * y + u[2]
                    v_x, v_row = v[0], v[1] * y + v[2]
                    most_u, most_v = half_sizes[k, 0], half_sizes[k, 1]
                    inverse_f, c_x = one / intrinsics[0], intrinsics[2]
                    for column in range(width):
                        x = (real(np.int32(column)) + half - c_x) * inverse_f
                        depth = distance / (n_x * x + n_row)
                        inside = (depth > least[column]) & (depth < nearest[column]) & (own[column] != k)
                        inside &= abs(depth * (u_x * x + u_row) - along_u) <= most_u
                        inside &= abs(depth * (v_x * x + v_row) - along_v) <= most_v
                        nearest[column] = depth if inside else nearest[column]
                        index[row, column] = np.int32(k) if inside else index[row, column]
                spans[row, :, 0], spans[row, :, 1] = width, -1
                for column in range(width):
                    k = index[row, column]
                    if k >= 0 and (mask.size == 0 or mask[row, column] > zero):
                        tiles[k, tile_row, column // TILE] = True
                        spans[row, k, 0] = min(spans[row, k, 0], column)
                        spans[row, k, 1] = column
        for k in range(count):
            left, top, right, bottom = width, height, 0, 0
            for row in range(height):
                if spans[row, k, 1] >= 0:
                    left, right = min(left, spans[row, k, 0]), max(right, spans[row, k, 1] + 1)
                    top, bottom = min(top, row), row + 1
            if right > 0:
                windows[k, 0], windows[k, 1], windows[k, 2], windows[k, 3] = left, top, right, bottom

    return forward


LANES = 16
load_lanes = vector_kind(LANES).load
RUN = 32
"""Pixels of a run, a multiple of the lanes."""

ALL = (1 << LANES) - 1
"""Mask bits of a whole vector."""

# Planes of a run. MASK is 0 where the run's pane is not shown; GAIN is the intensity.
MASK, GAIN, RAW, SHARE, ALONG, LENGTH = (plane * RUN for plane in range(6))
BEHIND, MIRRORED, RGB, BRIGHT = (plane * RUN for plane in (6, 9, 12, 15))
FORWARD_PLANES = 18
V_RGB, V_BRIGHT, V_SHARE, V_GAIN = (plane * RUN for plane in (18, 21, 24, 25))
BACKWARD_PLANES = 26


def blend_panes(inputs: Sequence[Tensor], switches: tuple[int, bool, bool]) -> tuple[Tensor, ...]:
    """The fields of `BlendedPanes`; inputs in the order of the kernel, switches (law, intensity, linear)."""
    transmission, mask = inputs[:2]
    outputs = tuple(torch.empty_like(like) for like in (transmission, transmission, mask))
    blend_panes_forward(REAL_OF[mask.dtype])(*inputs, *switches, *outputs)
    return outputs


def blend_panes_gradients(
    inputs: Sequence[Tensor], switches: tuple[int, bool, bool], cotangents: Sequence[Tensor]
) -> tuple[Tensor, ...]:
    """Gradients of the first five inputs."""
    found = tuple(torch.zeros_like(tensor) for tensor in inputs[:5])
    blend_panes_backward(REAL_OF[found[0].dtype])(*inputs, *switches, *cotangents, *found)
    return found


@inlined
def _span(pane, row, k):
    """First and one-past-last column of a row that shows pane k."""
    first, last = pane.shape[1], 0
    for column in range(pane.shape[1]):
        if pane[row, column] == k:
            first = min(first, column)
            last = column + 1
    return first, last


@inlined
def _load_triples(run, at, image, pixel):
    """Copies colours of `LANES` consecutive pixels of a flat image to three planes of a run."""
    first, second = load_lanes(image, 3 * pixel), load_lanes(image, 3 * pixel + LANES)
    red, green, blue = split_triples(first, second, load_lanes(image, 3 * pixel + 2 * LANES))
    store(run, at, red)
    store(run, at + RUN, green)
    store(run, at + 2 * RUN, blue)


@inlined
def _store_triples(run, at, image, pixel):
    """Copies them back."""
    rows = join_triples(load_lanes(run, at), load_lanes(run, at + RUN), load_lanes(run, at + 2 * RUN))
    store_all(image, 3 * pixel, rows)


@inlined
def _load(run, transmission, mask, reflections, pane, intensity, row, k, first, count):
    """Copies the pixels of a run; entries beyond its end count as not shown. Colour images are flat."""
    height, width = mask.shape
    pixel = row * width + first
    mirrored = k * height * width + pixel
    if count == RUN:
        for i in range(RUN):
            run[MASK + i] = mask[row, first + i] if pane[row, first + i] == k else ZERO
        for i in range(0, RUN, LANES):
            _load_triples(run, BEHIND + i, transmission, pixel + i)
            at = 4 * (mirrored + i)
            four = (
                load_lanes(reflections, at), load_lanes(reflections, at + LANES),
                load_lanes(reflections, at + 2 * LANES), load_lanes(reflections, at + 3 * LANES),
            )  # fmt: skip
            red, green, blue, gain = deinterleave(four)
            store(run, MIRRORED + i, red)
            store(run, MIRRORED + RUN + i, green)
            store(run, MIRRORED + 2 * RUN + i, blue)
            store(run, GAIN + i, gain + ONE)
    else:
        for i in range(RUN):
            x = min(i, count - 1)
            shown = (pane[row, first + x] == k) & (i < count)
            run[MASK + i] = mask[row, first + x] if shown else ZERO
            run[GAIN + i] = ONE + reflections[4 * (mirrored + x) + 3]
            for d in range(3):
                run[BEHIND + d * RUN + i] = transmission[3 * (pixel + x) + d]
                run[MIRRORED + d * RUN + i] = reflections[4 * (mirrored + x) + d]
    if not intensity:
        for i in range(RUN):
            run[GAIN + i] = ONE


def _fill_strengths(real: type) -> Scalar:
    strength, _, ray_length = pane_maths(real)
    zero, one, half = real(0.0), real(1.0), real(0.5)

    @inlined
    def fill_strengths(run, normals, bases, k, row, first, intrinsics, law):
        """Strength of every pixel of a run, before the mask in RAW and after it in SHARE; returns the rays' y."""
        inverse_f, c_x = one / intrinsics[0], intrinsics[2]
        y = (real(np.int32(row)) + half - intrinsics[3]) / intrinsics[1]
        n_x, n_row, base = normals[k, 0], normals[k, 1] * y + normals[k, 2], bases[k]
        start = real(np.int32(first)) + half - c_x
        for i in range(RUN):
            x = (start + real(np.int32(i))) * inverse_f
            along, length = n_x * x + n_row, ray_length(x, y)
            raw = strength(law, base, abs(along) / length)
            marked = run[MASK + i]
            run[ALONG + i], run[LENGTH + i], run[RAW + i] = along, length, raw
            run[SHARE + i] = raw * marked if marked > zero else zero
        return y

    return fill_strengths


def _blend_run(real: type) -> Scalar:
    blend_channel, _ = build_blend_channel(real)

    @inlined
    def blend_run(run, d, linear):
        """Blends channel d of a run into RGB and BRIGHT."""
        at = d * RUN
        for i in range(RUN):
            run[RGB + at + i], run[BRIGHT + at + i] = blend_channel(
                run[BEHIND + at + i], run[MIRRORED + at + i], run[GAIN + i], run[SHARE + i], linear
            )

    return blend_run


@cache
def blend_panes_forward(real: type) -> Kernel:
    """Fills rgb, reflection and strength."""
    fill_strengths, blend_run, zero = _fill_strengths(real), _blend_run(real), real(0.0)

    @kernel("blend_panes_forward", real)
    def forward(
        transmission, mask, reflections, normals, bases, pane, intrinsics, law, intensity, linear,
        rgb, reflection, strength,
    ):  # fmt: skip
        height, width = mask.shape
        behind, mirrored = transmission.reshape(transmission.size), reflections.reshape(reflections.size)
        mixed, bright, shares = rgb.reshape(rgb.size), reflection.reshape(reflection.size), strength.reshape(mask.size)
        stride = even_stride(height)
        for task in prange(height):
            row = task * stride % height
            run: NDArray[Any] = np.empty(FORWARD_PLANES * RUN, real)
            rgb[row], reflection[row], strength[row] = transmission[row], zero, zero
            for k in range(normals.shape[0]):
                begin, end = _span(pane, row, k)
                for first in range(begin, end, RUN):
                    count = min(RUN, end - first)
                    _load(run, behind, mask, mirrored, pane, intensity, row, k, first, count)
                    fill_strengths(run, normals, bases, k, row, first, intrinsics, law)
                    for d in range(3):
                        blend_run(run, d, linear)
                    for start in range(0, count, LANES):
                        share = load_lanes(run, SHARE + start)
                        if bits_of(share > zero) == ALL:
                            pixel = row * width + first + start
                            _store_triples(run, RGB + start, mixed, pixel)
                            _store_triples(run, BRIGHT + start, bright, pixel)
                            store(shares, pixel, share)
                            continue
                        for i in range(start, min(count, start + LANES)):
                            column = first + i
                            if run[MASK + i] > zero:
                                strength[row, column] = run[SHARE + i]
                                for d in range(3):
                                    reflection[row, column, d] = run[BRIGHT + d * RUN + i]
                            if run[SHARE + i] > zero:
                                for d in range(3):
                                    rgb[row, column, d] = run[RGB + d * RUN + i]

    return forward


def _blend_run_gradient(real: type) -> Scalar:
    (_, blend_channel_gradient), zero = build_blend_channel(real), real(0.0)

    @inlined
    def blend_run_gradient(run, d, linear):
        """Gradients of channel d; those of BEHIND and MIRRORED replace V_RGB and V_BRIGHT, the others accumulate."""
        at = d * RUN
        for i in range(RUN):
            share = run[SHARE + i]
            v_mixed = run[V_RGB + at + i] if share > zero else zero
            run[V_RGB + at + i], run[V_BRIGHT + at + i], v_gain, v_share = blend_channel_gradient(
                run[BEHIND + at + i], run[MIRRORED + at + i], run[GAIN + i], share, linear,
                v_mixed, run[V_BRIGHT + at + i],
            )  # fmt: skip
            run[V_GAIN + i] += v_gain
            run[V_SHARE + i] += v_share

    return blend_run_gradient


def _sum_strength_gradients(real: type) -> Scalar:
    _, strength_derivatives, _ = pane_maths(real)
    zero, one, half, dazzling = real(0.0), real(1.0), real(0.5), real(DAZZLING)

    @inlined
    def sum_strength_gradients(run, base, first, intrinsics, law):
        """Sums over the run, from SHARE's gradient: for the normal, weighted by x and 1, and the base reflectance."""
        inverse_f = one / intrinsics[0]
        start = real(np.int32(first)) + half - intrinsics[2]
        sum_x, sum_1, sum_base = zero, zero, zero
        for i in range(RUN):
            marked, along, length = run[MASK + i], run[ALONG + i], run[LENGTH + i]
            v_raw = run[V_SHARE + i] * marked if (marked > zero) & (run[GAIN + i] <= dazzling) else zero
            by_base, by_cosine = strength_derivatives(law, base, abs(along) / length)
            v_along = v_raw * by_cosine / length
            v_along = v_along if along > zero else -v_along
            sum_x += v_along * (start + real(np.int32(i))) * inverse_f
            sum_1 += v_along
            sum_base += v_raw * by_base
        return sum_x, sum_1, sum_base

    return sum_strength_gradients


@cache
def blend_panes_backward(real: type) -> Kernel:
    """Fills the gradients of transmission, mask, reflections, normals and base reflectances; all start at zero."""
    blend_run_gradient, sum_strength_gradients = _blend_run_gradient(real), _sum_strength_gradients(real)
    fill_strengths, zero = _fill_strengths(real), real(0.0)

    @kernel("blend_panes_backward", real)
    def backward(
        transmission, mask, reflections, normals, bases, pane, intrinsics, law, intensity, linear,
        v_rgb, v_reflection, v_strength, v_transmission, v_mask, v_reflections, v_normals, v_bases,
    ):  # fmt: skip
        (height, width), panes = mask.shape, normals.shape[0]
        behind, mirrored = transmission.reshape(transmission.size), reflections.reshape(reflections.size)
        v_mixed, v_bright = v_rgb.reshape(v_rgb.size), v_reflection.reshape(v_reflection.size)
        v_behind, v_mirrored = v_transmission.reshape(v_rgb.size), v_reflections.reshape(v_reflections.size)
        v_marked = v_mask.reshape(mask.size)
        sums: NDArray[Any] = np.zeros((height, panes, 4), real)
        stride = even_stride(height)
        for task in prange(height):
            row = task * stride % height
            run: NDArray[Any] = np.empty(BACKWARD_PLANES * RUN, real)
            v_transmission[row] = v_rgb[row]
            for k in range(panes):
                begin, end = _span(pane, row, k)
                for first in range(begin, end, RUN):
                    count = min(RUN, end - first)
                    _load(run, behind, mask, mirrored, pane, intensity, row, k, first, count)
                    y = fill_strengths(run, normals, bases, k, row, first, intrinsics, law)
                    for i in range(RUN):
                        run[V_SHARE + i], run[V_GAIN + i] = v_strength[row, first + min(i, count - 1)], zero
                    for start in range(0, count, LANES):
                        if start + LANES <= count:
                            _load_triples(run, V_RGB + start, v_mixed, row * width + first + start)
                            _load_triples(run, V_BRIGHT + start, v_bright, row * width + first + start)
                            continue
                        for i in range(start, RUN):
                            column = first + min(i, count - 1)
                            for d in range(3):
                                run[V_RGB + d * RUN + i] = v_rgb[row, column, d]
                                run[V_BRIGHT + d * RUN + i] = v_reflection[row, column, d]
                    for d in range(3):
                        blend_run_gradient(run, d, linear)
                    sum_x, sum_1, sum_base = sum_strength_gradients(run, bases[k], first, intrinsics, law)
                    sums[row, k, 0] += sum_x
                    sums[row, k, 1] += sum_1 * y
                    sums[row, k, 2] += sum_1
                    sums[row, k, 3] += sum_base
                    if not intensity:
                        for i in range(RUN):
                            run[V_GAIN + i] = zero
                    for start in range(0, count, LANES):
                        if bits_of(load_lanes(run, SHARE + start) > zero) == ALL:
                            pixel = row * width + first + start
                            store(v_marked, pixel, load_lanes(run, V_SHARE + start) * load_lanes(run, RAW + start))
                            _store_triples(run, V_RGB + start, v_behind, pixel)
                            at = 4 * (k * height * width + pixel)
                            v = V_BRIGHT + start
                            four = (
                                load_lanes(run, v), load_lanes(run, v + RUN), load_lanes(run, v + 2 * RUN),
                                load_lanes(run, V_GAIN + start),
                            )  # fmt: skip
                            store_all(v_mirrored, at, interleave(four))
                            continue
                        for i in range(start, min(count, start + LANES)):
                            column = first + i
                            if not run[MASK + i] > zero:
                                continue
                            v_mask[row, column] = run[V_SHARE + i] * run[RAW + i]
                            v_reflections[k, row, column, 3] = run[V_GAIN + i]
                            for d in range(3):
                                v_reflections[k, row, column, d] = run[V_BRIGHT + d * RUN + i]
                                if run[SHARE + i] > zero:
                                    v_transmission[row, column, d] = run[V_RGB + d * RUN + i]
        for k in range(panes):
            for row in range(height):
                for axis in range(3):
                    v_normals[k, axis] += sums[row, k, axis]
                v_bases[k] += sums[row, k, 3]

    return backward


def layer_derivatives(
    strength: Tensor, transmission: Tensor, reflection: Tensor, where: Tensor, *, linear: bool
) -> tuple[Tensor, Tensor]:
    """The derivatives by transmission and reflection [H, W]; see `glassplat.kernels.panes.layer_derivatives`."""
    through, mirrored = torch.empty_like(strength), torch.empty_like(strength)
    layers = (strength, transmission, reflection, where)
    layer_derivatives_kernel(REAL_OF[strength.dtype])(*layers, linear, through, mirrored)
    return through, mirrored


@functools.cache
def layer_derivatives_kernel(real: type) -> Kernel:
    """Fills both images [H, W]."""
    linear_of, linear_derivative, encoded, encoded_derivative = color_space_maths(real)
    zero, one, third = real(0.0), real(1.0), real(1.0 / 3.0)

    @kernel("layer_derivatives", real)
    def derivatives(strength, transmission, reflection, where, linear, through, mirrored):
        height, width = strength.shape
        for row in prange(height):
            greys: NDArray[Any] = np.empty((2, width), real)
            for x in range(width):
                t, r = transmission[row, x], reflection[row, x]
                greys[0, x] = (t[0] + t[1] + t[2]) * third
                greys[1, x] = (r[0] + r[1] + r[2]) * third
            behind, mirror_image, share = greys[0], greys[1], strength[row]
            shown, out_through, out_mirrored = where[row], through[row], mirrored[row]
            for x in range(width):
                by_behind, by_mirror_image = one - share[x], share[x]
                if linear:
                    lit, bright = linear_of(behind[x]), linear_of(mirror_image[x])
                    light = lit + share[x] * (bright - lit)
                    derivative = encoded_derivative(light, encoded(light))
                    by_behind *= derivative * linear_derivative(behind[x], lit)
                    by_mirror_image *= derivative * linear_derivative(mirror_image[x], bright)
                out_through[x] = by_behind if shown[x] else one
                out_mirrored[x] = by_mirror_image if shown[x] else zero

    return derivatives


def sample_derivatives(derivatives: Tensor, surface: Tensor, means2d: Tensor, depths: Tensor) -> Tensor:
    """As `glassplat.kernels.panes.sample_derivatives`, of contiguous tensors."""
    height, width = derivatives.shape
    # Clamped to the image before the conversion, which is undefined for infinities and NaN; fmax maps NaN to 0.
    zero = means2d.new_zeros(())
    columns, rows = (
        torch.fmax(axis, zero).clamp_(max=size - 1).int()
        for axis, size in zip(means2d.unbind(-1), (width, height), strict=True)
    )
    pixels = (rows * width + columns).flatten()
    depth, derivative = (image.flatten().index_select(0, pixels).view_as(depths) for image in (surface, derivatives))
    return torch.where(depths > depth, derivative, 1.0)


def inside_panes(pane: Tensor, strength: Tensor) -> Tensor:
    """As `glassplat.kernels.panes.inside_panes`, of contiguous images."""
    shown = torch.where(strength > 0, pane, -1)
    inside = shown >= 0
    along, above = shown[:, 1:] == shown[:, :-1], shown[1:] == shown[:-1]
    inside[:, 1:] &= along
    inside[:, :-1] &= along
    # Pairs of rows in which a pixel shows the same pane as its neighbours and the one above.
    pairs = (inside[1:] & inside[:-1]).logical_and_(above)
    inside[1:] &= pairs
    inside[:-1] &= pairs
    return inside.to(strength.dtype)


CHANNELS = 3


def gradient_conflict(
    transmission: Tensor, reflection: Tensor, hit: Tensor, strength: Tensor | None, cell: int
) -> tuple[Tensor, Tensor]:
    """The mean of the weighted edges, and derivatives for its gradient (`kernels.panes.gradient_conflict`).

    Args:
        transmission: [H, W, 3], contiguous like all of these.
        reflection: [H, W, 3].
        hit: [H, W].
        strength: [H, W], or None.
        cell: side of the cells in pixels.
    """
    height, width = hit.shape
    # A ring of zeros around the derivatives saves the border checks of the backward pass.
    derivatives = transmission.new_zeros(2, height + 2, CHANNELS * (width + 2))
    sums = torch.zeros(-(-(height - 2) // cell), dtype=torch.float64)
    images = (transmission, reflection, hit, hit if strength is None else strength)
    conflict_forward(REAL_OF[hit.dtype])(*images, strength is not None, cell, derivatives, sums)
    return (sums.sum() / conflict_count(height, width)).to(transmission.dtype), derivatives


def gradient_conflict_gradient(derivatives: Tensor, v_mean: Tensor) -> Tensor:
    """Gradient of the transmission [H, W, 3], given the derivatives of `gradient_conflict` and the mean's gradient."""
    real, height, width = REAL_OF[derivatives.dtype], derivatives.shape[1] - 2, derivatives.shape[2] // CHANNELS - 2
    v_transmission = derivatives.new_empty(height, width, CHANNELS)
    factor = real(v_mean.item() / conflict_count(height, width))
    conflict_backward(real)(derivatives, factor, v_transmission)
    return v_transmission


def conflict_count(height: int, width: int) -> int:
    """Number of derivatives of an image along one axis, over all channels and without its border."""
    return CHANNELS * (height - 2) * (width - 2)


@cache
def conflict_forward(real: type) -> Kernel:
    """Fills the sum of each row of cells, and derivatives [2, H + 2, 3 (W + 2)] by both Sobel images.

    Columns are summed first, and then cells, so that the loops over pixels are contiguous.
    """
    zero, one, two, darkest = real(0.0), real(1.0), real(2.0), real(DARKEST)

    @kernel("gradient_conflict_forward", real)
    def forward(transmission, reflection, hit, strength, has_strength, cell, derivatives, sums):
        height, width = hit.shape
        floats = CHANNELS * width
        t, r = transmission.reshape(height, floats), reflection.reshape(height, floats)
        for block in prange(len(sums)):
            top = 1 + block * cell
            bottom = min(top + cell, height - 1)
            shared: NDArray[Any] = np.zeros(floats, real)
            held: NDArray[Any] = np.zeros(floats, real)
            full: NDArray[Any] = np.zeros(floats, real)
            weights: NDArray[Any] = np.empty(floats, real)
            strengths: NDArray[Any] = np.empty(floats, real)
            for row in range(top, bottom):
                for x in range(width):
                    for d in range(CHANNELS):
                        weights[CHANNELS * x + d] = hit[row, x]
                        strengths[CHANNELS * x + d] = strength[row, x]
                t_up, t_here, t_down = t[row - 1], t[row], t[row + 1]
                r_up, r_here, r_down = r[row - 1], r[row], r[row + 1]
                out_x, out_y = derivatives[0, row + 1], derivatives[1, row + 1]
                for j in range(floats - 2 * CHANNELS):
                    k = j + 2 * CHANNELS
                    m = j + CHANNELS
                    t_x = t_up[k] - t_up[j] + two * (t_here[k] - t_here[j]) + t_down[k] - t_down[j]
                    r_x = r_up[k] - r_up[j] + two * (r_here[k] - r_here[j]) + r_down[k] - r_down[j]
                    t_y = t_down[j] - t_up[j] + two * (t_down[m] - t_up[m]) + t_down[k] - t_up[k]
                    r_y = r_down[j] - r_up[j] + two * (r_down[m] - r_up[m]) + r_down[k] - r_up[k]
                    weight = weights[m]
                    product = weight * (t_x * r_x + t_y * r_y)
                    shared[m] += product
                    out_x[m + CHANNELS] = weight * r_x
                    out_y[m + CHANNELS] = weight * r_y
                    if has_strength:
                        light_t, light_r = min(max(t_here[m], darkest), one), min(max(r_here[m], darkest), one)
                        held[m] += light_t * light_r * product
                        full[m] += weight * strengths[m] * light_r * light_r * (r_x * r_x + r_y * r_y)
            total = zero
            factors = weights
            for left in range(1, width - 1, cell):
                right = min(left + cell, width - 1)
                for d in range(CHANNELS):
                    edges, holds, could = zero, zero, zero
                    for x in range(left, right):
                        edges += shared[CHANNELS * x + d]
                        holds += held[CHANNELS * x + d]
                        could += full[CHANNELS * x + d]
                    added, factor = weighted_edges(edges, holds, could, has_strength)
                    total += added
                    for x in range(left, right):
                        factors[CHANNELS * x + d] = factor
            for row in range(top, bottom):
                for axis in range(2):
                    out = derivatives[axis, row + 1]
                    for m in range(CHANNELS, floats - CHANNELS):
                        out[m + CHANNELS] *= factors[m]
            sums[block] = total

    return forward


@cache
def conflict_backward(real: type) -> Kernel:
    """Fills the gradient of the transmission [H, W, 3], by the transposed Sobel operators on the derivatives."""
    two = real(2.0)

    @kernel("gradient_conflict_backward", real)
    def backward(derivatives, v_mean, v_transmission):
        height, width = v_transmission.shape[:2]
        floats = CHANNELS * width
        out = v_transmission.reshape(height, floats)
        for row in prange(height):
            x_up, x_here, x_down = derivatives[0, row], derivatives[0, row + 1], derivatives[0, row + 2]
            y_up, y_down = derivatives[1, row], derivatives[1, row + 2]
            target = out[row]
            for j in range(floats):
                m, k = j + CHANNELS, j + 2 * CHANNELS
                across = x_up[j] - x_up[k] + two * (x_here[j] - x_here[k]) + x_down[j] - x_down[k]
                down = y_up[j] - y_down[j] + two * (y_up[m] - y_down[m]) + y_up[k] - y_down[k]
                target[j] = v_mean * (across + down)

    return backward
