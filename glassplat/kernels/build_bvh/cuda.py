"""Hierarchy of boxes on the GPU: torch sorts, and each level is one launch. Nothing comes back to the program."""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.build_bvh.boxes import half_widths_maths, level_offsets
from glassplat.kernels.build_bvh.hilbert import curve_cells, curve_place
from glassplat.kernels.cuda.launch import Kernel, blocks_for, kernel
from glassplat.kernels.tensor_checks import REAL_OF
from glassplat.kernels.trace.records import Bvh, Shapes
from glassplat.kernels.trace.shapes import reach
from glassplat.kernels.trace.steps import WIDTH

THREADS = 128


def build_bvh(shapes: Shapes, *, flat: bool, order: Tensor | None) -> Bvh:
    """As `glassplat.kernels.build_bvh.cpu.build_bvh`."""
    means, frames = (tensor.detach().contiguous() for tensor in shapes[:2])
    count, real = means.shape[0], REAL_OF[means.dtype]
    if order is None:
        order = torch.argsort(hilbert_codes(means), stable=True).to(torch.int32)
    offsets = level_offsets(count)
    boxes = means.new_empty(offsets[-1], 6, WIDTH)
    extents = reach(shapes.opacities.detach())
    leaves = offsets[1] if count else 0
    fit_leaves(real, flat)(blocks_for(leaves * WIDTH, THREADS), THREADS, means, frames, extents, order, boxes)
    for below, (first, last) in zip(offsets, pairwise(offsets[1:]), strict=False):
        fit_level(real)(blocks_for((last - first) * WIDTH, THREADS), THREADS, below, first, last, boxes)
    return Bvh(order, boxes, _on_device(offsets, means.device))


def _on_device(numbers: list[int], device: torch.device) -> Tensor:
    """A list of few integers, filled in one by one: a copy from the program's memory would be waited for."""
    found = torch.empty(len(numbers), dtype=torch.int64, device=device)
    for place, number in enumerate(numbers):
        found[place : place + 1].fill_(number)
    return found


def hilbert_codes(points: Tensor) -> Tensor:
    """As `glassplat.kernels.build_bvh.hilbert.hilbert_codes`."""
    cells, finite = curve_cells(points)
    places = torch.empty(len(points), dtype=torch.int64, device=points.device)
    hilbert_places()(blocks_for(len(points), THREADS), THREADS, cells, places)
    return torch.where(finite, places, torch.iinfo(torch.int64).max)


@cache
def hilbert_places(key: type = np.int64) -> Kernel:
    """Fills the places of cells along the curve."""

    @kernel("hilbert_places", key, "long2 long1")
    def fill(cells, places):
        i = cuda.grid(1)
        if i < places.size:
            places[i] = curve_place(cells[i, 0], cells[i, 1], cells[i, 2])

    return fill


@cache
def fit_leaves(real: type, flat: bool) -> Kernel:
    """Fills the boxes of the lowest level, a thread for each Gaussian and each place that is left."""
    zero, nowhere, half_widths = real(0.0), real("inf"), half_widths_maths(real, flat)

    @kernel("fit_leaves_discs" if flat else "fit_leaves_ellipsoids", real, "real2 real3 real1 int1 real3")
    def fit(means, frames, extents, order, boxes):
        i = cuda.grid(1)
        node, k = i // WIDTH, i % WIDTH
        if node * WIDTH >= order.size:
            return
        for j in range(3):
            boxes[node, j, k], boxes[node, 3 + j, k] = nowhere, -nowhere
        if i >= order.size or not extents[order[i]] > zero:
            return
        g = order[i]
        x, y, z = half_widths(frames, g, extents[g])
        # NaN and infinity fail the comparison, which leaves the box empty.
        if abs(means[g, 0]) + x < nowhere:
            boxes[node, 0, k], boxes[node, 3, k] = means[g, 0] - x, means[g, 0] + x
        if abs(means[g, 1]) + y < nowhere:
            boxes[node, 1, k], boxes[node, 4, k] = means[g, 1] - y, means[g, 1] + y
        if abs(means[g, 2]) + z < nowhere:
            boxes[node, 2, k], boxes[node, 5, k] = means[g, 2] - z, means[g, 2] + z

    return fit


@cache
def fit_level(real: type) -> Kernel:
    """Fills the boxes of a level of nodes from the one below, which begins at node `below` and ends before `first`."""
    nowhere = real("inf")

    @kernel("fit_level", real, "long long long real3")
    def fit(below, first, last, boxes):
        i = cuda.grid(1)
        node, k = first + i // WIDTH, i % WIDTH
        if node >= last:
            return
        member = below + i
        for j in range(3):
            low, high = nowhere, -nowhere
            if member < first:
                for c in range(WIDTH):
                    low, high = min(low, boxes[member, j, c]), max(high, boxes[member, 3 + j, c])
            boxes[node, j, k], boxes[node, 3 + j, k] = low, high

    return fit
