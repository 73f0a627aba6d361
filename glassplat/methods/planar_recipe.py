"""The recipe of `planar`: TR-Gaussians in three stages."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal

from glassplat.kernels import Fresnel
from glassplat.options import (
    ESSENTIAL,
    Ascending,
    Blend,
    InnerShare,
    Internal,
    NotNegative,
    Positive,
    Range,
    Share,
)
from glassplat.panes import PlaneFit
from glassplat.training.options import (
    DefaultDensify,
    GaussianRates,
    Intervals,
    McmcDensify,
    MethodRecipe,
    Photographer,
)


@dataclass(frozen=True)
class ReflectionWeights:
    """Weights of the terms that tell reflection from transmission (TR-Gaussians, Eq. 17).

    Attributes:
        depth: of the depth deviation behind panes (Eq. 14).
        conflict: of edges that transmission and reflection share (Eq. 15).
        mask: of the difference between glass and annotation (Eq. 16).
        intensity: of the departure of a(u) from one, which the paper leaves free.
        reflectance: of the departure of R0 from `--plane-fit.glass-reflectance`, which decides where no photograph
            shows what is mirrored.
    """

    depth: NotNegative = 0.005
    conflict: NotNegative = 0.2
    mask: NotNegative = 0.5
    intensity: NotNegative = 0.05
    reflectance: NotNegative = 0.0002


@dataclass(frozen=True)
class Perturbation:
    """Perturbation of the opacity of what lies behind a pane: times and amount (Section III-C3).

    It happens at the intervals of `Intervals.opacity` that do not reset the opacities.

    Attributes:
        amplitude: half width of the uniform noise on the opacity; 0 switches it off.
        stop: share of the run after which nothing is perturbed any more.
        bounds: of the new opacities. The paper does not give them; the lower one lies above the pruning threshold, so
            that what was wrongly lowered can return.
    """

    amplitude: Share = 0.4
    stop: Internal[Share] = 0.8
    bounds: Internal[Annotated[tuple[InnerShare, InnerShare], Ascending()]] = (0.01, 0.99)


@dataclass(frozen=True)
class PlanarRecipe(MethodRecipe):
    """TR-Gaussians: transmission, reflection and planes, trained in three stages.

    Attributes:
        view_dependence_weight: of the squares of the spherical harmonics beyond the constant one. Mirrored views see
            Gaussians from where no photograph does, so that harmonics extrapolate; the paper has no such term.
        stage_shares: lengths of the three stages in relation to each other (paper: 3000, 3000 and 24,000 iterations).
        fresnel: how the strength rises with the angle: as that of a pane with two surfaces, by Schlick's curve of one
            surface as in the paper, or not at all (ablation).
        intensity: False drops the reflection intensity a(u) (ablation).
        blend: space in which transmission and reflection are blended: linear radiance, or sRGB as in the paper.
        panes: which panes on a ray reflect: all of them, one behind the other, or the nearest one as in the paper.
        detect_mirrors: treat panes that look like mirrors as mirrors, unless `--plane-fit.mirror-labels` names them.
        fixed_mirrors: mirrors keep their reflectance, and what the first stage built behind them moves to their front;
            if not, they only start at that reflectance, as in the paper.
        seed_reflections: start what no photograph shows directly from the virtual points behind the panes, and fill
            what no Gaussian stands for halfway through the run.
        turn_reflections: move what was built behind glass, for what that mirrors, to its front in the joint stage, and
            make lamps as bright as their reflections are.
        seed_unexplained: add Gaussians where photographs agree on something that the scene lacks, twice early in a run.
        tint: panes may be tinted: each learns what share of red, green and blue light gets through (not in the paper).
        tint_weight: of the mean square of the logarithm of that share in the objective.
        glass_count: glass Gaussians placed on each pane.
        weights: of the loss terms; zero switches a term off (ablation).
        conflict: where edges that the layers share count (L_c): in cells, and as far as a pane could have left them in
            the transmission, or pixel by pixel as in the paper.
        perturbation: of opacities; amplitude zero switches it off (ablation).
        moving_mean: let the gradient of the depth deviation pass through the mean depth too, as Eq. 14 is written; if
            not, Gaussians are drawn to the mean, and the mean not to them.
        plane_fit: how planes are found from masks.
        strategy: what decides how many primary Gaussians there are and where: densification, or MCMC (Eq. 20), under
            which opacities are reset once, after reflections were turned round.
        early_resets: reset opacities in the first two stages too, at the intervals of the third, as in the paper.
        densify_by: the views by which primary Gaussians are densified: those that show them directly, or their mirror
            images if these need more detail, each counting by what panes leave of it; or all views and mirror images
            alike.
        photographer: whether panes show who took the photographs.
    """

    method = "planar"
    functions = "glassplat.methods.planar:planar"
    view_dependence_weight: NotNegative = 0.02
    stage_shares: Internal[tuple[Positive, Positive, Positive]] = (0.1, 0.1, 0.8)
    fresnel: Internal[Fresnel] = "pane"
    intensity: Internal[bool] = True
    blend: Internal[Blend] = "linear"
    panes: Internal[Literal["all", "nearest"]] = "all"
    detect_mirrors: Annotated[bool, ESSENTIAL] = True
    fixed_mirrors: Internal[bool] = True
    seed_reflections: Internal[bool] = True
    turn_reflections: Internal[bool] = True
    seed_unexplained: Internal[bool] = True
    tint: bool = False
    tint_weight: NotNegative = 0.01
    glass_count: Annotated[int, Range(1, 1_000_000)] = 1000
    weights: ReflectionWeights = field(default_factory=ReflectionWeights)
    conflict: Internal[Literal["cells", "pixels"]] = "cells"
    moving_mean: Internal[bool] = False
    perturbation: Perturbation = field(default_factory=Perturbation)
    plane_fit: PlaneFit = field(default_factory=PlaneFit)
    early_resets: Internal[bool] = False
    densify_by: Internal[Literal["direct", "all"]] = "direct"
    photographer: Photographer = field(default_factory=Photographer)

    @classmethod
    def paper(cls) -> PlanarRecipe:
        """As published, as far as the paper says; docs/planar.md lists what it leaves open."""
        return cls(
            view_dependence_weight=0.0,
            fresnel="schlick",
            blend="srgb",
            panes="nearest",
            detect_mirrors=False,
            fixed_mirrors=False,
            seed_reflections=False,
            turn_reflections=False,
            seed_unexplained=False,
            weights=ReflectionWeights(intensity=0.0, reflectance=0.0),
            conflict="pixels",
            moving_mean=True,
            plane_fit=PlaneFit(glass_reflectance=0.2),
            perturbation=Perturbation(stop=29 / 30, bounds=(1e-6, 1 - 1e-6)),
            rates=GaussianRates(short_run_power=0.0),
            intervals=Intervals(averaged_passes=0.0),
            early_resets=True,
            densify_by="all",
            densify=DefaultDensify.published(),
            mcmc=McmcDensify.published(),
        )
