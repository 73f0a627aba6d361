"""The statistics in plain PyTorch: the definition of `glassplat.kernels.screen_statistics.add_views`."""

from __future__ import annotations

import torch

from glassplat.kernels.screen_statistics.views import Sums, Views


@torch.no_grad()
def add_views(sums: Sums, views: Views) -> None:
    """Adds the views of one step in place; see `glassplat.kernels.screen_statistics.add_views`."""
    visible = (views.radii > 0).all(dim=-1)
    rows = slice(None) if views.direct else slice(0, 1)
    for total, gradient in ((sums.gradient_sum, views.v_means2d), (sums.pull_sum, views.v_probe)):
        across, down = gradient[..., 0] * (views.width / 2), gradient[..., 1] * (views.height / 2)
        total[rows] += torch.where(visible, torch.hypot(across, down), 0).sum(dim=0)
    sums.view_count[rows] += (views.weight * visible.to(views.radii.dtype)).sum(dim=0)
    shares = torch.where(visible, views.radii.amax(dim=-1) / max(views.width, views.height), 0)
    torch.maximum(sums.max_radius, shares.amax(dim=0).to(sums.max_radius.dtype), out=sums.max_radius)
