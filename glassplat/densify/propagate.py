"""Normal propagation and colour sabotage (3DGS-DR, Section 3.3)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from glassplat.densify.edit import Moments, forget
from glassplat.densify.options import NormalPropagation
from glassplat.scene.activations import SH_ZERO, logit
from glassplat.scene.gaussians import Gaussians


@torch.no_grad()
def normals_propagated(
    options: NormalPropagation, gaussians: Gaussians, moments: Moments
) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
    """Raised opacities and strengths, and reflective Gaussians grown; what changed forgets its moments."""
    if not options.propagates:
        return gaussians, dict(moments)
    opacities = gaussians.logit_opacities.clamp(min=logit(options.least_opacity))
    strengths = gaussians.channels["logit_strength"].clamp(min=logit(options.least_strength))
    grows = strengths >= logit(options.reflective)
    log_scales = gaussians.log_scales + math.log(options.growth) * (grows[:, None] & _within_surface(gaussians))
    changed = {
        "logit_opacities": opacities,
        "logit_strength": strengths,
        "log_scales": log_scales,
    }
    everything = torch.ones_like(grows)
    return gaussians.with_tensors(changed), forget(moments, [f"primary.{name}" for name in changed], everything)


@torch.no_grad()
def colors_disturbed(
    options: NormalPropagation, gaussians: Gaussians, moments: Moments, generator: torch.Generator
) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
    """Noise on the constant colour of what does not reflect yet, which hinders it from explaining reflections."""
    if options.sabotage == 0:
        return gaussians, dict(moments)
    unit = torch.rand(gaussians.sh[:, 0].shape, generator=generator, device=gaussians.sh.device)
    dull = gaussians.channels["logit_strength"] <= logit(options.sabotaged)
    sh = gaussians.sh.clone()
    sh[:, 0] += torch.where(dull[:, None], options.sabotage * (2 * unit - 1) / SH_ZERO, 0)
    return gaussians.with_tensors({"sh": sh}), forget(moments, ["primary.sh"], dull)


def _within_surface(gaussians: Gaussians) -> Tensor:
    """[N, 3] or of discs [N, 2] bool: which axes lie within the surface, all but the shortest and all of a disc's."""
    if gaussians.are_discs:
        return torch.ones_like(gaussians.log_scales, dtype=torch.bool)
    return ~torch.nn.functional.one_hot(gaussians.log_scales.argmin(dim=1), 3).bool()
