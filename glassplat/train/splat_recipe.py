"""The recipe of `splat`: 3D Gaussian Splatting, or 2D Gaussian Splatting with discs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

from glassplat.data.dataset import Dataset
from glassplat.data.ranges import ESSENTIAL, Color, LearningRate, NotNegative, PositiveShare, Range, Share, ShDegree
from glassplat.densify.default import DefaultDensify
from glassplat.densify.mcmc import McmcDensify
from glassplat.init.points import as_discs
from glassplat.losses.discs import disc_normals, distortion
from glassplat.losses.parsimony import view_dependence
from glassplat.losses.photometric import PhotometricLoss
from glassplat.losses.term import LossTerm, weighted
from glassplat.render.splat import Splat
from glassplat.scene.scene import Scene
from glassplat.train.actions import GrowSh
from glassplat.train.background import BLACK
from glassplat.train.optimizer import PUBLISHED_ITERATIONS, Rate
from glassplat.train.photo_exposure import PhotoExposure
from glassplat.train.pose_refinement import PoseRefinement
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


Primitive = Literal["ellipsoid", "disc"]


@dataclass(frozen=True)
class DiscTerms:
    """What keeps discs on one surface (2DGS, Section 4.2); ellipsoids know none of it.

    Attributes:
        distortion_weight: of how far apart along a ray lies what a pixel shows; 2DGS takes 1000 for bounded scenes.
        distortion_start: share of the run after which it counts.
        normal_weight: of how far the discs' normals are from those of their depths.
        normal_start: share of the run after which it counts.
    """

    distortion_weight: NotNegative = 100.0
    distortion_start: Share = 3_000 / 30_000
    normal_weight: NotNegative = 0.05
    normal_start: Share = 7_000 / 30_000

    def by_start(self) -> tuple[tuple[float, LossTerm], ...]:
        """The terms that count at all, with the shares of the run after which they do, in order."""
        terms = (
            (self.distortion_start, LossTerm("distortion", self.distortion_weight, distortion)),
            (self.normal_start, LossTerm("normals", self.normal_weight, disc_normals)),
        )
        wanted = [(start, term) for start, term in terms if term.weight > 0 and start < 1]
        return tuple(sorted(wanted, key=lambda pair: pair[0]))


@dataclass(frozen=True)
class SplatRecipe:
    """Plain Gaussian Splatting, the baseline: of ellipsoids (3DGS) or discs (2DGS).

    Attributes:
        primitive: what the scene is made of: ellipsoids, or discs, which have normals and lie on surfaces.
        sh_degree: highest degree of the view-dependent colour.
        ssim_weight: lambda, share of D-SSIM in the photometric loss.
        view_dependence_weight: of the squares of the spherical harmonics beyond the constant one.
        background: colour behind everything, sRGB; None is white where photographs are transparent, else black.
        rates: learning rates.
        rhythm: when opacities are reset and the SH degree grows.
        strategy: what decides how many Gaussians there are and where; `densify` or `mcmc` holds its options.
        densify: when and how Gaussians are added and pruned under `default`.
        mcmc: when and how Gaussians are relocated and added under `mcmc`.
        discs: what keeps discs on one surface.
        exposure: whether the exposure of each photograph is learned.
        poses: whether the camera of each photograph is corrected.
    """

    method: ClassVar[str] = "splat"

    primitive: Annotated[Primitive, ESSENTIAL] = "ellipsoid"
    sh_degree: Annotated[ShDegree, ESSENTIAL] = 3
    ssim_weight: Share = 0.2
    view_dependence_weight: NotNegative = 0.0
    background: Annotated[Color | None, ESSENTIAL] = None
    rates: GaussianRates = field(default_factory=GaussianRates)
    rhythm: Rhythm = field(default_factory=Rhythm)
    strategy: Annotated[Strategy, ESSENTIAL] = "default"
    densify: DefaultDensify = field(default_factory=DefaultDensify)
    mcmc: McmcDensify = field(default_factory=McmcDensify)
    discs: DiscTerms = field(default_factory=DiscTerms)
    exposure: PhotoExposure = field(default_factory=PhotoExposure)
    poses: PoseRefinement = field(default_factory=PoseRefinement)

    @classmethod
    def paper(cls) -> SplatRecipe:
        """As published: 3DGS, or 3DGS-MCMC with that strategy, or 2DGS with discs (docs/splat.md)."""
        return cls(
            rates=GaussianRates(short_run_power=0.0),
            rhythm=Rhythm(averaged_passes=0.0),
            densify=DefaultDensify.published(),
            mcmc=McmcDensify.published(),
        )

    def initialise(self, dataset: Dataset) -> Scene:
        """The first scene: one Gaussian per point."""
        first = self._population().initial(dataset.points, self.sh_degree)
        scene = Scene(as_discs(first) if self.primitive == "disc" else first, dataset.extent)
        return self.poses.begun(self.exposure.begun(scene, dataset), dataset)

    def renderer(self) -> Splat:
        """The renderer of the finished scene, with all its layers."""
        return Splat(self.background or BLACK)

    def stages(self, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
        """One stage; of discs a new one whenever one of their terms begins to count."""
        population = self._population()
        first = Stage(
            name="splat",
            share=1.0,
            renderer=self._bare(),
            losses=(*image_terms(self.ssim_weight, self.view_dependence_weight), *population.terms),
            rates=self.rates.of("primary"),
            actions=(*population.edits, GrowSh(Every(self.rhythm.sh)), *population.resets),
            motions=population.motions,
            densify_until=population.densify_until,
        )
        stages, began = [first], 0.0
        for start, term in self.discs.by_start() if self.primitive == "disc" else ():
            last = stages.pop()
            stages += [replace(last, share=start - began)] if start > began else []
            losses = (*last.losses, term)
            with_normals = any(known.function is disc_normals for known in losses)
            name = f"{last.name}, {term.name}"
            stages.append(replace(last, name=name, renderer=self._bare(normal=with_normals), losses=losses))
            began = start
        stages[-1] = replace(stages[-1], share=1 - began)
        return self.poses.learnt_in(self.exposure.learnt_in(tuple(stages)))

    def _bare(self, *, normal: bool = False) -> Splat:
        """The renderer with what the losses need and no more."""
        return Splat(self.background or BLACK, depth=False, normal=normal)

    def _population(self) -> Population:
        means_rate = self.rates.of("primary")["primary.means"]
        return population_of(
            self.strategy, default=self.densify, mcmc=self.mcmc, rhythm=self.rhythm, means_rate=means_rate
        )
