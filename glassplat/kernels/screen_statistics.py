"""Per-Gaussian statistics over the views of a step, accumulated for densification."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
import torch
from numba import prange
from torch import Tensor

from glassplat.kernels.backend.cpu import Kernel, kernel
from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.records import REAL_OF, check_tensors

CHUNK = 1024
"""Gaussians per task."""


class Sums(NamedTuple):
    """Sums for each of N Gaussians, in two rows: over all views, and over direct (not mirrored) views.

    gradient_sum [2, N]: norms of the gradient of the centre; absgrad_sum [2, N]: norms of its absolute gradient;
    view_count [2, N]: number of views.
    """

    gradient_sum: Tensor
    absgrad_sum: Tensor
    view_count: Tensor


class Views(NamedTuple):
    """Views of one image size, and the gradients of a loss in them.

    v_means2d, v_absgrad, radii [C, N, 2]: gradients of centres, absolute gradients, and half extents in pixels, 0 where
    a view does not see the Gaussian. weight: weight of a view in the counts, a scalar for all or [C, N] for each
    Gaussian. direct: True if the views see the Gaussians themselves, False for their mirror images.
    """

    v_means2d: Tensor
    v_absgrad: Tensor
    radii: Tensor
    width: int
    height: int
    weight: float | Tensor = 1.0
    direct: bool = True


@torch.no_grad()
def add_views(sums: Sums, views: Views) -> None:
    """Adds the views of one step to the sums, in place.

    Gradients are converted to normalised device coordinates, in which the image spans [-1, 1] in both directions. A
    shift by one pixel is 2 / width there, so gradients per pixel are multiplied by width / 2 and height / 2.

    Args:
        sums: sums of earlier steps; contiguous float32 or float64.
        views: of the same floating-point type.
    """
    cameras, count, _ = views.radii.shape
    expected: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        name: (total, (2, count)) for name, total in zip(Sums._fields, sums, strict=True)
    }
    expected |= {name: (getattr(views, name), (cameras, count, 2)) for name in ("v_means2d", "v_absgrad", "radii")}
    if isinstance(views.weight, Tensor):
        expected["weight"] = (views.weight, (cameras, count) if views.weight.dim() else ())
    check_tensors(expected)
    device = sums.view_count.device
    if device.type != "cpu":
        kernels_for("project", device).add_views(sums, views)
        return
    real = REAL_OF[sums.view_count.dtype]
    weight = np.ascontiguousarray(np.atleast_2d(views.weight), real)
    gradients = (tensor.detach().contiguous() for tensor in views[:3])
    add_views_kernel(real)(*sums, *gradients, weight, views.width, views.height, 1 + views.direct)


@functools.cache
def add_views_kernel(real: type) -> Kernel:
    """Adds to the first `rows` rows of the sums; `weight` is [C, N], or [1, 1] for one weight for all."""
    half, zero = real(0.5), real(0.0)

    @kernel("screen_statistics", real)
    def add(
        gradient_sum, absgrad_sum, view_count, v_means2d, v_absgrad, radii, weight, width, height, rows
    ):  # fmt: skip
        cameras, count = radii.shape[0], radii.shape[1]
        right, down = half * real(width), half * real(height)
        for chunk in prange((count + CHUNK - 1) // CHUNK):
            for n in range(chunk * CHUNK, min(count, (chunk + 1) * CHUNK)):
                gradient = absgrad = views = zero
                for c in range(cameras):
                    if radii[c, n, 0] > zero and radii[c, n, 1] > zero:
                        x, y = right * v_means2d[c, n, 0], down * v_means2d[c, n, 1]
                        gradient += math.sqrt(x * x + y * y)
                        x, y = right * v_absgrad[c, n, 0], down * v_absgrad[c, n, 1]
                        absgrad += math.sqrt(x * x + y * y)
                        views += weight[c, n] if weight.size > 1 else weight[0, 0]
                for row in range(rows):
                    gradient_sum[row, n] += gradient
                    absgrad_sum[row, n] += absgrad
                    view_count[row, n] += views

    return add
