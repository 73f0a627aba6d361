"""What the views of a step saw of each Gaussian, added up for densification."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from glassplat.kernels.records import REAL_OF, check_tensors
from glassplat.kernels.screen_statistics import reference as reference
from glassplat.kernels.screen_statistics.views import Sums, Views


@torch.no_grad()
def add_views(sums: Sums, views: Views) -> None:
    """Adds the views of one step to the sums, in place.

    Gradients are taken to normalised device coordinates, in which the image spans [-1, 1] both ways: a shift by one
    pixel is 2 / width there, so gradients per pixel are multiplied by width / 2 and height / 2.

    Args:
        sums: the record so far; contiguous float32 or float64.
        views: of the same floating-point type.

    Raises:
        ValueError: shapes disagree.
        TypeError: tensors of different or unsupported floating-point types, or on different devices.
    """
    cameras, count, _ = views.radii.shape
    expected: dict[str, tuple[Tensor, tuple[int, ...]]] = {"max_radius": (sums.max_radius, (count,))}
    expected |= {name: (getattr(sums, name), (2, count)) for name in ("gradient_sum", "pull_sum", "view_count")}
    expected |= {name: (getattr(views, name), (cameras, count, 2)) for name in ("v_means2d", "v_probe", "radii")}
    if isinstance(views.weight, Tensor):
        expected["weight"] = (views.weight, (cameras, count) if views.weight.dim() else ())
    check_tensors(expected)
    if sums.max_radius.device.type != "cpu":
        # On a GPU these few sums over Gaussians are no bottleneck, so that there they stay PyTorch's.
        reference.add_views(sums, views)
        return
    from glassplat.kernels.screen_statistics.cpu import add_views_kernel

    real = REAL_OF[sums.max_radius.dtype]
    weight = np.ascontiguousarray(np.atleast_2d(views.weight), real)
    gradients = (tensor.detach().contiguous().numpy() for tensor in views[:3])
    add_views_kernel(real)(
        *(tensor.numpy() for tensor in sums), *gradients, weight,
        views.width, views.height, 1 + views.direct,
    )  # fmt: skip
