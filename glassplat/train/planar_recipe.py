"""The recipe of `planar`: TR-Gaussians in three stages."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

from glassplat.data.dataset import Dataset
from glassplat.data.ranges import (
    ESSENTIAL,
    Ascending,
    Color,
    InnerShare,
    LearningRate,
    NotNegative,
    Positive,
    Range,
    Share,
    ShDegree,
)
from glassplat.densify.default import DefaultDensify
from glassplat.densify.mcmc import McmcDensify
from glassplat.init.planes import PlaneFit, PlaneFitError
from glassplat.kernels.panes import Fresnel
from glassplat.losses.geometry import depth_deviation_loss
from glassplat.losses.reflection import gradient_conflict, intensity_departure, mask_loss
from glassplat.losses.term import LossTerm, weighted
from glassplat.render.glazing import Blend
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.scene import Scene
from glassplat.train.actions import Densify, GrowSh, PerturbOpacity, ResetOpacity
from glassplat.train.background import BLACK
from glassplat.train.curved_mirrors import CurvedMirrors
from glassplat.train.optimizer import PUBLISHED_ITERATIONS, Rate
from glassplat.train.photo_exposure import PhotoExposure
from glassplat.train.photographer_entry import Photographer
from glassplat.train.plane_entry import PlaneEntry, fitted_planes
from glassplat.train.pose_refinement import PoseRefinement
from glassplat.train.splat_recipe import GaussianRates, image_terms
from glassplat.train.stage import Every, Stage
from glassplat.train.strategy import Population, Rhythm, Strategy, population_of


@dataclass(frozen=True)
class PlaneRates:
    """Learning rates of planes and glass, which the paper leaves out; see docs/experiments.md.

    Attributes:
        center: plane position in stage 2, per scene extent.
        normal: plane normal in stage 2.
        reflectance: logit of R0.
        mark: logit of the glass mark.
        joint_factor: factor on `center` and `normal` in stage 3 (paper: 0.1).
    """

    center: LearningRate = 1e-4
    normal: LearningRate = 1e-4
    reflectance: LearningRate = 1e-2
    mark: LearningRate = 5e-2
    joint_factor: Share = 0.1

    def of(self, factor: float) -> dict[str, Rate]:
        """The rates by dotted parameter name."""
        return {
            "planes.centers": Rate(self.center * factor, per_extent=True),
            "planes.raw_normals": Rate(self.normal * factor),
            "planes.logit_reflectances": Rate(self.reflectance),
            "glass.logit_mark": Rate(self.mark),
        }


@dataclass(frozen=True)
class ReflectionWeights:
    """Weights of the terms that tell reflection from transmission (TR-Gaussians, Eq. 17).

    Attributes:
        depth: of the depth deviation behind panes (Eq. 14).
        conflict: of edges that transmission and reflection share (Eq. 15).
        mask: of the difference between glass and annotation (Eq. 16).
        intensity: of the departure of a(u) from one, which the paper leaves free.
    """

    depth: NotNegative = 0.005
    conflict: NotNegative = 0.2
    mask: NotNegative = 0.5
    intensity: NotNegative = 0.05

    def terms(self) -> tuple[LossTerm, ...]:
        """The terms whose weight is not zero."""
        return weighted(
            LossTerm("depth", self.depth, depth_deviation_loss),
            LossTerm("conflict", self.conflict, gradient_conflict),
            LossTerm("mask", self.mask, mask_loss),
            LossTerm("intensity", self.intensity, intensity_departure),
        )


@dataclass(frozen=True)
class Perturbation:
    """When and how much the opacity of what lies behind a pane is perturbed (Section III-C3).

    It happens at the beats of `Rhythm` that do not reset the opacities.

    Attributes:
        amplitude: half width of the uniform noise on the opacity; 0 switches it off.
        stop: share of the run after which nothing is perturbed any more.
        bounds: of the new opacities. The paper does not give them; the lower one lies above the pruning threshold, so
            that what was wrongly lowered can return.
    """

    amplitude: Share = 0.4
    stop: Share = 0.8
    bounds: Annotated[tuple[InnerShare, InnerShare], Ascending()] = (0.01, 0.99)


@dataclass(frozen=True)
class PlanarRecipe:
    """TR-Gaussians: transmission, reflection and planes, trained in three stages.

    Attributes:
        sh_degree: highest degree of the view-dependent colour.
        ssim_weight: lambda, share of D-SSIM in the photometric loss.
        view_dependence_weight: of the squares of the spherical harmonics beyond the constant one. Mirrored views see
            Gaussians from where no photograph does, so that harmonics extrapolate; the paper has no such term.
        background: colour behind everything, sRGB; None is white where photographs are transparent, else black.
        stage_shares: lengths of the three stages in relation to each other (paper: 3000, 3000 and 24,000 iterations).
        multi_stage: False skips stage 2 (ablation).
        fresnel: how the strength rises with the angle: as that of a pane with two surfaces, by Schlick's curve of one
            surface as in the paper, or not at all (ablation).
        intensity: False drops the reflection intensity a(u) (ablation).
        blend: space in which transmission and reflection are blended: linear radiance, or sRGB as in the paper.
        panes: which panes on a ray reflect: all of them, one behind the other, or the nearest one as in the paper.
        detect_mirrors: treat panes that look like mirrors as mirrors, unless `plane_fit` names the mirrors.
        fixed_mirrors: mirrors keep their reflectance, and what the first stage built behind them moves to their front;
            if not, they only start at that reflectance, as in the paper.
        seed_reflections: start what no photograph shows directly from the virtual points behind the panes.
        glass_count: glass Gaussians placed on each pane.
        weights: of the loss terms; zero switches a term off (ablation).
        perturbation: of opacities; amplitude zero switches it off (ablation).
        moving_mean: let the gradient of the depth deviation pass through the mean depth too, as Eq. 14 is written; if
            not, Gaussians are drawn to the mean, and the mean not to them.
        rates: learning rates of the Gaussians.
        plane_rates: learning rates of planes and glass.
        plane_fit: how planes are found from masks.
        rhythm: when opacities are reset and the SH degree grows.
        strategy: what decides how many primary Gaussians there are and where: densification, or MCMC (Eq. 20), under
            which the set grows in the joint stage only, and opacities are reset once before it.
        early_growth: under `mcmc`, let the set grow from the first stage on, and reset no opacities, as in the paper.
            Many Gaussians then build the reflected room behind the panes, and no pruning removes it later.
        early_resets: reset opacities in the first two stages too, at the beats of the third, as in the paper.
        densify_by: the views by which primary Gaussians are densified: those that show them directly, or their mirror
            images where none does, each counting by what panes leave of it; or all views and mirror images alike.
        densify: when and how Gaussians are added and pruned under `default`.
        mcmc: when and how Gaussians are relocated and added under `mcmc`.
        exposure: whether the exposure of each photograph is learned.
        poses: whether the camera of each photograph is corrected.
        photographer: whether panes show who took the photographs.
        curved: whether things that are not flat mirror as well.
    """

    method: ClassVar[str] = "planar"

    sh_degree: Annotated[ShDegree, ESSENTIAL] = 3
    ssim_weight: Share = 0.2
    view_dependence_weight: NotNegative = 0.1
    background: Annotated[Color | None, ESSENTIAL] = None
    stage_shares: tuple[Positive, Positive, Positive] = (0.1, 0.1, 0.8)
    multi_stage: bool = True
    fresnel: Fresnel = "pane"
    intensity: bool = True
    blend: Blend = "linear"
    panes: Literal["all", "nearest"] = "all"
    detect_mirrors: Annotated[bool, ESSENTIAL] = True
    fixed_mirrors: bool = True
    seed_reflections: bool = True
    glass_count: Annotated[int, Range(1, 1_000_000)] = 1000
    weights: ReflectionWeights = field(default_factory=ReflectionWeights)
    moving_mean: bool = False
    perturbation: Perturbation = field(default_factory=Perturbation)
    rates: GaussianRates = field(default_factory=GaussianRates)
    plane_rates: PlaneRates = field(default_factory=PlaneRates)
    plane_fit: PlaneFit = field(default_factory=PlaneFit)
    rhythm: Rhythm = field(default_factory=Rhythm)
    strategy: Annotated[Strategy, ESSENTIAL] = "default"
    early_growth: bool = False
    early_resets: bool = False
    densify_by: Literal["direct", "all"] = "direct"
    densify: DefaultDensify = field(default_factory=DefaultDensify)
    mcmc: McmcDensify = field(default_factory=McmcDensify)
    exposure: PhotoExposure = field(default_factory=PhotoExposure)
    poses: PoseRefinement = field(default_factory=PoseRefinement)
    photographer: Photographer = field(default_factory=Photographer)
    curved: CurvedMirrors = field(default_factory=CurvedMirrors)

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
            weights=ReflectionWeights(intensity=0.0),
            moving_mean=True,
            perturbation=Perturbation(stop=29 / 30, bounds=(1e-6, 1 - 1e-6)),
            rates=GaussianRates(short_run_power=0.0),
            rhythm=Rhythm(averaged_passes=0.0),
            early_growth=True,
            early_resets=True,
            densify_by="all",
            densify=DefaultDensify.published(),
            mcmc=McmcDensify.published(),
        )

    def initialise(self, dataset: Dataset) -> Scene:
        """The first scene: one Gaussian per point, no planes yet.

        Raises:
            PlaneFitError: the masks do not do. The planes are fitted to the measured points once and forgotten,
                because a bad mask should end a run before the first iteration and not at the second stage.
        """
        if not dataset.pane_labels and dataset.planes is None:
            raise PlaneFitError(
                f"{self._lack_of_masks(dataset)}, and planar needs to know where the panes are: expected masks of 3 to "
                f"10 photographs in {dataset.root / 'masks'}, named <photograph's name>.png, each pixel the label 1, "
                "2, ... of a pane, or 0 (`glassplat annotate` writes them). `glassplat train splat` needs none"
            )
        if dataset.measured_points:
            fitted_planes(dataset, None, self.plane_fit)
        scene = Scene(self._population().initial(dataset.points, self.sh_degree), dataset.extent)
        return self.poses.begun(self.exposure.begun(scene, dataset), dataset)

    @staticmethod
    def _lack_of_masks(dataset: Dataset) -> str:
        count = sum(view.is_annotated for view in (*dataset.train, *dataset.test))
        return f"none of the {count} masks of {dataset.root} names a pane" if count else f"{dataset.root} has no masks"

    def contradiction(self) -> str | None:
        """What is wrong with the options together, if anything."""
        return self.curved.contradiction()

    def renderer(self) -> Planar:
        """The renderer of the finished scene, with all its layers."""
        return self.curved.renderer(self._of_panes())

    def _of_panes(self) -> Planar:
        """The renderer of panes, without curved mirrors."""
        return Planar(
            self.background or BLACK,
            fresnel=self.fresnel,
            intensity=self.intensity,
            blend=self.blend,
            nearest_only=self.panes == "nearest",
        )

    def stages(self, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
        """Initialisation, plane adjustment, joint optimisation (Section III-C4)."""
        first, second, third = self.stage_shares
        population = self._population()
        entry = PlaneEntry(
            self.plane_fit,
            self.glass_count,
            seed,
            detect_mirrors=self.detect_mirrors,
            fixed_mirrors=self.fixed_mirrors,
            seed_reflections=self.seed_reflections,
        )
        initialisation = Stage(
            name="1 initialisation",
            share=first,
            renderer=Splat(self.background or BLACK, depth=False),
            losses=(*image_terms(self.ssim_weight, self.view_dependence_weight), *population.terms),
            rates=self.rates.of("primary"),
            actions=(*population.edits, GrowSh(Every(self.rhythm.sh)), *self._early_resets(population)),
            motions=population.motions,
            densify_until=population.densify_until,
        )
        if not self.multi_stage:
            stages: tuple[Stage, ...] = (initialisation, replace(self._joint(second + third), entry=entry))
        else:
            stages = (initialisation, self._adjustment(second, entry), self._joint(third))
        stages = self.photographer.learnt_in(stages, self.densify, seed)
        stages = self.curved.learnt_in(stages, self.rhythm.sh)
        return self.poses.learnt_in(self.exposure.learnt_in(stages))

    def _adjustment(self, share: float, entry: PlaneEntry) -> Stage:
        """Stage 2: the reflection's gradient reaches the planes, not the Gaussians."""
        population = self._population()
        return Stage(
            name="2 plane adjustment",
            share=share,
            renderer=self._training_renderer("planes"),
            losses=self._joint_terms(population),
            rates=self.rates.of("primary") | self.rates.of("glass") | self.plane_rates.of(1.0),
            actions=(
                *population.edits,
                GrowSh(Every(self.rhythm.sh)),
                Densify(self.densify, part="glass"),
                *self._early_resets(population),
                *self._clearing(),
            ),
            motions=population.motions,
            entry=entry,
            densify_until=self.densify.stop,
        )

    def _joint(self, share: float) -> Stage:
        """Stage 3: everything learns, opacities are perturbed, planes move slowly."""
        population = self._population()
        beat = Every(self.rhythm.beat, 0.0, self.perturbation.stop, self.rhythm.least, skip_multiples_of=3)
        return Stage(
            name="3 joint optimisation",
            share=share,
            renderer=self._training_renderer("all"),
            losses=self._joint_terms(population),
            rates=self.rates.of("primary")
            | self.rates.of("glass")
            | self.plane_rates.of(self.plane_rates.joint_factor)
            | ({"primary.log_intensity": Rate(self.rates.intensity)} if self.intensity else {}),
            actions=(
                *population.edits,
                GrowSh(Every(self.rhythm.sh)),
                Densify(self.densify, part="glass"),
                *population.resets,
                *self._clearing(),
                PerturbOpacity(beat, self.perturbation.amplitude, self.perturbation.bounds),
            ),
            motions=population.motions,
            densify_until=self.densify.stop,
        )

    def _joint_terms(self, population: Population) -> tuple[LossTerm, ...]:
        image = image_terms(self.ssim_weight, self.view_dependence_weight)
        return (*image, *self.weights.terms(), *population.terms)

    def _population(self) -> Population:
        means_rate = self.rates.of("primary")["primary.means"]
        start = self.mcmc.start if self.early_growth else max(self.mcmc.start, self._joint_start)
        mcmc = replace(self.mcmc, start=start)
        return population_of(self.strategy, default=self.densify, mcmc=mcmc, rhythm=self.rhythm, means_rate=means_rate)

    def _early_resets(self, population: Population) -> tuple[ResetOpacity, ...]:
        """The resets of the first two stages, if there are to be any."""
        return population.resets if self.early_resets else ()

    def _clearing(self) -> tuple[ResetOpacity, ...]:
        """The one reset under `mcmc`, where joint optimisation begins; `default` has its own."""
        # A second one would come after the stop.
        once = Every(self._joint_start, stop=1.5 * self._joint_start)
        return (ResetOpacity(once),) if self.strategy == "mcmc" and not self.early_growth else ()

    @property
    def _joint_start(self) -> float:
        """Share of the run after which all three parts learn together."""
        first, second, third = self.stage_shares
        return (first + second) / (first + second + third)

    def _training_renderer(self, gradient: str) -> Planar:
        return replace(
            self._of_panes(),
            reflection_gradient="all" if gradient == "all" else "planes",
            deviation=self.weights.depth != 0,
            deviation_depth_gradient=self.moving_mean,
            tells_mirrored=self.densify_by == "direct",
        )
