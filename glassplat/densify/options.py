"""What can be said of the number of Gaussians and of how mirrors are found and spread; what heeds it is beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from glassplat.data.ranges import (
    ESSENTIAL,
    Ascending,
    Count,
    InnerShare,
    Internal,
    NotNegative,
    Positive,
    PositiveShare,
    Range,
    Several,
    Share,
)


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

    split_by: Internal[Literal["pull", "gradient"]] = "pull"
    interval: Internal[Several] = 100
    whole_passes: Internal[bool] = True
    adapt_to_size: Internal[bool] = True
    start: Internal[Share] = 500 / 30_000
    stop: Share = 15_000 / 30_000
    gradient_threshold: Positive = 2e-4
    pull_threshold: Positive = 1.2e-3
    dense_fraction: Internal[Positive] = 0.01
    prune_opacity: Share = 0.005
    prune_large_start: Internal[Share] = 1.0
    prune_scale_fraction: Internal[Positive] = 0.1
    prune_radius_fraction: Internal[PositiveShare | None] = None
    cap: Annotated[Count | None, ESSENTIAL] = None
    per_pixel: NotNegative = 0.02
    least_contribution: NotNegative = 0.2
    contribution_moments: Internal[Annotated[tuple[Share, ...], Ascending()]] = (0.5, 0.8)

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


@dataclass(frozen=True)
class McmcDensify:
    """When and how Gaussians are relocated, added and moved (Kheradmand et al. 2024).

    Attributes:
        cap: largest number of Gaussians to grow to; None takes half as many as a photograph has pixels, for what
            detail can be told apart follows the pixels.
        interval: steps between relocations.
        start: share of the run after which relocation begins.
        stop: share of the run after which relocation and growth end; the noise goes on.
        growth: factor by which the number grows in every three hundredth of the run, until the cap: with the published
            30,000 iterations at every relocation. A single relocation at most doubles it.
        dead_opacity: Gaussians at most this opaque are relocated.
        noise_rate: noise on the positions, as a multiple of their learning rate; 0 switches it
            off.
        noise_units: in which variances and learning rate are multiplied: scene `extents`, so that the noise is the same
            whatever the capture's units, or as published `world` units.
        noise_sharpness: how fast the noise fades above `dead_opacity`.
        opacity_weight: lambda_o, weight of the mean opacity in the objective.
        scale_weight: lambda_Sigma, weight of the mean standard deviation in the objective.
        reach: what noise and regularisers act on at a step: what its view shows (`shown`; the regularisers on what it
            shows directly), or as published on `all` Gaussians.
        initial_opacity: opacity of the first Gaussians.
        initial_spread: standard deviation of the first Gaussians, as a share of the distance to their neighbours. The
            published 0.1 takes a thousand steps or more to grow over the gaps (docs/experiments.md).
    """

    cap: Annotated[Count | None, ESSENTIAL, tyro.conf.arg(aliases=("--cap",))] = None
    interval: Internal[Several] = 100
    start: Internal[Share] = 500 / 30_000
    stop: Internal[Share] = 25_000 / 30_000
    growth: Internal[Annotated[float, Range(1, 100)]] = 1.05
    dead_opacity: Internal[InnerShare] = 0.005
    noise_rate: NotNegative = 5e5
    noise_units: Internal[Literal["extents", "world"]] = "extents"
    noise_sharpness: Internal[NotNegative] = 100.0
    opacity_weight: NotNegative = 0.01
    scale_weight: NotNegative = 0.01
    reach: Internal[Literal["shown", "all"]] = "shown"
    initial_opacity: Internal[InnerShare] = 0.5
    initial_spread: Internal[Positive] = 1.0

    @staticmethod
    def published() -> McmcDensify:
        """As 3DGS-MCMC does it."""
        return McmcDensify(reach="all", noise_units="world", initial_spread=0.1)


@dataclass(frozen=True)
class MirrorSearch:
    """What is taken for a mirror when reflections begin, and as which.

    Attributes:
        begin_found: whether anything is; without, every strength grows from `first_strength` (the papers).
        views: how many training views to look at.
        spread: standard deviation over the views of a Gaussian's colour, sRGB, from which it looks like a mirror.
        strength: reflection strength of what was found.
        least_opacity: opacities of what was found are raised to this.
        flatness: of what was found, the shortest axis as a share of the middle one, at most.
        estimated_normals: turn what was found as the normals say that lie in `normals/` beside the photographs, and
            only where there are none as the depths say.
    """

    begin_found: bool = True
    views: Annotated[int, Range(2, 1000)] = 24
    spread: Share = 0.03
    strength: InnerShare = 0.73
    least_opacity: InnerShare = 0.9
    flatness: InnerShare = 0.37
    estimated_normals: bool = True


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
