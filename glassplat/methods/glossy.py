"""Training of `deferred` (3D Gaussian Splatting with Deferred Reflection) and `traced` (EnvGS).

`traced` starts like `deferred`; then, reflections are traced through a second set of Gaussians.
"""

from __future__ import annotations

import logging
import math
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import torch

from glassplat.captures.dataset import Dataset
from glassplat.methods import mirrors
from glassplat.methods.splat import image_term, strategy_of
from glassplat.methods.splat_recipe import Primitive, SplatRecipe
from glassplat.methods.surroundings import BeginReflections, add_environment
from glassplat.options import BLACK
from glassplat.render.deferred import INVISIBLE, Deferred
from glassplat.render.splat import Splat
from glassplat.render.traced import Traced, mirrored_contributions
from glassplat.scene import logit
from glassplat.scene.scene import Scene
from glassplat.training import losses
from glassplat.training.actions import DensificationStrategy, Densify, GrowSh, PruneIdle, ResetOpacity
from glassplat.training.corrections import with_learned_corrections, with_neutral_corrections
from glassplat.training.densify import as_discs
from glassplat.training.options import PUBLISHED_ITERATIONS, GaussianRates, Intervals, MethodRecipe
from glassplat.training.stage import Action, Every, Stage, TrainState

if TYPE_CHECKING:
    from glassplat.methods.glossy_recipes import DeferredRecipe, TracedRecipe

log = logging.getLogger("glassplat.training")


def deferred_scene(recipe: DeferredRecipe, dataset: Dataset) -> Scene:
    """The initial scene: one Gaussian per point with almost no reflection, and no environment."""
    primary = strategy_of(recipe).initial_gaussians(dataset.points, recipe.sh_degree)
    strengths = torch.full((len(primary),), logit(recipe.first_strength), dtype=torch.float32)
    primary = replace(primary, channels={"logit_strength": strengths})
    return with_neutral_corrections(recipe, Scene(primary, dataset.extent), dataset)


def deferred_renderer(recipe: DeferredRecipe) -> Deferred:
    """The renderer of the finished scene, with all its layers."""
    return Deferred(recipe.background or BLACK, least_strength=INVISIBLE)


