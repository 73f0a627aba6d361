"""How `planar` trains."""

from __future__ import annotations

from dataclasses import replace

from glassplat.data.backgrounds import BLACK
from glassplat.data.dataset import Dataset
from glassplat.init.plane_options import PlaneFitError
from glassplat.losses.geometry import depth_deviation_loss
from glassplat.losses.reflection import (
    gradient_conflict,
    intensity_departure,
    mask_loss,
    tint_departure,
)
from glassplat.losses.term import LossTerm, weighted
from glassplat.render.planar import Planar
from glassplat.render.splat import Splat
from glassplat.scene.scene import Scene
from glassplat.train.actions import Densify, GrowSh, PerturbOpacity, ResetOpacity
from glassplat.train.photo_exposure import exposures_begun, exposures_learnt
from glassplat.train.photographer_entry import photographer_learnt
from glassplat.train.planar_recipe import PlanarRecipe, ReflectionWeights
from glassplat.train.plane_entry import PlaneEntry, fitted_planes, glass_only_darkens
from glassplat.train.pose_refinement import poses_begun, poses_learnt
from glassplat.train.rates import PUBLISHED_ITERATIONS, Rate
from glassplat.train.splat_stages import image_terms
from glassplat.train.stage import Every, Motion, Stage
from glassplat.train.strategy import Population, population_of


def first_scene(recipe: PlanarRecipe, dataset: Dataset) -> Scene:
    """The first scene: one Gaussian per point, no planes yet.

    Raises:
        PlaneFitError: the masks do not do. The planes are fitted to the measured points once and forgotten,
            because a bad mask should end a run before the first iteration and not at the second stage.
    """
    if not dataset.pane_labels and dataset.planes is None:
        raise PlaneFitError(
            f"{_lack_of_masks(dataset)}, and planar needs to know where the panes are: expected masks of 3 to "
            f"10 photographs in {dataset.root / 'masks'}, named <photograph's name>.png, each pixel the label 1, "
            "2, ... of a pane, or 0 (`glassplat annotate` writes them). `glassplat train splat` needs none"
        )
    if dataset.measured_points:
        fitted_planes(dataset, None, recipe.plane_fit)
    scene = Scene(planar_population(recipe).initial(dataset.points, recipe.sh_degree), dataset.extent)
    return poses_begun(recipe.poses, exposures_begun(recipe.exposure, scene, dataset), dataset)


def _lack_of_masks(dataset: Dataset) -> str:
    count = sum(view.is_annotated for view in (*dataset.train, *dataset.test))
    return f"none of the {count} masks of {dataset.root} names a pane" if count else f"{dataset.root} has no masks"


def finished_renderer(recipe: PlanarRecipe) -> Planar:
    """The renderer of the finished scene, with all its layers."""
    return Planar(
        recipe.background or BLACK,
        fresnel=recipe.fresnel,
        intensity=recipe.intensity,
        blend=recipe.blend,
        nearest_only=recipe.panes == "nearest",
    )


