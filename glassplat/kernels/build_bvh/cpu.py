"""Hierarchy of boxes on the CPU, one level after the other, from the lowest up."""

from __future__ import annotations

from functools import cache

import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.build_bvh.boxes import half_widths_maths, level_offsets
from glassplat.kernels.build_bvh.hilbert import hilbert_codes
from glassplat.kernels.cpu.jit import Kernel, kernel
from glassplat.kernels.tensor_checks import REAL_OF
from glassplat.kernels.trace.records import Bvh, Shapes
from glassplat.kernels.trace.shapes import reach
from glassplat.kernels.trace.steps import WIDTH


def build_bvh(shapes: Shapes, *, flat: bool, order: Tensor | None) -> Bvh:
    """As the operation."""
    count, real = shapes.means.shape[0], REAL_OF[shapes.means.dtype]
    if order is None:
        order = torch.argsort(hilbert_codes(shapes.means.detach()), stable=True).to(torch.int32)
    offsets = torch.tensor(level_offsets(count))
    boxes = shapes.means.new_empty(int(offsets[-1]), 6, WIDTH)
    extents = reach(shapes.opacities)
    inputs = (tensor.detach().contiguous().numpy() for tensor in (shapes.means, shapes.frames, extents, order, offsets))
    fit_boxes(real, flat)(*inputs, boxes.numpy())
    return Bvh(order, boxes, offsets)


@cache
def fit_boxes(real: type, flat: bool) -> Kernel:
    """Fills the boxes of all nodes."""
    zero, nowhere, half_widths = real(0.0), real("inf"), half_widths_maths(real, flat)

    @kernel("fit_boxes_discs" if flat else "fit_boxes_ellipsoids", real)
    def fit(means, frames, extents, order, offsets, boxes):
        for level in range(offsets.size - 1):
            first, last = offsets[level], offsets[level + 1]
            members = order.size if level == 0 else first - offsets[level - 1]
            for node in prange(first, last):
                for k in range(WIDTH):
                    member = (node - first) * WIDTH + k
                    for j in range(3):
                        boxes[node, j, k], boxes[node, 3 + j, k] = nowhere, -nowhere
                    if member >= members:
                        continue
                    if level > 0:
                        below = offsets[level - 1] + member
                        for j in range(3):
                            low, high = nowhere, -nowhere
                            for i in range(WIDTH):
                                low, high = min(low, boxes[below, j, i]), max(high, boxes[below, 3 + j, i])
                            boxes[node, j, k], boxes[node, 3 + j, k] = low, high
                        continue
                    g = order[member]
                    if not extents[g] > zero:
                        continue
                    half = half_widths(frames, g, extents[g])
                    for j in range(3):
                        # NaN and infinity fail the comparison, which leaves the box empty.
                        if abs(means[g, j]) + half[j] < nowhere:
                            boxes[node, j, k], boxes[node, 3 + j, k] = means[g, j] - half[j], means[g, j] + half[j]

    return fit
