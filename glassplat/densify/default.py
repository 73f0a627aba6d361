"""Adaptive density control of 3DGS: clone, split and prune by screen-space gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from glassplat.densify.edit import Edit, Moments, apply_edit, clone, forget, keep, split
from glassplat.densify.options import DefaultDensify
from glassplat.kernels.screen_statistics import Sums, Views, add_views
from glassplat.scene.activations import logit
from glassplat.scene.gaussians import Gaussians


@dataclass(frozen=True)
class ScreenStatistics:
    """What the views since the last densification saw of each Gaussian.

    Gradients are in normalised device coordinates, in which the image spans [-1, 1] both ways: thresholds do not
    depend on its resolution. Sums and counts have two rows, over all views and over those that see the Gaussian
    directly. In a mirror it is farther away: whether it is too coarse is seen where it is close, and in mirrors only
    where no view shows it directly.

    Attributes:
        gradient_sum: [2, N] sum over views of the norm of the loss gradient with respect to the centre on screen.
        pull_sum: [2, N] the same of what single pixels contribute to that gradient, added up without signs.
        view_count: [2, N] number of views that saw the Gaussian; one in or through a pane counts by how much of what is
            drawn is left in the image. Gradients are smaller by as much; counted as a full view, a weak reflection
            would look as if it needed no more detail.
        max_radius: [N] largest radius on screen, as a share of the longer image side.
    """

    gradient_sum: Tensor
    pull_sum: Tensor
    view_count: Tensor
    max_radius: Tensor

    @staticmethod
    def zeros(count: int, *, device: torch.device | str = "cpu") -> ScreenStatistics:
        """Statistics of `count` Gaussians that no view has seen."""
        gradients, pulls, views = torch.zeros(3, 2, count, device=device)
        return ScreenStatistics(gradients, pulls, views, torch.zeros(count, device=device))

    def add(self, views: Views) -> None:
        """Adds the views of one training step, in place."""
        add_views(Sums(self.gradient_sum, self.pull_sum, self.view_count, self.max_radius), views)

    @torch.no_grad()
    def add_in_space(self, means_gradient: Tensor, distances: Tensor) -> None:
        """Adds a training step in which rays met the Gaussians in space, in place (EnvGS, Section 5.1).

        A gradient times half of the distance at which a Gaussian was met is what on a screen would be one in normalised
        device coordinates; without that factor, what is far away would get too few Gaussians.

        Args:
            means_gradient: [N, 3] gradient of one view's loss with respect to the centres.
            distances: [N] at which they were met, world units.
        """
        norms = means_gradient.norm(dim=-1)
        pulls = 0.5 * distances * norms
        for total, added in ((self.gradient_sum, pulls), (self.pull_sum, pulls), (self.view_count, norms > 0)):
            total += added

    @property
    def mean_gradient(self) -> Tensor:
        """[N] mean gradient norm over the views that saw the Gaussian, direct ones if there are any; 0 if none did."""
        return self._mean(self.gradient_sum)

    @property
    def mean_pull(self) -> Tensor:
        """[N] mean pull of single pixels over the views that saw the Gaussian, as `mean_gradient`."""
        return self._mean(self.pull_sum)

    def _mean(self, total: Tensor) -> Tensor:
        over_all, over_direct = total / self.view_count.clamp(min=1)
        return torch.where(self.view_count[1] > 0, over_direct, over_all)


@torch.no_grad()
def densified(
    options: DefaultDensify,
    gaussians: Gaussians,
    moments: Moments,
    statistics: ScreenStatistics,
    *,
    extent: float,
    generator: torch.Generator,
    part: str = "primary",
    prune_large: bool = False,
) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
    """A set of Gaussians and their moments after cloning, splitting and pruning.

    Statistics start again at `ScreenStatistics.zeros` afterwards.

    Args:
        options: when and how.
        gaussians: the set to edit.
        moments: optimiser moments by dotted name; those of other parts pass through.
        statistics: what was gathered since the last call, one row per Gaussian.
        extent: radius of the capture in world units.
        generator: source of randomness, on the device of `gaussians`.
        part: the scene part that `gaussians` is.
        prune_large: also remove what is too large; 3DGS does so once the opacities have been
            reset for the first time.
    """
    if statistics.max_radius.shape[0] != len(gaussians):
        raise ValueError(
            f"statistics hold {statistics.max_radius.shape[0]} rows for {len(gaussians)} Gaussians; "
            "start new statistics whenever the set has changed"
        )
    grown = _growth(options, gaussians, statistics, extent=extent, generator=generator)
    radius = torch.where(grown.fresh, 0, statistics.max_radius[grown.source])
    superfluous = _superfluous(options, gaussians, grown, radius, extent=extent, prune_large=prune_large)
    return apply_edit(gaussians, moments, grown.then(keep(~superfluous)), part=part)


def _growth(
    options: DefaultDensify,
    gaussians: Gaussians,
    statistics: ScreenStatistics,
    *,
    extent: float,
    generator: torch.Generator,
) -> Edit:
    large = gaussians.log_scales.amax(dim=1) > math.log(options.dense_fraction * extent)
    needs = statistics.mean_gradient / options.gradient_threshold
    if options.split_by == "pull":
        needs = torch.where(large, statistics.mean_pull / options.pull_threshold, needs)
    chosen = _within_cap(options, needs)
    halved = split(gaussians, (chosen & large).nonzero().squeeze(1), generator=generator)
    # What was not split moved forward by as many rows as were split before it.
    row_after_split = (~(chosen & large)).cumsum(dim=0) - 1
    return halved.then(clone(len(halved), row_after_split[chosen & ~large]))


def _within_cap(options: DefaultDensify, need: Tensor) -> Tensor:
    """[N] bool: what to clone or split, of what needs it by 1 or more; under a cap, what needs it most."""
    chosen = need >= 1
    if options.cap is None:
        return chosen
    room = max(options.cap - need.shape[0], 0)
    order = torch.where(chosen, need, -1).argsort(descending=True, stable=True)
    within = torch.zeros_like(chosen)
    within[order[:room]] = True
    return chosen & within


def _superfluous(
    options: DefaultDensify, gaussians: Gaussians, edit: Edit, radius: Tensor, *, extent: float, prune_large: bool
) -> Tensor:
    """[M] bool: which Gaussians of the edited set to remove; `radius` [M] as in `max_radius`."""
    superfluous = torch.sigmoid(edit.result(gaussians, "logit_opacities")) < options.prune_opacity
    if prune_large:
        longest = edit.result(gaussians, "log_scales").amax(dim=1)
        superfluous |= longest > math.log(options.prune_scale_fraction * extent)
        if options.prune_radius_fraction is not None:
            superfluous |= radius > options.prune_radius_fraction
    return superfluous


@torch.no_grad()
def reset_opacity(
    gaussians: Gaussians, moments: Moments, *, ceiling: float = 0.01, part: str = "primary"
) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
    """Lowers every opacity to at most `ceiling` and forgets the opacities' moments (3DGS, Section 5.2).

    What the photographs need grows back; what does not is pruned.
    """
    lowered = gaussians.logit_opacities.clamp(max=logit(ceiling))
    return gaussians.with_tensors({"logit_opacities": lowered}), forget(moments, (f"{part}.logit_opacities",))