def stages_of(recipe: PlanarRecipe, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
    """Initialisation, plane adjustment, joint optimisation (Section III-C4)."""
    first, second, third = recipe.stage_shares
    population = planar_population(recipe)
    entry = PlaneEntry(
        recipe.plane_fit,
        recipe.glass_count,
        seed,
        detect_mirrors=recipe.detect_mirrors,
        fixed_mirrors=recipe.fixed_mirrors,
        seed_reflections=recipe.seed_reflections,
        tint=recipe.tint,
    )
    initialisation = Stage(
        name="1 initialisation",
        share=first,
        renderer=Splat(recipe.background or BLACK, depth=False),
        losses=(*image_terms(recipe.ssim_weight, recipe.view_dependence_weight), *population.terms),
        rates=recipe.rates.of("primary"),
        actions=(*population.edits, GrowSh(Every(recipe.rhythm.sh)), *_early_resets(recipe, population)),
        motions=population.motions,
        densify_until=population.densify_until,
    )
    if not recipe.multi_stage:
        stages: tuple[Stage, ...] = (initialisation, replace(_joint(recipe, second + third), entry=entry))
    else:
        stages = (initialisation, _adjustment(recipe, second, entry), _joint(recipe, third))
    stages = photographer_learnt(recipe.photographer, stages, recipe.densify, seed)
    return poses_learnt(recipe.poses, exposures_learnt(recipe.exposure, stages))


def _adjustment(recipe: PlanarRecipe, share: float, entry: PlaneEntry) -> Stage:
    """Stage 2: the reflection's gradient reaches the planes, not the Gaussians."""
    population = planar_population(recipe)
    return Stage(
        name="2 plane adjustment",
        share=share,
        renderer=_training_renderer(recipe, "planes"),
        losses=_joint_terms(recipe, population),
        rates=recipe.rates.of("primary") | recipe.rates.of("glass") | recipe.plane_rates.of(1.0),
        actions=(
            *population.edits,
            GrowSh(Every(recipe.rhythm.sh)),
            Densify(recipe.densify, part="glass"),
            *_early_resets(recipe, population),
            *_clearing(recipe),
        ),
        motions=(*_glass_motions(recipe), *population.motions),
        entry=entry,
        densify_until=recipe.densify.stop,
    )


def _joint(recipe: PlanarRecipe, share: float) -> Stage:
    """Stage 3: everything learns, opacities are perturbed, planes move slowly."""
    population = planar_population(recipe)
    beat = Every(recipe.rhythm.beat, 0.0, recipe.perturbation.stop, recipe.rhythm.least, skip_multiples_of=3)
    return Stage(
        name="3 joint optimisation",
        share=share,
        renderer=_training_renderer(recipe, "all"),
        losses=_joint_terms(recipe, population),
        rates=recipe.rates.of("primary")
        | recipe.rates.of("glass")
        | recipe.plane_rates.of(recipe.plane_rates.joint_factor)
        | ({"primary.log_intensity": Rate(recipe.rates.intensity)} if recipe.intensity else {}),
        actions=(
            *population.edits,
            GrowSh(Every(recipe.rhythm.sh)),
            Densify(recipe.densify, part="glass"),
            *population.resets,
            *_clearing(recipe),
            PerturbOpacity(beat, recipe.perturbation.amplitude, recipe.perturbation.bounds),
        ),
        motions=(*_glass_motions(recipe), *population.motions),
        densify_until=recipe.densify.stop,
    )


def _glass_motions(recipe: PlanarRecipe) -> tuple[Motion, ...]:
    """What keeps transmittances possible; before the means of the last passes are taken."""
    return (glass_only_darkens,) if recipe.tint else ()


def _joint_terms(recipe: PlanarRecipe, population: Population) -> tuple[LossTerm, ...]:
    image = image_terms(recipe.ssim_weight, recipe.view_dependence_weight)
    glass = weighted(LossTerm("tint", recipe.tint_weight if recipe.tint else 0.0, tint_departure))
    return (*image, *reflection_terms(recipe.weights), *glass, *population.terms)


def planar_population(recipe: PlanarRecipe) -> Population:
    """What the strategy adds to every stage; under `mcmc` the set grows late unless the recipe says otherwise."""
    means_rate = recipe.rates.of("primary")["primary.means"]
    start = recipe.mcmc.start if recipe.early_growth else max(recipe.mcmc.start, _joint_start(recipe))
    mcmc = replace(recipe.mcmc, start=start)
    return population_of(
        recipe.strategy, default=recipe.densify, mcmc=mcmc, rhythm=recipe.rhythm, means_rate=means_rate
    )


def _early_resets(recipe: PlanarRecipe, population: Population) -> tuple[ResetOpacity, ...]:
    """The resets of the first two stages, if there are to be any."""
    return population.resets if recipe.early_resets else ()


def _clearing(recipe: PlanarRecipe) -> tuple[ResetOpacity, ...]:
    """The one reset under `mcmc`, where joint optimisation begins; `default` has its own."""
    # A second one would come after the stop.
    once = Every(_joint_start(recipe), stop=1.5 * _joint_start(recipe))
    return (ResetOpacity(once),) if recipe.strategy == "mcmc" and not recipe.early_growth else ()


def _joint_start(recipe: PlanarRecipe) -> float:
    """Share of the run after which all three parts learn together."""
    first, second, third = recipe.stage_shares
    return (first + second) / (first + second + third)


def _training_renderer(recipe: PlanarRecipe, gradient: str) -> Planar:
    return replace(
        finished_renderer(recipe),
        reflection_gradient="all" if gradient == "all" else "planes",
        deviation=recipe.weights.depth != 0,
        deviation_depth_gradient=recipe.moving_mean,
        tells_mirrored=recipe.densify_by == "direct",
        gate=recipe.weights.gate if gradient == "all" else 0.0,
    )


def reflection_terms(weights: ReflectionWeights) -> tuple[LossTerm, ...]:
    """The terms whose weight is not zero."""
    return weighted(
        LossTerm("depth", weights.depth, depth_deviation_loss),
        LossTerm("conflict", weights.conflict, gradient_conflict),
        LossTerm("mask", weights.mask, mask_loss),
        LossTerm("intensity", weights.intensity, intensity_departure),
    )
