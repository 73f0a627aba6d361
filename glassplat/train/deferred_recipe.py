"""The recipe of `deferred`: 3D Gaussian Splatting with Deferred Reflection."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, ClassVar

import torch

from glassplat.data.dataset import Dataset
from glassplat.data.ranges import (
    ESSENTIAL,
    Ascending,
    Color,
    Finite,
    InnerShare,
    LearningRate,
    NotNegative,
    Positive,
    Range,
    Several,
    Share,
    ShDegree,
)
from glassplat.densify.default import DefaultDensify
from glassplat.densify.mcmc import McmcDensify
from glassplat.densify.mirrors import MirrorSearch
from glassplat.densify.propagate import NormalPropagation
from glassplat.losses.geometry import normal_consistency
from glassplat.losses.reflectors import mean_strength, mean_tint, strength_outside
from glassplat.losses.term import LossTerm, weighted
from glassplat.render.deferred import INVISIBLE, Deferred, Shading
from glassplat.render.splat import Splat
from glassplat.scene.activations import logit
from glassplat.scene.gaussians import SH_ZERO
from glassplat.scene.scene import Scene
from glassplat.scene.tint import TINT
from glassplat.train.actions import Densify, GrowSh, ResetOpacity
from glassplat.train.background import BLACK
from glassplat.train.environment_entry import AddEnvironment, StayMatte
from glassplat.train.optimizer import PUBLISHED_ITERATIONS, Rate
from glassplat.train.photo_exposure import PhotoExposure
from glassplat.train.pose_refinement import PoseRefinement
from glassplat.train.propagation import (
    DensifyWhilePropagating,
    GrowShAfterPropagation,
    Propagate,
    PropagationSchedule,
    RefineEnvironment,
    ResetRaised,
)
from glassplat.train.reflection_entry import BeginReflections
from glassplat.train.splat_recipe import GaussianRates, SplatRecipe, image_terms
from glassplat.train.stage import Action, Every, Stage
from glassplat.train.strategy import Population, Rhythm, Strategy, population_of

CODE_ITERATIONS = 61_000
"""Length of the runs of the public code on synthetic scenes."""
Texels = Annotated[int, Range(1, 2048)]


@dataclass(frozen=True)
class ReflectionRates:
    """Learning rates of what reflects.

    Attributes:
        strength: logit of the reflection strength.
        environment: raw texels of the environment.
        tint: logits of what red, green and blue reflect more or less strongly.
    """

    strength: LearningRate = 2e-2
    environment: LearningRate = 5e-2
    tint: LearningRate = 2e-2

    def of(self) -> dict[str, Rate]:
        """The rates by dotted parameter name."""
        tints = {f"primary.{name}": Rate(self.tint) for name in TINT}
        return {"primary.logit_strength": Rate(self.strength), "environment.raw": Rate(self.environment), **tints}


@dataclass(frozen=True)
class DeferredRecipe:
    """3DGS-DR: a strength and a normal for every Gaussian, one environment, and shading per pixel.

    Attributes:
        sh_degree: highest degree of the view-dependent colour, which grows once propagation has ended.
        ssim_weight: lambda, share of D-SSIM in the photometric loss.
        view_dependence_weight: of the squares of the spherical harmonics beyond the constant one.
        background: colour behind everything, sRGB; None is white where photographs are transparent, else black.
        shading: per pixel (`deferred`), or per Gaussian (`forward`, ablation).
        bootstrap: share of the run without reflection (paper: a few thousand iterations); where mirrors are searched
            for afterwards it is a run of `splat`, else harmonics wait.
        texels: edge length of the environment's cube faces in the end.
        first_texels: edge length at the start.
        refinements: shares of the run at which the edge length doubles for the first and for the last time on the way
            from `first_texels` to `texels`; other doublings are spread evenly in between.
        first_strength: reflection strength of every Gaussian at the start.
        search: what is taken for a mirror at once when reflections begin.
        region: only what lies in this sphere may reflect: centre and radius, world units. None leaves it to
            `find_region`.
        find_region: look for the place that the cameras stand around; if not, everything may reflect unless `region`
            says otherwise, as in the paper.
        outside_weight: weight of the mean strength outside of the region in the objective.
        strength_weight: of the mean strength of all Gaussians in the objective, which the paper does not have: a matte
            thing would learn to reflect a little.
        tint: reflections may have a colour, as those of gold and copper do, which the paper does not have.
        tint_weight: of the mean square of what gives them one in the objective.
        consistency_weight: weight of the difference between normals and the slope of the depths, while normals spread.
        propagation: how normals spread and colours are sabotaged.
        schedule: when they do.
        least_iterations: of the shortest run in which anything reflects. A shorter one would be over before the colours
            have learnt what the reflections leave to them; it trains like one of `splat`.
        hurry_matte: raise the learning rates to those of `splat` for the rest of a run in which nothing was found that
            reflects, and for all of one that is too short to look for it.
        hurry_found: so that `hurry_matte` counts after propagation where something reflects, too; before, high rates
            would spoil its normals.
        propagation_interval: steps between densifications while normals spread; None keeps `densify.interval`.
        rates: learning rates of the Gaussians; they do not rise in short runs, which costs a mirror ball its normals
            (docs/experiments.md).
        reflection_rates: learning rates of strength and environment.
        rhythm: when opacities are reset and the SH degree grows.
        strategy: what decides how many Gaussians there are and where; `densify` or `mcmc` holds its options.
        densify: when and how Gaussians are added and pruned under `default`.
        mcmc: when and how Gaussians are relocated and added under `mcmc`.
        exposure: whether the exposure of each photograph is learned.
        poses: whether the camera of each photograph is corrected.
    """

    method: ClassVar[str] = "deferred"

    sh_degree: Annotated[ShDegree, ESSENTIAL] = 3
    ssim_weight: Share = 0.2
    view_dependence_weight: NotNegative = 0.0
    background: Annotated[Color | None, ESSENTIAL] = None
    shading: Shading = "deferred"
    bootstrap: Share = 0.06
    texels: Annotated[Texels, ESSENTIAL] = 64
    first_texels: Texels = 16
    refinements: Annotated[tuple[Share, Share], Ascending()] = (0.45, 0.65)
    first_strength: InnerShare = 1e-3
    search: MirrorSearch = field(default_factory=MirrorSearch)
    region: Annotated[tuple[Finite, Finite, Finite, Positive] | None, ESSENTIAL] = None
    find_region: bool = True
    outside_weight: NotNegative = 0.4
    strength_weight: NotNegative = 0.005
    tint: Annotated[bool, ESSENTIAL] = False
    tint_weight: NotNegative = 2e-4
    consistency_weight: NotNegative = 0.3
    propagation: NormalPropagation = field(default_factory=NormalPropagation)
    schedule: PropagationSchedule = field(default_factory=PropagationSchedule)
    least_iterations: Several = 6000
    hurry_matte: bool = True
    hurry_found: bool = True
    propagation_interval: Several | None = None
    rates: GaussianRates = field(default_factory=partial(GaussianRates, short_run_power=0.0))
    reflection_rates: ReflectionRates = field(default_factory=ReflectionRates)
    rhythm: Rhythm = field(default_factory=lambda: Rhythm(beat=0.005, least=150))
    strategy: Annotated[Strategy, ESSENTIAL] = "default"
    densify: DefaultDensify = field(default_factory=DefaultDensify)
    mcmc: McmcDensify = field(default_factory=McmcDensify)
    exposure: PhotoExposure = field(default_factory=PhotoExposure)
    poses: PoseRefinement = field(default_factory=PoseRefinement)

    @classmethod
    def paper(cls) -> DeferredRecipe:
        """As published; where paper and public code disagree, with the constants of the code (docs/deferred.md)."""
        published = DefaultDensify.published()
        return cls(
            bootstrap=3000 / CODE_ITERATIONS,
            search=MirrorSearch(begin_found=False),
            texels=128,
            first_texels=128,
            find_region=False,
            strength_weight=0.0,
            consistency_weight=0.0,
            propagation=NormalPropagation(sabotage=0.4 * SH_ZERO),
            schedule=PropagationSchedule(end="fixed", stop=24_000 / CODE_ITERATIONS, pause=200, last_reset=False),
            least_iterations=1,
            hurry_matte=False,
            hurry_found=False,
            propagation_interval=500,
            rates=GaussianRates(decay=30_000 / CODE_ITERATIONS, short_run_power=0.0),
            reflection_rates=ReflectionRates(strength=6e-3),
            rhythm=Rhythm(
                beat=1000 / CODE_ITERATIONS,
                least=150,
                reset_stop=29_000 / CODE_ITERATIONS,
                sh=1000 / CODE_ITERATIONS,
                averaged_passes=0.0,
            ),
            densify=replace(
                published,
                start=500 / CODE_ITERATIONS,
                stop=30_000 / CODE_ITERATIONS,
                prune_large_start=3000 / CODE_ITERATIONS,
            ),
            mcmc=McmcDensify.published(),
        )

    def initialise(self, dataset: Dataset) -> Scene:
        """The first scene: one Gaussian per point that hardly reflects, and no environment yet."""
        primary = self._population().initial(dataset.points, self.sh_degree)
        strengths = torch.full((len(primary),), logit(self.first_strength))
        primary = replace(primary, channels={"logit_strength": strengths})
        scene = Scene(primary, dataset.extent)
        return self.poses.begun(self.exposure.begun(scene, dataset), dataset)

    def renderer(self) -> Deferred:
        """The renderer of the finished scene, with all its layers."""
        return Deferred(self.background or BLACK, self.shading, least_strength=INVISIBLE)

    def stages(self, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
        """Bootstrap, then everything; what changes in between is up to `Propagate`. A short run has one stage."""
        short = iterations < self.least_iterations
        stages = self._matte_stages(seed, iterations) if short else self._reflecting_stages()
        return self.poses.learnt_in(self.exposure.learnt_in(stages))

    def _reflecting_stages(self) -> tuple[Stage, ...]:
        """Those of a run that is long enough for normals to spread."""
        population = self._population()
        image = image_terms(self.ssim_weight, self.view_dependence_weight)
        bootstrap = Stage(
            name="1 bootstrap",
            share=self.bootstrap,
            renderer=Splat(self.background or BLACK, depth=False),
            losses=(*image, *population.terms),
            rates=(self._rates_of_splat() if self.search.begin_found else self.rates).of("primary"),
            actions=(*population.edits, *self._regular(population)),
            motions=population.motions,
            densify_until=population.densify_until,
        )
        beat = Every(self.rhythm.beat, 0.0, self.schedule.stop, self.rhythm.least, skip_multiples_of=3)
        renderer = Deferred(self.background or BLACK, self.shading, depth=self.consistency_weight != 0)
        guidance = weighted(
            LossTerm("outside", self.outside_weight, strength_outside),
            LossTerm("strength", self.strength_weight, mean_strength),
            LossTerm("tint", self.tint_weight if self.tint else 0.0, mean_tint),
            LossTerm("consistency", self.consistency_weight, normal_consistency),
        )
        reflection = Stage(
            name="2 reflection",
            share=self.schedule.stop - self.bootstrap,
            renderer=renderer,
            losses=(*image, *guidance, *population.terms),
            rates=self.rates.of("primary") | self.reflection_rates.of(),
            actions=(
                *self._edits(population),
                # Before the resets: it looks at what is seen, also at the beats that it leaves to them.
                self._propagate(beat, renderer),
                GrowShAfterPropagation(Every(self.rhythm.sh)),
                *self._resets(population),
                RefineEnvironment(self._doublings(), self.texels),
            ),
            motions=population.motions,
            entry=self.entry(),
            densify_until=population.densify_until,
        )
        refinement = replace(
            reflection,
            entry=None,
            name="3 refinement",
            share=1 - self.schedule.stop,
            renderer=Deferred(self.background or BLACK, self.shading, depth=False),
            losses=tuple(term for term in reflection.losses if term.name != "consistency"),
        )
        return bootstrap, reflection, refinement

    def _matte_stages(self, seed: int, iterations: int) -> tuple[Stage, ...]:
        """The one stage of a run that is too short for normals to spread: that of `splat`."""
        usual = Rhythm()
        plain = SplatRecipe(
            sh_degree=self.sh_degree,
            ssim_weight=self.ssim_weight,
            view_dependence_weight=self.view_dependence_weight,
            background=self.background,
            rates=self._rates_of_splat(),
            rhythm=replace(self.rhythm, beat=usual.beat, least=usual.least),
            strategy=self.strategy,
            densify=self.densify,
            mcmc=self.mcmc,
        )
        (stage,) = plain.stages(seed)
        entry = StayMatte(iterations, self.least_iterations, self._environment())
        return (replace(stage, name="as splat", entry=entry),)

    def _rates_of_splat(self) -> GaussianRates:
        """The learning rates where nothing reflects that higher ones would spoil."""
        return replace(self.rates, short_run_power=GaussianRates().short_run_power) if self.hurry_matte else self.rates

    def _regular(self, population: Population) -> tuple[Action, ...]:
        """What happens in the bootstrap as in `splat`: a scene has to look right for mirrors to be told from it."""
        return (GrowSh(Every(self.rhythm.sh)), *population.resets) if self.search.begin_found else ()

    def entry(self) -> BeginReflections:
        """How things begin to reflect."""
        seen_by = Splat(self.background or BLACK, depth=False)
        return BeginReflections(self._environment(), None, self.search, seen_by, self.tint, harmonics_wait=True)

    def _environment(self) -> AddEnvironment:
        """What is mirrored."""
        return AddEnvironment(min(self.first_texels, self.texels), self.region, self.find_region)

    def contradiction(self) -> str | None:
        """What is wrong with the options together, if anything."""
        if self.schedule.stop <= self.bootstrap:
            return (
                f"--schedule.stop is {self.schedule.stop} and --bootstrap {self.bootstrap}; normals spread in between, "
                "so expected --schedule.stop to be larger"
            )
        return None

    def _doublings(self) -> tuple[float, ...]:
        """The shares of the run at which the environment's edge length doubles."""
        return doublings(self.first_texels, self.texels, self.refinements)

    def _edits(self, population: Population) -> tuple[Action, ...]:
        """What changes the number of Gaussians once they reflect."""
        if self.propagation_interval is None or self.strategy == "mcmc":
            return population.edits
        slow = replace(self.densify, interval=self.propagation_interval)
        return tuple(
            DensifyWhilePropagating(slow, regular=edit) if isinstance(edit, Densify) else edit
            for edit in population.edits
        )

    def _resets(self, population: Population) -> tuple[ResetOpacity, ...]:
        """The resets during and after propagation."""
        if not self.schedule.last_reset:
            return population.resets
        return tuple(ResetRaised.instead_of(reset) for reset in population.resets)

    def _propagate(self, beat: Every, renderer: Deferred) -> Propagate:
        return Propagate(
            beat,
            self.propagation,
            self.schedule,
            renderer,
            matte_rates=self._matte_rates(),
            hurries_found=self.hurry_found,
        )

    def _matte_rates(self) -> dict[str, Rate]:
        """What brings the learning rates to those of `splat`, where nothing reflects that higher ones would spoil."""
        if not self.hurry_matte:
            return {}
        missing = GaussianRates().short_run_power - self.rates.short_run_power
        return {
            name: Rate(1.0, short_run_power=missing)
            for name, rate in GaussianRates().of("primary").items()
            if rate.short_run_power
        }

    def _population(self) -> Population:
        means_rate = self.rates.of("primary")["primary.means"]
        return population_of(
            self.strategy, default=self.densify, mcmc=self.mcmc, rhythm=self.rhythm, means_rate=means_rate
        )


def doublings(first_texels: int, texels: int, refinements: tuple[float, float]) -> tuple[float, ...]:
    """The shares of the run, evenly from a first to a last one, at which an edge length doubles until it is reached."""
    count = max(math.ceil(math.log2(texels / first_texels)), 0)
    first, last = refinements
    return tuple(first + (last - first) * number / max(count - 1, 1) for number in range(count))
