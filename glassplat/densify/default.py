"""Adaptive density control of 3DGS: clone, split and prune by screen-space gradients."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from torch import Tensor

from glassplat.data.ranges import ESSENTIAL, Ascending, Count, NotNegative, Positive, PositiveShare, Several, Share
from glassplat.densify.edit import Edit, Moments, apply_edit, clone, forget, keep, split
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


@dataclass(frozen=True)
class DefaultDensify:
    """When and how 3DGS adds and removes Gaussians, with the criterion of AbsGS (arXiv 2404.10484) for splits.

    A small Gaussian whose mean screen gradient exceeds a threshold is cloned; a large one at which single pixels pull
    more than another threshold is split in two. Where a large Gaussian smears detail, pixels pull it to all sides;
    3DGS, which looks at the gradient here too, lets it be. Nearly transparent ones are removed.

    Attributes:
        split_by: what tells that a large Gaussian is too large: the `pull` of single pixels, or as in 3DGS the
            `gradient` that clones small ones.
        interval: steps between densifications.
        whole_passes: wait at least for about one pass over the views, twice the interval at the most, so that
            every Gaussian has been seen when it is judged.
        adapt_to_size: raise the thresholds where photographs are smaller than a megapixel, for which they were found.
        start: share of the run after which densification begins.
        stop: share of the run after which it ends.
        gradient_threshold: mean gradient norm, in normalised device coordinates, above which a small Gaussian is
            cloned.
        pull_threshold: mean pull of single pixels, in the same unit, above which a large Gaussian is split by `pull`.
        dense_fraction: Gaussians whose longest axis is above this share of the scene extent are
            split, smaller ones cloned.
        prune_opacity: Gaussians less opaque than this are removed.
        prune_large_start: share of the run after which what is too large is removed as well; 1 never does.
        prune_scale_fraction: with `prune_large`, Gaussians with an axis above this share of the
            scene extent are removed.
        prune_radius_fraction: with `prune_large`, Gaussians that any view saw with a radius above
            this share of its longer side are removed; None keeps them. 3DGS states a limit of 20
            pixels but clears the radii before it looks at them, so its published results have none.
        cap: largest number of Gaussians to grow to; None takes `per_pixel`.
        per_pixel: largest number of Gaussians to grow to for each pixel of all training photographs, which is reached
            where these contradict each other, by cars and leaves, and never stop asking for more; 0 for no limit.
        least_contribution: Gaussians that add less than so many pixels to every training view, directly and mirrored,
            are removed; 0 keeps them.
        contribution_moments: shares of the run at which they are: when the set has stopped growing, and in `planar`
            once more when nothing is perturbed any longer.
    """

    split_by: Literal["pull", "gradient"] = "pull"
    interval: Several = 100
    whole_passes: bool = True
    adapt_to_size: bool = True
    start: Share = 500 / 30_000
    stop: Share = 15_000 / 30_000
    gradient_threshold: Positive = 2e-4
    pull_threshold: Positive = 1.2e-3
    dense_fraction: Positive = 0.01
    prune_opacity: Share = 0.005
    prune_large_start: Share = 1.0
    prune_scale_fraction: Positive = 0.1
    prune_radius_fraction: PositiveShare | None = None
    cap: Annotated[Count | None, ESSENTIAL] = None
    per_pixel: NotNegative = 0.02
    least_contribution: NotNegative = 0.2
    contribution_moments: Annotated[tuple[Share, ...], Ascending()] = (0.5, 0.8)

    @staticmethod
    def published() -> DefaultDensify:
        """As 3DGS does it, which removes what is too large once the opacities have been reset."""
        return DefaultDensify(
            split_by="gradient",
            whole_passes=False,
            adapt_to_size=False,
            prune_large_start=3000 / 30_000,
            per_pixel=0.0,
            least_contribution=0.0,
        )

    @torch.no_grad()
    def densify(
        self,
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
        grown = self._growth(gaussians, statistics, extent=extent, generator=generator)
        radius = torch.where(grown.fresh, 0, statistics.max_radius[grown.source])
        superfluous = self._superfluous(gaussians, grown, radius, extent=extent, prune_large=prune_large)
        return apply_edit(gaussians, moments, grown.then(keep(~superfluous)), part=part)

    def _growth(
        self, gaussians: Gaussians, statistics: ScreenStatistics, *, extent: float, generator: torch.Generator
    ) -> Edit:
        large = gaussians.log_scales.amax(dim=1) > math.log(self.dense_fraction * extent)
        needs = statistics.mean_gradient / self.gradient_threshold
        if self.split_by == "pull":
            needs = torch.where(large, statistics.mean_pull / self.pull_threshold, needs)
        chosen = self._within_cap(needs)
        halved = split(gaussians, (chosen & large).nonzero().squeeze(1), generator=generator)
        # What was not split moved forward by as many rows as were split before it.
        row_after_split = (~(chosen & large)).cumsum(dim=0) - 1
        return halved.then(clone(len(halved), row_after_split[chosen & ~large]))

    def _within_cap(self, need: Tensor) -> Tensor:
        """[N] bool: what to clone or split, of what needs it by 1 or more; under a cap, what needs it most."""
        chosen = need >= 1
        if self.cap is None:
            return chosen
        room = max(self.cap - need.shape[0], 0)
        order = torch.where(chosen, need, -1).argsort(descending=True, stable=True)
        within = torch.zeros_like(chosen)
        within[order[:room]] = True
        return chosen & within

    def _superfluous(
        self, gaussians: Gaussians, edit: Edit, radius: Tensor, *, extent: float, prune_large: bool
    ) -> Tensor:
        """[M] bool: which Gaussians of the edited set to remove; `radius` [M] as in `max_radius`."""
        superfluous = torch.sigmoid(edit.result(gaussians, "logit_opacities")) < self.prune_opacity
        if prune_large:
            longest = edit.result(gaussians, "log_scales").amax(dim=1)
            superfluous |= longest > math.log(self.prune_scale_fraction * extent)
            if self.prune_radius_fraction is not None:
                superfluous |= radius > self.prune_radius_fraction
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
