"""Hierarchy of boxes on the CPU, one level after the other, from the lowest up."""

from __future__ import annotations

from functools import cache

import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.build_bvh.hilbert import hilbert_codes
from glassplat.kernels.cpu.jit import Kernel, kernel
from glassplat.kernels.tensor_checks import REAL_OF
from glassplat.kernels.trace.cpu_traversal import WIDTH
from glassplat.kernels.trace.records import Bvh, Shapes
from glassplat.kernels.trace.shapes import reach


def build_bvh(shapes: Shapes, *, flat: bool, order: Tensor | None) -> Bvh:
    """As the operation."""
    count, real = shapes.means.shape[0], REAL_OF[shapes.means.dtype]
    if order is None:
        order = torch.argsort(hilbert_codes(shapes.means.detach()), stable=True).to(torch.int32)
    sizes = level_sizes(count)
    offsets = torch.tensor([0, *sizes]).cumsum(0)
    boxes = shapes.means.new_empty(int(offsets[-1]), 6, WIDTH)
    extents = reach(shapes.opacities)
    inputs = (tensor.detach().contiguous().numpy() for tensor in (shapes.means, shapes.frames, extents, order, offsets))
    fit_boxes(real, flat)(*inputs, boxes.numpy())
    return Bvh(order, boxes, offsets)


def level_sizes(count: int) -> list[int]:
    """Nodes of each level over `count` Gaussians, the lowest first; none over none."""
    sizes: list[int] = []
    while count > 1 or (count == 1 and not sizes):
        count = -(-count // WIDTH)
        sizes.append(count)
    return sizes


@cache
def fit_boxes(real: type, flat: bool) -> Kernel:
    """Fills the boxes of all nodes."""
    zero, nowhere, axes = real(0.0), real("inf"), 2 if flat else 3

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
                    sums = (zero, zero, zero)
                    for i in range(axes):
                        x, y, z = frames[g, i, 0], frames[g, i, 1], frames[g, i, 2]
                        # A row is an axis divided by its deviation; divided by its squared length it is their product.
                        inverse = real(1.0) / (x * x + y * y + z * z)
                        x, y, z = x * inverse, y * inverse, z * inverse
                        sums = (sums[0] + x * x, sums[1] + y * y, sums[2] + z * z)
                    for j in range(3):
                        half = extents[g] * sums[j] ** real(0.5)
                        # NaN and infinity fail the comparison, which leaves the box empty.
                        if abs(means[g, j]) + half < nowhere:
                            boxes[node, j, k], boxes[node, 3 + j, k] = means[g, j] - half, means[g, j] + half

    return fit
