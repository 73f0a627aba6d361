"""What reflects, and what looks as if it should: shares of what the views show.

The paper counts reflective Gaussians. But a mirror ball that fills a third of the images may be a hundredth of the
Gaussians, of which most stand in empty space at first, and in a matte scene as many reflect a little.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from glassplat.data.view import View
from glassplat.render.contribution import contributions
from glassplat.render.frame import Frame, Renderer
from glassplat.scene.activations import SH_ZERO, logit
from glassplat.scene.scene import Scene

LEAST_SHOWN = 0.1
"""Pixels, of all views together, below which a Gaussian is not seen."""


@dataclass(frozen=True)
class Search:
    """How to tell what reflects, by what the views show of the region in which anything may.

    A Gaussian's residual in a view is the mean difference between photograph and render over its pixels, by its
    blending weights. Detail that is not resolved yet is the same in all views; a reflection is another in each. So it
    is the residual's spread over the views that tells them apart.

    Attributes:
        views: how many training views to look at.
        strength: Gaussians of more than this strength cannot have been overlooked (the paper's "reflective").
        spread: standard deviation of the residual over the views, sRGB, from which it turns with the view.
    """

    views: int = 12
    strength: float = 0.1
    spread: float = 0.04

    @torch.no_grad()
    def reflective(self, scene: Scene, views: Sequence[View]) -> float:
        """Share of what is seen that is reflection: the mean strength."""
        shown = sum((contributions(scene, view.camera) for view in evenly(views, self.views)), torch.zeros(()))
        return mean_in_region(scene, shown, torch.sigmoid(scene.primary.channels["logit_strength"]))

    @torch.no_grad()
    def turning(self, scene: Scene, views: Sequence[View], renderer: Renderer) -> float:
        """Share of what is seen that does not reflect, although its residual turns with the view."""
        shown, spreads = residual_spreads(scene, evenly(views, self.views), renderer)
        reflects = scene.primary.channels["logit_strength"] > logit(self.strength)
        return mean_in_region(scene, shown, ~reflects & (spreads > self.spread))


def evenly(views: Sequence[View], most: int) -> list[View]:
    """No more than so many of the views, evenly among all of them."""
    count = min(most, len(views))
    return [views[len(views) * number // count] for number in range(count)]


def mean_in_region(scene: Scene, shown: Tensor, values: Tensor) -> float:
    """Mean of values [N] over what is shown [N] of the Gaussians in the region; 0 where nothing is."""
    shown = torch.where(in_region(scene), shown, 0)
    return float((shown * values).sum() / shown.sum().clamp(min=1e-6))


def in_region(scene: Scene) -> Tensor:
    """[N] bool: which primary Gaussians lie where something may reflect."""
    means = scene.primary.means
    if scene.environment.region is None:
        return torch.ones(len(means), dtype=torch.bool, device=means.device)
    *center, radius = scene.environment.region
    return (means - means.new_tensor(center)).norm(dim=1) <= radius


def residual_spreads(scene: Scene, views: Sequence[View], renderer: Renderer) -> tuple[Tensor, Tensor]:
    """Of each primary Gaussian what the views show, in pixels, and how its residual spreads over them; [N] each."""
    count, device = len(scene.primary), scene.primary.means.device
    shown, squares = torch.zeros(2, count, device=device)
    sums = torch.zeros(count, 3, device=device)
    for view in views:
        weights, residuals = shown_and_residual(scene, view, renderer)
        shown += weights
        sums += residuals
        squares += residuals.square().sum(dim=1) / weights.clamp(min=1e-6)
    shown_or_one = shown.clamp(min=1e-6)
    variance = squares / shown_or_one - (sums / shown_or_one[:, None]).square().sum(dim=1)
    return shown, (variance.clamp(min=0) / 3).sqrt()


def shown_and_residual(scene: Scene, view: View, renderer: Renderer) -> tuple[Tensor, Tensor]:
    """[N] what a view shows of each primary Gaussian, in pixels, and [N, 3] photograph minus render over these."""
    return contributions(scene, view.camera), residual_sums(scene, view, renderer)


def residual_sums(scene: Scene, view: View, renderer: Renderer) -> Tensor:
    """[N, 3] photograph minus render, summed over the pixels of each primary Gaussian by its blending weights.

    That is the gradient with respect to its colour of the sum over pixels of residual times render.
    """
    with torch.enable_grad():
        sh = scene.primary.sh.detach().requires_grad_()
        frame = renderer(scene.with_parameters({"primary.sh": sh}), view.camera)
        (gradient,) = torch.autograd.grad(
            (residual(frame, view, scene) * frame.layers.get("base", frame.rgb)).sum(), sh
        )
    return gradient[:, 0] / SH_ZERO


def residual(frame: Frame, view: View, scene: Scene) -> Tensor:
    """[H, W, 3] photograph minus render, sRGB, 0 where the view is ignored."""
    image = scene.exposures.applied(frame.rgb.detach(), view.name)
    difference = view.photo.to(image) / 255 - image
    if view.ignored is not None:
        difference = difference.masked_fill(view.ignored.to(image.device)[..., None], 0)
    return difference
