"""Ray tracing on the CPU: blocks of neighbouring rays, each ray in chunks of its nearest hits.

Blocks have a fixed size, whatever the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.cpu.jit import Kernel, kernel
from glassplat.kernels.cpu.schedule import even_stride
from glassplat.kernels.maths.blending import TRANSMITTANCE_MIN
from glassplat.kernels.maths.harmonics import color_maths
from glassplat.kernels.tensor_checks import REAL_OF
from glassplat.kernels.trace.cpu_backward import trace_gradients
from glassplat.kernels.trace.cpu_traversal import arrays_of, traversal
from glassplat.kernels.trace.steps import CHUNK, STACK, WIDTH

__all__ = ["trace", "trace_gradients"]

BLOCK = 64
"""Rays per task."""


def trace(
    shapes: Sequence[Tensor], rays: Sequence[Tensor], bvh: Sequence[Tensor], *, flat: bool, degree: int, near: float
) -> tuple[Tensor, ...]:
    """Fields of `Traced`; degree -1 is no colour."""
    origins = rays[0]
    count, real = origins.shape[0], REAL_OF[origins.dtype]
    outputs = (
        origins.new_empty(count, 3),
        origins.new_empty(count),
        origins.new_empty(count),
        torch.empty(count, dtype=torch.int32),
    )
    trace_forward(real, flat)(
        *(tensor.numpy() for tensor in (*shapes, *rays)),
        *arrays_of(bvh),
        degree,
        real(near),
        *(tensor.numpy() for tensor in outputs),
    )
    return outputs


@cache
def trace_forward(real: type, flat: bool) -> Kernel:
    """Fills colors, alphas, depths and hits."""
    next_hits, ray = traversal(real, flat)
    color = color_maths(real).color
    zero, half, one, least = real(0.0), real(0.5), real(1.0), real(TRANSMITTANCE_MIN)

    @kernel("trace_forward_discs" if flat else "trace_forward_ellipsoids", real)
    def forward(
        means, frames, opacities, sh, origins, directions, order, boxes, offsets, degree, near,
        colors, alphas, depths, hits,
    ):  # fmt: skip
        count = origins.shape[0]
        num_blocks = (count + BLOCK - 1) // BLOCK
        stride = even_stride(num_blocks)
        for task in prange(num_blocks):
            block = task * stride % num_blocks
            ts, found, ids = np.empty((CHUNK,), real), np.empty((CHUNK,), real), np.empty((CHUNK,), np.int32)
            entries, stack, waiting = np.empty((WIDTH,), real), np.empty((STACK,), np.int64), np.empty((STACK,), real)
            for r in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
                o, d, inverse, length, usable = ray(origins, directions, r)
                red = green = blue = depth = zero
                left, blended = one, 0
                first, first_id, known = near, 2147483647, CHUNK
                while usable and known == CHUNK:
                    known = next_hits(
                        o, d, inverse, means, frames, opacities, order, boxes, offsets, first, first_id,
                        ts, ids, found, entries, stack, waiting,
                    )  # fmt: skip
                    for k in range(known):
                        after = left * (one - found[k])
                        if after < least:
                            known = 0
                            break
                        g, weight = ids[k], found[k] * left
                        if degree >= 0:
                            x, y, z = d[0] / length, d[1] / length, d[2] / length
                            c = color(sh, g, degree, x, y, z)
                            red += weight * max(c[0] + half, zero)
                            green += weight * max(c[1] + half, zero)
                            blue += weight * max(c[2] + half, zero)
                        depth += weight * (ts[k] * length)
                        left, blended = after, blended + 1
                    first, first_id = ts[CHUNK - 1], ids[CHUNK - 1]
                colors[r, 0], colors[r, 1], colors[r, 2] = red, green, blue
                alphas[r], depths[r], hits[r] = one - left, depth, blended

    return forward
