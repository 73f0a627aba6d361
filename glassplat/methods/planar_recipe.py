"""The recipe of `planar`: TR-Gaussians in three stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from glassplat.captures.masks import PANE_FOLDER, PLANES
from glassplat.kernels import Fresnel
from glassplat.options import (
    ESSENTIAL,
    Ascending,
    Blend,
    Internal,
    NonNegative,
    OpenShare,
    Positive,
    Range,
    Share,
)
from glassplat.panes import PlaneFit, PlaneFitError
from glassplat.training.options import (
    DefaultDensify,
    GaussianRates,
    Intervals,
    McmcDensify,
    MethodRecipe,
    Photographer,
)

if TYPE_CHECKING:
    from glassplat.captures.files import CaptureFiles


@dataclass(frozen=True)
class ReflectionWeights:
    """Weights of the loss terms that separate reflection from transmission (TR-Gaussians, Eq. 17).

    Attributes:
        depth: weight of the depth deviation behind panes (Eq. 14).
        conflict: weight of edges shared by transmission and reflection (Eq. 15).
        mask: weight of the difference between glass and masks (Eq. 16).
        intensity: weight of the deviation of a(u) from one, which the paper leaves free.
        reflectance: weight of the deviation of R0 from `--plane-fit.glass-reflectance`; it decides R0 where no
            photograph shows what is reflected.
    """

    depth: NonNegative = 0.005
    conflict: NonNegative = 0.2
    mask: NonNegative = 0.5
    intensity: NonNegative = 0.05
    reflectance: NonNegative = 0.0002


@dataclass(frozen=True)
class Perturbation:
    """Perturbation of opacities behind panes: times and amplitude (Section III-C3).

    It happens at the intervals of `Intervals.opacity` that do not reset the opacities.

    Attributes:
        amplitude: half width of the uniform noise on the opacity; 0 disables it.
        stop: share of the run after which perturbation ends.
        bounds: bounds of the new opacities, which the paper does not give; the lower one is above the pruning
            threshold, so that wrongly lowered opacities can recover.
    """

    amplitude: Share = 0.4
    stop: Internal[Share] = 0.8
    bounds: Internal[Annotated[tuple[OpenShare, OpenShare], Ascending()]] = (0.01, 0.99)


def check_marked(root: Path, labels: Sequence[int], *, is_annotated: bool) -> None:
    """Raises PlaneFitError if neither masks nor planes.json give a capture's panes labels."""
    if labels:
        return
    found = f"no mask of {root} names a pane" if is_annotated else f"{root} has no masks of panes"
    raise PlaneFitError(
        f"{found}, and planar needs to know the panes: expected masks of 3 to 10 photographs in {root / PANE_FOLDER}, "
        "named <photograph's name>.png, each pixel the label 1, 2, ... of a pane, or 0 (`glassplat annotate` writes "
        f"them), or rectangles in {PLANES}. `glassplat train splat` needs none"
    )


@dataclass(frozen=True)
class PlanarRecipe(MethodRecipe):
    """TR-Gaussians: transmission, reflection and planes, trained in three stages.

    Attributes:
        view_dependence_weight: weight of the squared SH coefficients beyond the constant one. Mirrored views see
            Gaussians from directions that no photograph covers; the paper has no such term.
        stage_shares: lengths of the three stages in relation to each other (paper: 3000, 3000 and 24,000 iterations);
            None for the paper's, but at most 350 iterations for each of the first two. The longer these last, the more
            reflections they model by Gaussians behind panes.
        fresnel: angular dependence of the strength: a pane with two surfaces, Schlick's approximation for one surface
            (paper), or none (ablation).
        intensity: False drops the reflection intensity a(u) (ablation).
        blend: space in which transmission and reflection are blended: linear radiance, or sRGB as in the paper.
        panes: which panes on a ray reflect: all of them, one behind the other, or the nearest one as in the paper.
        detect_mirrors: detect which panes are mirrors, unless `--plane-fit.mirror-labels` names them.
        fixed_mirrors: freeze the reflectance of mirrors and move Gaussians behind them to the front; otherwise, mirrors
            only start with that reflectance (paper).
        seed_reflections: initialise parts that no photograph shows directly from the virtual points behind panes, and
            fill missing parts halfway through the run.
        turn_reflections: move Gaussians behind glass that represent reflections to the front in the joint stage, and
            make lamps as bright as their reflections.
        seed_unexplained: add Gaussians where photographs agree on a missing object, twice early in a run.
        tint: learn the transmittance of each pane for red, green and blue light (not in the paper).
        tint_weight: weight of the mean squared logarithm of that transmittance.
        glass_count: number of glass Gaussians on each pane.
        weights: weights of the loss terms; 0 disables a term (ablation).
        conflict: evaluation of L_c: over cells, limited to edges that a pane could have left in the transmission, or
            per pixel as in the paper.
        perturbation: perturbation of opacities; amplitude 0 disables it (ablation).
        moving_mean: propagate the gradient of the depth deviation through the mean depth, too, as Eq. 14 is written;
            otherwise the mean is constant.
        plane_fit: fitting of planes to masks.
        strategy: strategy for adding and removing primary Gaussians: densification, or MCMC (Eq. 20). MCMC
            begins with joint optimisation, and resets opacities once, after reflections behind panes were moved to
            their front; with `--preset paper`, it begins with the run and resets none.
        early_resets: also reset opacities in the first two stages, as in the paper.
        densify_by: views for the densification of primary Gaussians: `direct` ones, or mirror images (weighted by the
            root of their strength) if these need more detail; or `all` direct and mirrored views alike (paper).
        photographer: reflection of the photographer in the panes.
    """

    method = "planar"
    functions = "glassplat.methods.planar:planar"
    view_dependence_weight: NonNegative = 0.02
    stage_shares: Internal[tuple[Positive, Positive, Positive] | None] = None
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
    tint_weight: NonNegative = 0.01
    glass_count: Annotated[int, Range(1, 1_000_000)] = 1000
    weights: ReflectionWeights = field(default_factory=ReflectionWeights)
    conflict: Internal[Literal["cells", "pixels"]] = "cells"
    moving_mean: Internal[bool] = False
    perturbation: Perturbation = field(default_factory=Perturbation)
    plane_fit: PlaneFit = field(default_factory=PlaneFit)
    early_resets: Internal[bool] = False
    densify_by: Internal[Literal["direct", "all"]] = "direct"
    photographer: Photographer = field(default_factory=Photographer)

    def check_capture(self, files: CaptureFiles) -> None:
        """Raises PlaneFitError if the capture marks no pane; planes.json is read later."""
        if not (files.root / PLANES).is_file():
            check_marked(files.root, files.masks.labels, is_annotated=bool(files.masks.masks))

    @classmethod
    def paper(cls) -> PlanarRecipe:
        """As published, as far as the paper specifies it; docs/planar.md lists the rest."""
        return cls(
            view_dependence_weight=0.0,
            stage_shares=(0.1, 0.1, 0.8),
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
