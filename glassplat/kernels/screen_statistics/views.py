"""Records of the statistics of densification."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Sums(NamedTuple):
    """What is added up for each of N Gaussians, in two rows: over all views, and over those that see it directly.

    gradient_sum [2, N]: norms of the gradient of the centre; pull_sum [2, N]: of the probe's; view_count [2, N]: how
    many views; max_radius [N]: largest radius, as a share of the longer image side.
    """

    gradient_sum: Tensor
    pull_sum: Tensor
    view_count: Tensor
    max_radius: Tensor


class Views(NamedTuple):
    """Views of one image size, and the gradients of a loss in them.

    v_means2d, v_probe, radii [C, N, 2]: gradients of centres and probe, and half extents, in pixels, 0 where a view
    does not see the Gaussian. weight: what a view counts, a number or a scalar for all or [C, N] for each Gaussian.
    direct: whether the views see the Gaussians themselves, and not their mirror images.
    """

    v_means2d: Tensor
    v_probe: Tensor
    radii: Tensor
    width: int
    height: int
    weight: float | Tensor = 1.0
    direct: bool = True
