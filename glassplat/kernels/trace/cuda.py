"""Ray tracing on the GPU: one thread for each ray, in chunks of its nearest hits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from glassplat.kernels.cuda.launch import Kernel, blocks_for, kernel
from glassplat.kernels.maths.blending import TRANSMITTANCE_MIN
from glassplat.kernels.maths.harmonics import color_maths
from glassplat.kernels.tensor_checks import REAL_OF
from glassplat.kernels.trace.cuda_backward import WARP, Hits, trace_pull_gaussians, trace_pull_rays
from glassplat.kernels.trace.cuda_traversal import next_hits_maths
from glassplat.kernels.trace.steps import CHUNK, STACK, ray_reader

THREADS = 128


def trace(
    shapes: Sequence[Tensor], rays: Sequence[Tensor], bvh: Sequence[Tensor], *, flat: bool, degree: int, near: float
) -> tuple[Tensor, ...]:
    """As `glassplat.kernels.trace.cpu.trace`."""
    origins = rays[0]
    count = origins.shape[0]
    outputs = (
        origins.new_empty(count, 3),
        origins.new_empty(count),
        origins.new_empty(count),
        torch.empty(count, dtype=torch.int32, device=origins.device),
    )
    _search(shapes, rays, bvh, flat)(degree, near, None, None, None, *outputs)
    return outputs


def trace_gradients(
    shapes: Sequence[Tensor], rays: Sequence[Tensor], bvh: Sequence[Tensor], outputs: Sequence[Tensor],
    cotangents: Sequence[Tensor], *, flat: bool, degree: int, near: float,
) -> tuple[Tensor, ...]:  # fmt: skip
    """As `glassplat.kernels.trace.cpu.trace_gradients`; waits for the GPU once, to learn the number of hits."""
    means, sh, counts = shapes[0], shapes[3], outputs[3]
    real, num_rays, count = REAL_OF[means.dtype], counts.shape[0], means.shape[0]
    offsets = torch.zeros(num_rays + 1, dtype=torch.int64, device=means.device)
    torch.cumsum(counts, 0, out=offsets[1:])
    total = int(offsets[-1].item())
    whose = [torch.empty(total, dtype=torch.int32, device=means.device) for _ in range(2)]
    hits = Hits(offsets, *whose, *(means.new_empty(total) for _ in range(3)))
    # No colours: only what is met, and how much it covers.
    _search(shapes, rays, bvh, flat)(-1, near, hits.offsets, hits.met, hits.alphas, None, None, None, None)
    v_rays = [torch.zeros_like(ray) for ray in rays]
    means_and_frames, pulled = shapes[:2], (*outputs[:3], *cotangents)
    trace_pull_rays(real, flat)(
        blocks_for(num_rays, THREADS), THREADS, *means_and_frames, sh, *rays, degree, *hits, *pulled, *v_rays
    )
    by_gaussian, order = torch.sort(hits.met, stable=True)
    starts = torch.searchsorted(by_gaussian, torch.arange(count + 1, dtype=torch.int32, device=means.device))
    found = (torch.zeros_like(means), torch.zeros_like(shapes[1]), torch.zeros_like(shapes[2]), torch.zeros_like(sh))
    v_colors, _, v_depths = cotangents
    trace_pull_gaussians(real, flat)(
        count, WARP, *shapes, *rays, degree, order, starts, hits.rays, hits.weights, hits.pulls, v_colors, v_depths,
        *found,
    )  # fmt: skip
    return (*found, *v_rays)


def _search(shapes: Sequence[Tensor], rays: Sequence[Tensor], bvh: Sequence[Tensor], flat: bool) -> Callable[..., None]:
    """The launch of `trace_forward` for these shapes and rays; takes the rest of its arguments."""
    order, boxes, offsets = bvh
    blocks = blocks_for(rays[0].shape[0], THREADS)

    def launch(*rest: object) -> None:
        trace_forward(REAL_OF[rays[0].dtype], flat)(
            blocks, THREADS, *shapes, *rays, order, boxes.view(-1), offsets, *rest
        )

    return launch


@cache
def trace_forward(real: type, flat: bool) -> Kernel:
    """Fills colors, alphas, depths and hits; or where `starts` has elements, each ray's Gaussians and their coverage.

    Both are one kernel, so that both find the same hits: another one's products and sums may be fused in another way,
    and a Gaussian that covers just 1/255 would be met by one of them alone.
    """
    ray, next_hits, color = ray_reader(real), next_hits_maths(real, flat), color_maths(real).color
    zero, half, one, least = real(0.0), real(0.5), real(1.0), real(TRANSMITTANCE_MIN)

    @kernel(
        "trace_forward_discs" if flat else "trace_forward_ellipsoids",
        real,
        "real2 real3 real1 real3 real2 real2 int1 real1 long1 int real long1 int1 real1 real2 real1 real1 int1",
    )
    def forward(
        means, frames, opacities, sh, origins, directions, order, boxes, offsets, degree, near, starts, met, met_alphas,
        colors, alphas, depths, hits,
    ):  # fmt: skip
        ts, found, ids = cuda.local.array(CHUNK, real), cuda.local.array(CHUNK, real), cuda.local.array(CHUNK, np.int32)
        stack, waiting = cuda.local.array(STACK, np.int32), cuda.local.array(STACK, real)
        r = cuda.grid(1)
        if r >= origins.shape[0]:
            return
        o, d, inverse, length, usable = ray(origins, directions, r)
        x, y, z = d[0] / length, d[1] / length, d[2] / length
        red = green = blue = depth = zero
        left, blended = one, 0
        first, first_id, known = near, 2147483647, CHUNK
        while usable and known == CHUNK:
            known = next_hits(
                o, d, inverse, means, frames, opacities, order, boxes, offsets, first, first_id,
                ts, ids, found, stack, waiting,
            )  # fmt: skip
            for k in range(known):
                after = left * (one - found[k])
                if after < least:
                    known = 0
                    break
                g, weight = ids[k], found[k] * left
                if starts.size > 0:
                    met[starts[r] + blended], met_alphas[starts[r] + blended] = g, found[k]
                if degree >= 0:
                    c = color(sh, g, degree, x, y, z)
                    red += weight * max(c[0] + half, zero)
                    green += weight * max(c[1] + half, zero)
                    blue += weight * max(c[2] + half, zero)
                depth += weight * (ts[k] * length)
                left, blended = after, blended + 1
            first, first_id = ts[CHUNK - 1], ids[CHUNK - 1]
        if starts.size == 0:
            colors[r, 0], colors[r, 1], colors[r, 2] = red, green, blue
            alphas[r], depths[r], hits[r] = one - left, depth, blended

    return forward
