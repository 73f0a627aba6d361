"""Training of `splat`: 3D Gaussian Splatting, or 2D Gaussian Splatting with discs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from glassplat.captures.dataset import Dataset
from glassplat.options import BLACK
from glassplat.render.splat import Splat
from glassplat.scene.scene import Scene
from glassplat.training import actions
from glassplat.training.corrections import with_learned_corrections, with_neutral_corrections
from glassplat.training.densify import as_discs
from glassplat.training.losses import LossTerm, PhotometricLoss, disc_normal_consistency, distortion
from glassplat.training.options import PUBLISHED_ITERATIONS, MethodRecipe
from glassplat.training.stage import Every, Stage

if TYPE_CHECKING:
    from glassplat.methods.splat_recipe import DiscTerms, SplatRecipe


def splat_scene(recipe: SplatRecipe, dataset: Dataset) -> Scene:
    """The initial scene: one Gaussian per point."""
    first = strategy_of(recipe).initial_gaussians(dataset.points, recipe.sh_degree)
    scene = Scene(as_discs(first) if recipe.primitive == "disc" else first, dataset.extent)
    return with_neutral_corrections(recipe, scene, dataset)


def splat_renderer(recipe: SplatRecipe) -> Splat:
    """The renderer of the finished scene, with all its layers."""
    return Splat(recipe.background or BLACK)


def splat_stages(recipe: SplatRecipe, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
    """One stage; for discs, a new one whenever one of their loss terms starts."""
    strategy = strategy_of(recipe)
    first = Stage(
        name="splat",
        share=1.0,
        renderer=_training_renderer(recipe),
        losses=(image_term(recipe.ssim_weight), *strategy.terms),
        rates=recipe.rates.of("primary", recipe.view_dependence_weight),
        actions=(*_seed_actions(recipe), *strategy.edits, actions.GrowSh(Every(recipe.intervals.sh)), *strategy.resets),
        post_steps=strategy.post_steps,
        densify_until=strategy.densify_until,
    )
    stages, began = [first], 0.0
    for start, term in terms_by_start(recipe.discs, iterations) if recipe.primitive == "disc" else ():
        last = stages.pop()
        stages += [replace(last, share=start - began)] if start > began else []
        losses = (*last.losses, term)
        with_normals = any(known.function is disc_normal_consistency for known in losses)
        name = f"{last.name}, {term.name}"
        stages.append(replace(last, name=name, renderer=_training_renderer(recipe, normal=with_normals), losses=losses))
        began = start
    stages[-1] = replace(stages[-1], share=1 - began)
    return with_learned_corrections(recipe, tuple(stages))


def _training_renderer(recipe: SplatRecipe, *, normal: bool = False) -> Splat:
    """The renderer with only the layers that the losses need."""
    return Splat(recipe.background or BLACK, depth=False, normal=normal)


SEED_AT = (0.105, 0.203)
"""Shares of a run at which missing objects are searched for."""


def _seed_actions(recipe: SplatRecipe) -> tuple[actions.SeedUnexplained, ...]:
    """The search for missing objects, if enabled."""
    wanted = recipe.seed_unexplained and recipe.primitive == "ellipsoid" and recipe.strategy == "default"
    cap = recipe.densify.cap
    return tuple(actions.SeedUnexplained((share,), _training_renderer(recipe), cap) for share in SEED_AT if wanted)


def strategy_of(recipe: MethodRecipe) -> actions.DensificationStrategy:
    """Contribution of the recipe's strategy."""
    if recipe.strategy == "mcmc":
        strategy = actions.mcmc_strategy(recipe.mcmc, recipe.rates.of("primary")["primary.means"])
    else:
        strategy = actions.default_strategy(recipe.densify, recipe.intervals)
    if recipe.intervals.averaged_passes == 0:
        return strategy
    return replace(strategy, post_steps=(*strategy.post_steps, actions.AverageLast(recipe.intervals.averaged_passes)))


LEAST_DISTORTION_START = 400
"""Steps before discs are on surfaces; an earlier distortion loss would turn them into fog."""


def terms_by_start(options: DiscTerms, iterations: int) -> tuple[tuple[float, LossTerm], ...]:
    """The terms with non-zero weights, with the shares of the run after which they apply, in order.

    On a mirror ball at 800 iterations, a distortion term from step 80 on gave 11.0 dB, from step 400 on 21.2.
    """
    distortion_start = max(options.distortion_start, LEAST_DISTORTION_START / iterations)
    terms = (
        (distortion_start, LossTerm("distortion", options.distortion_weight, distortion)),
        (options.normal_start, LossTerm("normals", options.normal_weight, disc_normal_consistency)),
    )
    wanted = [(start, term) for start, term in terms if term.weight > 0 and start < 1]
    return tuple(sorted(wanted, key=lambda pair: pair[0]))


def image_term(ssim_weight: float) -> LossTerm:
    """(1 - lambda) L1 + lambda D-SSIM (TR-Gaussians, Eq. 18)."""
    return LossTerm("photometric", 1.0, PhotometricLoss(ssim_weight))
