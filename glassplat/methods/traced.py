"""Training of `traced`: EnvGS, environment Gaussians behind a ray tracer."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from glassplat.captures.dataset import Dataset
from glassplat.methods.deferred import first_reflections
from glassplat.methods.mirrors import Propagate, RefineEnvironment
from glassplat.methods.surroundings import AddSurroundings
from glassplat.options import BLACK
from glassplat.render.deferred import Deferred
from glassplat.render.splat import Splat
from glassplat.render.traced import Traced, mirrored_contributions
from glassplat.scene.scene import Scene
from glassplat.training.actions import Densify, GrowSh, PruneIdle, ResetOpacity
from glassplat.training.options import PUBLISHED_ITERATIONS
from glassplat.training.points import as_discs
from glassplat.training.stage import Action, Every, Stage

if TYPE_CHECKING:
    from glassplat.methods.glossy_recipes import TracedRecipe

NORMAL_TERMS = ("consistency", "monocular normals")


def first_scene(recipe: TracedRecipe, dataset: Dataset) -> Scene:
    """The first scene: one Gaussian per point that hardly reflects, and nothing to mirror yet."""
    scene = recipe.distant().initialise(dataset)
    return replace(scene, primary=as_discs(scene.primary)) if recipe.primitive == "disc" else scene


def finished_renderer(recipe: TracedRecipe) -> Traced | Deferred:
    """The renderer of the finished scene, with all its layers."""
    if recipe.mirrors == "environment" and recipe.primitive == "ellipsoid":
        return recipe.distant().renderer()
    return Traced(recipe.background or BLACK, recipe.least_strength)


def stages_of(recipe: TracedRecipe, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
    """Bootstrap, reflections, everything without propagation; a short run has one stage."""
    known = recipe.distant().stages(seed, iterations)
    if len(known) == 1:
        return known
    if recipe.harmonics_from_start:
        known = tuple(_with_harmonics(stage, Every(recipe.rhythm.sh)) for stage in known)
    bootstrap, distant, refinement = known
    if recipe.primitive == "disc":
        distant, refinement = _rendered(recipe, distant), _rendered(recipe, refinement)
    if recipe.normals_throughout:
        bootstrap = _with_normal_terms(recipe, bootstrap, distant) if recipe.primitive == "disc" else bootstrap
        refinement = replace(refinement, losses=distant.losses, renderer=distant.renderer)
    if recipe.mirrors == "environment":
        return bootstrap, distant, refinement
    setup = first_reflections(recipe.distant())
    around = AddSurroundings(recipe.surroundings.start, recipe.surroundings.sh_degree)
    setup = replace(setup, surroundings=around, harmonics_wait=not recipe.harmonics_from_start)
    setup = replace(setup, environment=None) if recipe.mirrors == "surroundings" else setup
    near = replace(_tracing(recipe, distant), setup=setup)
    return bootstrap, near, _tracing(recipe, refinement)


def _with_harmonics(stage: Stage, when: Every) -> Stage:
    """The stage, in which colours begin to turn with the view whether normals spread or not."""
    kept = tuple(action for action in stage.actions if not isinstance(action, GrowSh))
    return replace(stage, actions=(*kept, GrowSh(when)))


def _with_normal_terms(recipe: TracedRecipe, bootstrap: Stage, reflecting: Stage) -> Stage:
    """The first stage of a scene of discs, with what a later one asks of normals."""
    terms = tuple(term for term in reflecting.losses if term.name in NORMAL_TERMS)
    return replace(bootstrap, renderer=Splat(recipe.background or BLACK), losses=(*bootstrap.losses, *terms))


def _tracing(recipe: TracedRecipe, stage: Stage) -> Stage:
    """A stage of `deferred` in which rays find what is mirrored."""
    stage = _rendered(recipe, stage)
    return replace(
        stage,
        rates={**stage.rates, **recipe.surroundings.rates.of("surroundings")},
        actions=(*stage.actions, *_surroundings_actions(recipe)),
        densify_until=max(stage.densify_until, recipe.surroundings.densify.stop),
    )


def _rendered(recipe: TracedRecipe, stage: Stage) -> Stage:
    """A stage of `deferred` with this method's renderer, which propagation looks through as well."""
    # What no ray leaves and no environment lights mirrors nothing, and a strength that mirrors nothing cannot grow.
    least_strength = 0.0 if recipe.mirrors == "surroundings" else recipe.least_strength
    renderer = Traced(recipe.background or BLACK, least_strength, faintest=0.0, joint=recipe.joint)
    kept = [a for a in stage.actions if recipe.mirrors != "surroundings" or not isinstance(a, RefineEnvironment)]
    actions = [replace(action, renderer=renderer) if isinstance(action, Propagate) else action for action in kept]
    return replace(stage, renderer=renderer, actions=tuple(actions))


def _surroundings_actions(recipe: TracedRecipe) -> list[Action]:
    """Actions that change the surroundings, apart from learning."""
    options = recipe.surroundings
    reset = ResetOpacity(Every(options.reset, stop=options.densify.stop), part="surroundings")
    return [
        Densify(options.densify, "surroundings"),
        PruneIdle(options.densify, "surroundings", mirrored_contributions),
        GrowSh(Every(recipe.rhythm.sh), "surroundings"),
        *([reset] if options.reset else []),
    ]
