"""The recipe of `splat`: 3D Gaussian Splatting."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from glassplat.data.dataset import Dataset
from glassplat.data.ranges import ESSENTIAL, Color, LearningRate, NotNegative, PositiveShare, Range, Share, ShDegree
from glassplat.densify.default import DefaultDensify
from glassplat.densify.mcmc import McmcDensify
from glassplat.losses.parsimony import view_dependence
from glassplat.losses.photometric import PhotometricLoss
from glassplat.losses.term import LossTerm, weighted
from glassplat.render.splat import Splat
from glassplat.scene.scene import Scene
from glassplat.train.actions import GrowSh
from glassplat.train.background import BLACK
from glassplat.train.optimizer import PUBLISHED_ITERATIONS, Rate
from glassplat.train.stage import Every, Stage
from glassplat.train.strategy import Population, Rhythm, Strategy, population_of


@dataclass(frozen=True)
class GaussianRates:
    """Learning rates of a set of Gaussians (3DGS).

    Attributes:
        means: position, per scene extent, at the start of the run; decays to `means_end`.
        decay: share of the run at which it has done so.
        sh: constant SH coefficient; the others get a twentieth.
        opacity, scale, rotation: of the raw values.
        intensity: of the reflection intensity's logarithm.
        short_run_power: in a run of n < 30,000 iterations the rates of position, colour, scale and rotation are
            (30,000 / n) to this power times as large, n being 3,000 at the least; 0 keeps the published ones
            (docs/experiments.md).
    """

    means: LearningRate = 1.6e-4
    means_end: PositiveShare = 1.6e-6
    decay: PositiveShare = 1.0
    sh: LearningRate = 2.5e-3
    opacity: LearningRate = 5e-2
    scale: LearningRate = 5e-3
    rotation: LearningRate = 1e-3
    intensity: LearningRate = 5e-3
    short_run_power: Annotated[float, Range(0, 2)] = 0.5

    def of(self, part: str) -> dict[str, Rate]:
        """The rates by dotted parameter name."""
        power = self.short_run_power
        return {
            f"{part}.means": Rate(self.means, self.means_end, decay=self.decay, per_extent=True, short_run_power=power),
            f"{part}.sh": Rate(self.sh, rest=1 / 20, short_run_power=power),
            f"{part}.logit_opacities": Rate(self.opacity),
            f"{part}.log_scales": Rate(self.scale, short_run_power=power),
            f"{part}.quats": Rate(self.rotation, short_run_power=power),
        }


def image_terms(ssim_weight: float, view_dependence_weight: float) -> tuple[LossTerm, ...]:
    """(1 - lambda) L1 + lambda D-SSIM (TR-Gaussians, Eq. 18), and what keeps colours from turning with the view."""
    return weighted(
        LossTerm("photometric", 1.0, PhotometricLoss(ssim_weight)),
        LossTerm("view dependence", view_dependence_weight, view_dependence),
    )


@dataclass(frozen=True)
class SplatRecipe:
    """Plain 3D Gaussian Splatting, the baseline.

    Attributes:
        sh_degree: highest degree of the view-dependent colour.
        ssim_weight: lambda, share of D-SSIM in the photometric loss.
        view_dependence_weight: of the squares of the spherical harmonics beyond the constant one.
        background: colour behind everything, sRGB; None is white where photographs are transparent, else black.
        rates: learning rates.
        rhythm: when opacities are reset and the SH degree grows.
        strategy: what decides how many Gaussians there are and where; `densify` or `mcmc` holds its options.
        densify: when and how Gaussians are added and pruned under `default`.
        mcmc: when and how Gaussians are relocated and added under `mcmc`.
    """

    method: ClassVar[str] = "splat"

    sh_degree: Annotated[ShDegree, ESSENTIAL] = 3
    ssim_weight: Share = 0.2
    view_dependence_weight: NotNegative = 0.0
    background: Annotated[Color | None, ESSENTIAL] = None
    rates: GaussianRates = field(default_factory=GaussianRates)
    rhythm: Rhythm = field(default_factory=Rhythm)
    strategy: Annotated[Strategy, ESSENTIAL] = "default"
    densify: DefaultDensify = field(default_factory=DefaultDensify)
    mcmc: McmcDensify = field(default_factory=McmcDensify)

    @classmethod
    def paper(cls) -> SplatRecipe:
        """As published: 3DGS, or 3DGS-MCMC with that strategy (docs/splat.md)."""
        return cls(
            rates=GaussianRates(short_run_power=0.0),
            rhythm=Rhythm(averaged_passes=0.0),
            densify=DefaultDensify.published(),
            mcmc=McmcDensify.published(),
        )

    def initialise(self, dataset: Dataset) -> Scene:
        """The first scene: one Gaussian per point."""
        return Scene(self._population().initial(dataset.points, self.sh_degree), dataset.extent)

    def renderer(self) -> Splat:
        """The renderer of the finished scene, with all its layers."""
        return Splat(self.background or BLACK)

    def stages(self, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
        """One stage."""
        population = self._population()
        return (
            Stage(
                name="splat",
                share=1.0,
                renderer=Splat(self.background or BLACK, depth=False),
                losses=(*image_terms(self.ssim_weight, self.view_dependence_weight), *population.terms),
                rates=self.rates.of("primary"),
                actions=(*population.edits, GrowSh(Every(self.rhythm.sh)), *population.resets),
                motions=population.motions,
                densify_until=population.densify_until,
            ),
        )

    def _population(self) -> Population:
        means_rate = self.rates.of("primary")["primary.means"]
        return population_of(
            self.strategy, default=self.densify, mcmc=self.mcmc, rhythm=self.rhythm, means_rate=means_rate
        )
