"""Opacity perturbation: shakes what lies behind a pane out of a wrong decomposition (TR-Gaussians, Section III-C3)."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.scene.gaussians import Gaussians


@torch.no_grad()
def perturb_opacities(
    gaussians: Gaussians,
    selected: Tensor,
    *,
    generator: torch.Generator,
    amplitude: float = 0.4,
    bounds: tuple[float, float] = (0.01, 0.99),
) -> Gaussians:
    """Adds uniform noise to the opacity of the Gaussians that are seen through a pane.

    Where the transmission image still holds part of the reflection, the depth loss and the gradient
    loss have reached a balance; a random change of opacities upsets both at once.

    Args:
        gaussians: the primary Gaussians.
        selected: [N] bool, which of them are seen through a pane (`behind_panes`).
        generator: source of the noise, on the device of `gaussians`.
        amplitude: the noise is uniform in [-amplitude, amplitude] and acts on the activated opacity.
        bounds: range the new opacities are clamped to. The paper does not give it; the lower bound
            lies above the pruning threshold and where a Gaussian still gets a gradient, so that
            those that were wrongly lowered can return.

    Returns:
        The Gaussians; forget the opacity moments of those selected.
    """
    opacities = torch.sigmoid(gaussians.logit_opacities)
    unit = torch.rand(opacities.shape, generator=generator, dtype=opacities.dtype, device=opacities.device)
    noisy = (opacities + amplitude * (2 * unit - 1)).clamp(*bounds)
    logit_opacities = torch.where(selected, torch.logit(noisy), gaussians.logit_opacities)
    return gaussians.with_tensors({"logit_opacities": logit_opacities})
