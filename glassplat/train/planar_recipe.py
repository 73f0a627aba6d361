"""The recipe of `planar`: TR-Gaussians in three stages."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

from glassplat.data.dataset import Dataset
from glassplat.densify.default import DefaultDensify
from glassplat.densify.mcmc import McmcDensify
from glassplat.init.planes import PlaneFit, PlaneFitError, fit_planes
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
from glassplat.train.optimizer import Rate
from glassplat.train.plane_entry import PlaneEntry, annotations_of
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

    center: float = 1e-4
    normal: float = 1e-4
    reflectance: float = 1e-2
    mark: float = 5e-2
    joint_factor: float = 0.1

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

    depth: float = 0.005
    conflict: float = 0.2
    mask: float = 0.5
    intensity: float = 0.05

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
    """

    amplitude: float = 0.4
    stop: float = 0.8


@dataclass(frozen=True)
class PlanarRecipe:
    """TR-Gaussians: transmission, reflection and planes, trained in three stages.

    Attributes:
        sh_degree: highest degree of the view-dependent colour.
        ssim_weight: lambda, share of D-SSIM in the photometric loss.
        view_dependence_weight: of the squares of the spherical harmonics beyond the constant one. Mirrored views see
            Gaussians from where no photograph does, so that harmonics extrapolate; the paper has no such term.
        background: colour behind everything, sRGB; None is white where photographs are transparent, else black.
        stage_shares: lengths of the three stages (paper: 3000, 3000 and 24,000 iterations).
        multi_stage: False skips stage 2 (ablation).
        fresnel: how the strength rises with the angle: as that of a pane with two surfaces, by Schlick's curve of one
            surface as in the paper, or not at all (ablation).
        intensity: False drops the reflection intensity a(u) (ablation).
        blend: space in which transmission and reflection are blended: linear radiance, or sRGB as in the paper.
        detect_mirrors: treat panes that look like mirrors as mirrors, unless `plane_fit` names the mirrors.
        seed_reflections: start what no photograph shows directly from the virtual points behind the panes.
        glass_count: glass Gaussians placed on each pane.
        weights: of the loss terms; zero switches a term off (ablation).
        perturbation: of opacities; amplitude zero switches it off (ablation).
        rates: learning rates of the Gaussians.
        plane_rates: learning rates of planes and glass.
        plane_fit: how planes are found from masks.
        rhythm: when opacities are reset and the SH degree grows.
        strategy: what decides how many primary Gaussians there are and where. With `mcmc` its relocation takes the
            place of densification and its regularisers join the loss (Eq. 20). The set grows in the joint stage only,
            before which opacities are reset once: many Gaussians would build the reflected room behind the panes in
            the first stage, and no pruning removes it later. The perturbation keeps its beats. The glass is densified
            by `densify` either way.
        densify: when and how Gaussians are added and pruned under `default`.
        mcmc: when and how Gaussians are relocated and added under `mcmc`.
    """

    method: ClassVar[str] = "planar"

    sh_degree: int = 3
    ssim_weight: float = 0.2
    view_dependence_weight: float = 0.1
    background: tuple[float, float, float] | None = None
    stage_shares: tuple[float, float, float] = (0.1, 0.1, 0.8)
    multi_stage: bool = True
    fresnel: Fresnel = "pane"
    intensity: bool = True
    blend: Blend = "linear"
    detect_mirrors: bool = True
    seed_reflections: bool = True
    glass_count: int = 1000
    weights: ReflectionWeights = field(default_factory=ReflectionWeights)
    perturbation: Perturbation = field(default_factory=Perturbation)
    rates: GaussianRates = field(default_factory=GaussianRates)
    plane_rates: PlaneRates = field(default_factory=PlaneRates)
    plane_fit: PlaneFit = field(default_factory=PlaneFit)
    rhythm: Rhythm = field(default_factory=Rhythm)
    strategy: Strategy = "default"
    densify: DefaultDensify = field(default_factory=DefaultDensify)
    mcmc: McmcDensify = field(default_factory=McmcDensify)

    def initialise(self, dataset: Dataset) -> Scene:
        """The first scene: one Gaussian per point, no planes yet.

        Raises:
            PlaneFitError: the masks do not do. The planes are fitted to the measured points once and forgotten,
                because a bad mask should end a run before the first iteration and not at the second stage.
        """
        if not dataset.pane_labels:
            raise PlaneFitError(
                f"{self._lack_of_masks(dataset)}, and planar needs to know where the panes are: expected masks of 3 to "
                f"10 photographs in {dataset.root / 'masks'}, named <photograph's name>.png, each pixel the label 1, "
                "2, ... of a pane, or 0. `glassplat train splat` needs none"
            )
        if dataset.measured_points:
            positions, annotations = dataset.points.positions, annotations_of(dataset)
            fit_planes(positions, annotations, extent=dataset.extent, options=self.plane_fit)
        return Scene(self._population().initial(dataset.points, self.sh_degree), dataset.extent)

    @staticmethod
    def _lack_of_masks(dataset: Dataset) -> str:
        count = sum(view.is_annotated for view in (*dataset.train, *dataset.test))
        return f"none of the {count} masks of {dataset.root} names a pane" if count else f"{dataset.root} has no masks"

    def renderer(self) -> Planar:
        """The renderer of the finished scene, with all its layers."""
        return Planar(self.background or BLACK, fresnel=self.fresnel, intensity=self.intensity, blend=self.blend)

    def stages(self, seed: int) -> tuple[Stage, ...]:
        """Initialisation, plane adjustment, joint optimisation (Section III-C4)."""
        first, second, third = self.stage_shares
        population = self._population()
        entry = PlaneEntry(self.plane_fit, self.glass_count, seed, self.detect_mirrors, self.seed_reflections)
        initialisation = Stage(
            name="1 initialisation",
            share=first,
            renderer=Splat(self.background or BLACK, depth=False),
            losses=(*image_terms(self.ssim_weight, self.view_dependence_weight), *population.terms),
            rates=self.rates.of("primary"),
            actions=(*population.edits, GrowSh(Every(self.rhythm.sh))),
            motions=population.motions,
            densify_until=population.densify_until,
        )
        if not self.multi_stage:
            return initialisation, replace(self._joint(second + third), entry=entry)
        return initialisation, self._adjustment(second, entry), self._joint(third)

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
                PerturbOpacity(beat, self.perturbation.amplitude),
            ),
            motions=population.motions,
            densify_until=self.densify.stop,
        )

    def _joint_terms(self, population: Population) -> tuple[LossTerm, ...]:
        image = image_terms(self.ssim_weight, self.view_dependence_weight)
        return (*image, *self.weights.terms(), *population.terms)

    def _population(self) -> Population:
        means_rate = self.rates.of("primary")["primary.means"]
        late = replace(self.mcmc, start=max(self.mcmc.start, self._joint_start))
        return population_of(self.strategy, default=self.densify, mcmc=late, rhythm=self.rhythm, means_rate=means_rate)

    def _clearing(self) -> tuple[ResetOpacity, ...]:
        """The one reset under `mcmc`, where joint optimisation begins; `default` has its own."""
        # A second one would come after the stop.
        once = Every(self._joint_start, stop=1.5 * self._joint_start)
        return (ResetOpacity(once),) if self.strategy == "mcmc" else ()

    @property
    def _joint_start(self) -> float:
        """Share of the run after which all three parts learn together."""
        first, second, third = self.stage_shares
        return (first + second) / (first + second + third)

    def _training_renderer(self, gradient: str) -> Planar:
        return Planar(
            self.background or BLACK,
            fresnel=self.fresnel,
            intensity=self.intensity,
            blend=self.blend,
            reflection_gradient="all" if gradient == "all" else "planes",
            deviation=self.weights.depth != 0,
        )