def deferred_stages(recipe: DeferredRecipe, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
    """Bootstrap, then joint training, which `Propagate` controls. A short run has no reflections."""
    if iterations < recipe.least_iterations:
        return _matte_stages(recipe, "ellipsoid", seed, iterations)
    return with_learned_corrections(recipe, _reflection_stages(_with_sufficient_bootstrap(recipe, iterations)))


LEAST_BOOTSTRAP = 300
"""Minimum number of steps before mirrors can be distinguished from unlearned parts."""


def _with_sufficient_bootstrap(recipe: DeferredRecipe, iterations: int) -> DeferredRecipe:
    """The recipe with a bootstrap of at least `LEAST_BOOTSTRAP` steps, if there is time before `schedule.stop`.

    A mirror ball at 700 iterations has 7.7 dB after a bootstrap of 42 steps, 21.4 after 262, and 21.9 with `splat`.
    """
    if not recipe.search.begin_found:
        return recipe
    least = min(LEAST_BOOTSTRAP / iterations, recipe.schedule.stop / 2)
    return replace(recipe, bootstrap=max(recipe.bootstrap, least))


def _reflection_stages(recipe: DeferredRecipe) -> tuple[Stage, ...]:
    """Stages of a run long enough for normal propagation."""
    strategy = strategy_of(recipe)
    image, view_dependence = image_term(recipe.ssim_weight), recipe.view_dependence_weight
    # As in `splat`, where a scene has to look right before mirrors can be recognised; in 3DGS-DR all but the harmonics.
    grow: tuple[Action, ...] = (GrowSh(Every(recipe.intervals.sh)),) if recipe.search.begin_found else ()
    bootstrap = Stage(
        name="1 bootstrap",
        share=recipe.bootstrap,
        renderer=Splat(recipe.background or BLACK, depth=False),
        losses=(image, *strategy.terms),
        rates=(_rates_of_splat(recipe) if recipe.search.begin_found else recipe.rates).of("primary", view_dependence),
        actions=(*strategy.edits, *grow, *strategy.resets),
        post_steps=strategy.post_steps,
        densify_until=strategy.densify_until,
    )
    renderer = Deferred(recipe.background or BLACK, depth=recipe.consistency_weight != 0)
    guidance = losses.weighted_terms(
        losses.LossTerm("outside", recipe.outside_weight, losses.strength_outside),
        losses.LossTerm("strength", recipe.strength_weight, losses.mean_strength),
        losses.LossTerm("consistency", recipe.consistency_weight, losses.normal_consistency),
        losses.LossTerm("monocular normals", recipe.monocular_weight, losses.MonocularNormals()),
    )
    reflection = Stage(
        name="2 reflection",
        share=recipe.schedule.stop - recipe.bootstrap,
        renderer=renderer,
        losses=(image, *guidance, *strategy.terms),
        rates=recipe.rates.of("primary", view_dependence) | recipe.reflection_rates.of(),
        actions=(
            *_edit_actions(recipe, strategy),
            # Before the resets, because it examines the visible scene even at steps of resets.
            mirrors.Propagate(recipe, renderer),
            mirrors.GrowShAfterPropagation(Every(recipe.intervals.sh)),
            *(map(mirrors.ResetRaised.replacing, strategy.resets) if recipe.schedule.last_reset else strategy.resets),
            mirrors.RefineEnvironment(
                doubling_shares(recipe.first_texels, recipe.texels, recipe.bootstrap), recipe.texels
            ),
        ),
        post_steps=strategy.post_steps,
        setup=BeginReflections(recipe),
        densify_until=strategy.densify_until,
        is_finished=mirrors.found_nothing,
    )
    refinement = replace(
        reflection,
        setup=None,
        is_finished=None,
        name="3 refinement",
        share=1 - recipe.schedule.stop,
        renderer=Deferred(recipe.background or BLACK, depth=False),
        # Without propagation, the consistency of normals is not needed (lab/glossy.md).
        losses=tuple(term for term in reflection.losses if term.name != "consistency"),
    )
    return bootstrap, reflection, refinement


def _matte_stages(recipe: DeferredRecipe, primitive: Primitive, seed: int, iterations: int) -> tuple[Stage, ...]:
    """Stages of a run too short for normal propagation, as in `splat`."""
    usual = Intervals()
    shared: dict[str, Any] = {option.name: getattr(recipe, option.name) for option in fields(MethodRecipe)}
    shared["rates"] = _rates_of_splat(recipe)
    shared["intervals"] = replace(recipe.intervals, opacity=usual.opacity, least=usual.least)
    plain = SplatRecipe(**shared, primitive=primitive)
    first, *later = (replace(stage, name=f"as {stage.name}") for stage in plain.stages(seed, iterations))

    def setup(state: TrainState, dataset: Dataset) -> None:
        """Adds an environment that nothing reflects."""
        log.warning(
            "%d iterations are too few for normal propagation: the run trains like splat, without reflections, which "
            "gives better images. Reflections need %d --iterations; --least-iterations 1 forces them",
            iterations, recipe.least_iterations,
        )  # fmt: skip
        add_environment(recipe, state, dataset, texels=recipe.initial_texels)

    return replace(first, setup=setup), *later


def _rates_of_splat(recipe: DeferredRecipe) -> GaussianRates:
    """The learning rates if nothing reflects whose normals higher rates would corrupt."""
    return (
        replace(recipe.rates, short_run_power=GaussianRates().short_run_power)
        if recipe.raise_rates_matte
        else recipe.rates
    )


def _edit_actions(recipe: DeferredRecipe, strategy: DensificationStrategy) -> tuple[Action, ...]:
    """Actions that change the number of Gaussians, after the bootstrap."""
    if recipe.propagation_interval is None or recipe.strategy == "mcmc":
        return strategy.edits
    slow = replace(recipe.densify, interval=recipe.propagation_interval)
    return tuple(
        mirrors.DensifyWhilePropagating(slow, regular=edit) if isinstance(edit, Densify) else edit
        for edit in strategy.edits
    )


FIRST_DOUBLING, LAST_DOUBLING = 0.45, 0.65
"""Shares of the run of the first and last doubling of the environment's resolution."""
LEAST_DOUBLING_DELAY = 0.1
"""Minimum delay of the first doubling, as a share of the run after the bootstrap."""


def doubling_shares(first_texels: int, texels: int, bootstrap: float) -> tuple[float, ...]:
    """Evenly spaced shares of the run at which the edge length doubles until it reaches the final one.

    They are delayed by a long bootstrap, in which there is no environment.
    """
    count = max(math.ceil(math.log2(texels / first_texels)), 0)
    first = max(FIRST_DOUBLING, bootstrap + LEAST_DOUBLING_DELAY * (1 - bootstrap))
    last = max(LAST_DOUBLING, first)
    return tuple(first + (last - first) * number / max(count - 1, 1) for number in range(count))


NORMAL_TERMS = ("consistency", "monocular normals")


def traced_scene(recipe: TracedRecipe, dataset: Dataset) -> Scene:
    """The initial scene: one Gaussian per point with almost no reflection, and no surroundings."""
    scene = recipe.distant().initialise(dataset)
    return replace(scene, primary=as_discs(scene.primary)) if recipe.primitive == "disc" else scene


def traced_renderer(recipe: TracedRecipe) -> Traced | Deferred:
    """The renderer of the finished scene, with all its layers."""
    if recipe.mirrors == "environment" and recipe.primitive == "ellipsoid":
        return deferred_renderer(recipe.distant())
    return Traced(recipe.background or BLACK, recipe.least_strength)


def traced_stages(recipe: TracedRecipe, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
    """Bootstrap, reflections with propagation, and joint training without it; a short run trains like `splat`."""
    if iterations < recipe.least_iterations:
        return _matte_stages(recipe.distant(), recipe.primitive, seed, iterations)
    known = recipe.distant().stages(seed, iterations)
    if recipe.harmonics_from_start:
        grow = GrowSh(Every(recipe.intervals.sh))
        known = tuple(
            replace(stage, actions=(*(a for a in stage.actions if not isinstance(a, GrowSh)), grow)) for stage in known
        )
    bootstrap, distant, refinement = known
    setup = BeginReflections(
        recipe,
        None if recipe.mirrors == "environment" else recipe.surroundings,
        has_environment=recipe.mirrors != "surroundings",
        reset_sh_degree=not recipe.harmonics_from_start,
    )
    distant = replace(distant, setup=setup)
    if recipe.primitive == "disc":
        distant, refinement = _with_renderer(recipe, distant), _with_renderer(recipe, refinement)
    if recipe.normals_throughout:
        bootstrap = _with_normal_terms(recipe, bootstrap, distant) if recipe.primitive == "disc" else bootstrap
        refinement = replace(refinement, losses=distant.losses, renderer=distant.renderer)
    if recipe.mirrors == "environment":
        return bootstrap, distant, refinement
    return bootstrap, _traced_stage(recipe, distant), _traced_stage(recipe, refinement)


def _with_normal_terms(recipe: TracedRecipe, bootstrap: Stage, reflecting: Stage) -> Stage:
    """The first stage of a scene of discs, with the normal terms of later stages."""
    terms = tuple(term for term in reflecting.losses if term.name in NORMAL_TERMS)
    return replace(bootstrap, renderer=Splat(recipe.background or BLACK), losses=(*bootstrap.losses, *terms))


def _traced_stage(recipe: TracedRecipe, stage: Stage) -> Stage:
    """A stage of `deferred` with ray-traced reflections."""
    stage = _with_renderer(recipe, stage)
    return replace(
        stage,
        rates={**stage.rates, **recipe.surroundings.rates.of("surroundings")},
        actions=(*stage.actions, *_surroundings_actions(recipe)),
        densify_until=max(stage.densify_until, recipe.surroundings.densify.stop),
    )


def _with_renderer(recipe: TracedRecipe, stage: Stage) -> Stage:
    """A stage of `deferred` with this method's renderer, also for propagation."""
    # Without rays or an environment there is no reflection, so that strengths could not grow.
    least_strength = 0.0 if recipe.mirrors == "surroundings" else recipe.least_strength
    renderer = Traced(recipe.background or BLACK, least_strength, faintest=0.0, joint=recipe.joint)
    kept = [
        a for a in stage.actions if recipe.mirrors != "surroundings" or not isinstance(a, mirrors.RefineEnvironment)
    ]
    actions = [
        replace(action, renderer=renderer) if isinstance(action, mirrors.Propagate) else action for action in kept
    ]
    return replace(stage, renderer=renderer, actions=tuple(actions))


def _surroundings_actions(recipe: TracedRecipe) -> list[Action]:
    """Densification and resets of the surroundings."""
    options = recipe.surroundings
    reset = ResetOpacity(Every(options.reset, stop=options.densify.stop), part="surroundings")
    return [
        Densify(options.densify, "surroundings"),
        PruneIdle(options.densify, "surroundings", mirrored_contributions),
        GrowSh(Every(recipe.intervals.sh), "surroundings"),
        *([reset] if options.reset else []),
    ]
