"""Normal propagation and colour sabotage (3DGS-DR, Section 3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from glassplat.data.ranges import InnerShare, Range, Share
from glassplat.densify.edit import Moments, forget
from glassplat.scene.activations import logit
from glassplat.scene.gaussians import SH_ZERO, Gaussians


@dataclass(frozen=True)
class NormalPropagation:
    """How reflective Gaussians grow over their neighbours, and how the colours of the others are disturbed.

    A reflective Gaussian has a nearly correct normal. Where it overlaps another one, the blended normal is nearly
    correct too, so that the other receives a gradient that means something.

    Attributes:
        propagates: whether normals are propagated at all (ablation).
        least_opacity: every opacity is raised to this, so that every visible Gaussian counts.
        least_strength: every reflection strength is raised to this, so that it has a gradient.
        reflective: Gaussians of at least this strength grow (paper: 0.1; its code: 0.02).
        growth: factor on their two longer axes, or both of a disc; the shortest is the normal and stays.
        sabotage: half width of the uniform noise on the constant colour (paper: 0.1; its code: 0.4 on the constant
            coefficient, which is 0.113); 0 switches it off (ablation).
        sabotaged: Gaussians of at most this strength are disturbed (paper: 0.1; its code: 0.05).
    """

    propagates: bool = True
    least_opacity: InnerShare = 0.9
    least_strength: InnerShare = 1e-3
    reflective: InnerShare = 0.02
    growth: Annotated[float, Range(1, 100)] = 1.5
    sabotage: Share = 0.1
    sabotaged: InnerShare = 0.05

    @torch.no_grad()
    def propagate(
        self, gaussians: Gaussians, moments: Moments, where: Tensor | None = None
    ) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
        """Raised opacities and strengths, and reflective Gaussians grown; what changed forgets its moments.

        `where` [N] bool leaves the others as they are; None leaves none.
        """
        if not self.propagates:
            return gaussians, dict(moments)
        where = torch.ones_like(gaussians.logit_opacities, dtype=torch.bool) if where is None else where
        opacities = gaussians.logit_opacities.clamp(min=logit(self.least_opacity))
        strengths = gaussians.channels["logit_strength"].clamp(min=logit(self.least_strength))
        grows = where & (strengths >= logit(self.reflective))
        log_scales = gaussians.log_scales + math.log(self.growth) * (grows[:, None] & _within_surface(gaussians))
        changed = {
            "logit_opacities": torch.where(where, opacities, gaussians.logit_opacities),
            "logit_strength": torch.where(where, strengths, gaussians.channels["logit_strength"]),
            "log_scales": log_scales,
        }
        return gaussians.with_tensors(changed), forget(moments, [f"primary.{name}" for name in changed], where)

    @torch.no_grad()
    def disturb(
        self, gaussians: Gaussians, moments: Moments, generator: torch.Generator, where: Tensor | None = None
    ) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
        """Noise on the constant colour of what does not reflect yet, which hinders it from explaining reflections.

        `where` [N] bool leaves the others as they are; None leaves none.
        """
        if self.sabotage == 0:
            return gaussians, dict(moments)
        unit = torch.rand(gaussians.sh[:, 0].shape, generator=generator, device=gaussians.sh.device)
        dull = gaussians.channels["logit_strength"] <= logit(self.sabotaged)
        dull = dull if where is None else dull & where
        sh = gaussians.sh.clone()
        sh[:, 0] += torch.where(dull[:, None], self.sabotage * (2 * unit - 1) / SH_ZERO, 0)
        return gaussians.with_tensors({"sh": sh}), forget(moments, ["primary.sh"], dull)

    def count_reflective(self, gaussians: Gaussians) -> int:
        """How many Gaussians reflect, by the measure of the paper's criterion for the end (strength above 0.1)."""
        return int((gaussians.channels["logit_strength"] > logit(0.1)).sum())


def _within_surface(gaussians: Gaussians) -> Tensor:
    """[N, 3] or of discs [N, 2] bool: which axes lie within the surface, all but the shortest and all of a disc's."""
    if gaussians.are_discs:
        return torch.ones_like(gaussians.log_scales, dtype=torch.bool)
    return ~torch.nn.functional.one_hot(gaussians.log_scales.argmin(dim=1), 3).bool()
