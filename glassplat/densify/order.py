"""An order of the Gaussians in memory in which neighbours in space are neighbours in memory."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.densify.edit import Edit
from glassplat.kernels.trace.bvh import morton_codes


def in_morton_order(means: Tensor) -> Edit:
    """The edit that puts Gaussians at `means` [N, 3] into Morton order; equal places keep their order.

    A tile of an image fetches Gaussians that lie near each other in space, so that more of what a cache line or a wide
    load brings is used.
    """
    source = torch.argsort(morton_codes(means), stable=True)
    return Edit(source, torch.zeros_like(source, dtype=torch.bool))
