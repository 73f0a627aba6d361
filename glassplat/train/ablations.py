"""The parts of methods that can be switched off one at a time.

TR-Gaussians, Table IV; 3DGS-DR, Tables 1 and 5; EnvGS, Table 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeVar

from glassplat.train.deferred_recipe import DeferredRecipe
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.traced_recipe import TracedRecipe

Switch = Literal[
    "multi-stage",
    "depth-and-conflict",
    "depth",
    "conflict",
    "perturbation",
    "intensity",
    "fresnel",
    "mask",
    "mirrors",
    "seeded-reflections",
    "linear-blend",
    "two-surfaces",
    "bright-reflections",
    "calm-colors",
    "averaging",
    "short-run-rates",
    "propagation",
    "sabotage",
    "deferred-shading",
    "coarse-to-fine",
    "strength-price",
    "joint",
    "surroundings",
    "environment",
    "copied-surroundings",
    "found-mirrors",
    "monocular-normals",
    "normal-consistency",
    "culling",
    "hurry-found",
    "tint",
]
Ablated = Literal["planar", "deferred", "traced"]


@dataclass(frozen=True)
class Ablation:
    """One part to leave out.

    Attributes:
        title: what the table calls the recipe without it.
        off: the recipe without it.
        paper_psnr: what leaving it out changes in the paper, dB on its own scenes; None for what the paper does not
            ablate.
    """

    title: str
    off: Callable[[Any], Any]
    paper_psnr: float | None = None


def _without(*terms: str) -> Callable[[PlanarRecipe], PlanarRecipe]:
    """Sets the weights of some loss terms to zero."""
    return lambda recipe: replace(recipe, weights=replace(recipe.weights, **dict.fromkeys(terms, 0.0)))


def _without_perturbation(recipe: PlanarRecipe) -> PlanarRecipe:
    return replace(recipe, perturbation=replace(recipe.perturbation, amplitude=0.0))


def _without_averaging(recipe: PlanarRecipe) -> PlanarRecipe:
    return replace(recipe, rhythm=replace(recipe.rhythm, averaged_passes=0.0))


def _with_published_rates(recipe: PlanarRecipe) -> PlanarRecipe:
    return replace(recipe, rates=replace(recipe.rates, short_run_power=0.0))


Reflective = TypeVar("Reflective", DeferredRecipe, TracedRecipe)


def _without_propagation(recipe: Reflective) -> Reflective:
    return replace(recipe, propagation=replace(recipe.propagation, propagates=False))


def _without_sabotage(recipe: Reflective) -> Reflective:
    return replace(recipe, propagation=replace(recipe.propagation, sabotage=0.0))


def _without_search(recipe: TracedRecipe) -> TracedRecipe:
    return replace(recipe, search=replace(recipe.search, begin_found=False))


def _without_estimated_normals(recipe: Reflective) -> Reflective:
    return replace(recipe, monocular_weight=0.0, search=replace(recipe.search, estimated_normals=False))


def _spread_over_the_box(recipe: TracedRecipe) -> TracedRecipe:
    start = replace(recipe.surroundings.start, source="box")
    return replace(recipe, surroundings=replace(recipe.surroundings, start=start))


PLANAR: dict[Switch, Ablation] = {
    "multi-stage": Ablation("w/o multi-stage optimization", lambda r: replace(r, multi_stage=False), -1.32),
    "depth-and-conflict": Ablation("w/o L_d and L_c", _without("depth", "conflict"), -0.50),
    "depth": Ablation("w/o L_d", _without("depth"), -0.30),
    "conflict": Ablation("w/o L_c", _without("conflict"), -0.27),
    "perturbation": Ablation("w/o opacity perturbation", _without_perturbation, -0.24),
    "intensity": Ablation("w/o reflection intensity", lambda r: replace(r, intensity=False), -0.37),
    "fresnel": Ablation("w/o Fresnel-based reflection", lambda r: replace(r, fresnel="none"), -0.24),
    "mask": Ablation("w/o L_m", _without("mask")),
    "mirrors": Ablation("w/o mirror detection", lambda r: replace(r, detect_mirrors=False)),
    "seeded-reflections": Ablation("w/o seeded reflections", lambda r: replace(r, seed_reflections=False)),
    "linear-blend": Ablation("blended in sRGB", lambda r: replace(r, blend="srgb")),
    "two-surfaces": Ablation("one surface (Schlick, the paper's)", lambda r: replace(r, fresnel="schlick")),
    "bright-reflections": Ablation("a(u) left free (the paper's)", _without("intensity")),
    "calm-colors": Ablation("harmonics left free (the paper's)", lambda r: replace(r, view_dependence_weight=0.0)),
    "averaging": Ablation("last step, not the mean of a pass", _without_averaging),
    "tint": Ablation("with a transmittance of each pane for red, green and blue", lambda r: replace(r, tint=True)),
    "short-run-rates": Ablation("learning rates as published, however short the run", _with_published_rates),
}
"""The first seven are the rows of TR-Gaussians' Table IV, the others are parts that the paper does not ablate."""

DEFERRED: dict[Switch, Ablation] = {
    "propagation": Ablation("w/o normal propagation", _without_propagation, -5.81),
    "sabotage": Ablation("w/o colour sabotage", _without_sabotage, -3.66),
    "deferred-shading": Ablation("forward shading", lambda r: replace(r, shading="forward"), -6.02),
    "monocular-normals": Ablation("w/o estimated normals", _without_estimated_normals),
    "coarse-to-fine": Ablation("w/o coarse-to-fine environment", lambda r: replace(r, first_texels=r.texels)),
    "strength-price": Ablation("strength without a price (the paper's)", lambda r: replace(r, strength_weight=0.0)),
}
"""The rows of 3DGS-DR's Table 5 and its forward variant (Table 1, `ball`), and what the paper does not have."""

TRACED: dict[Switch, Ablation] = {
    "joint": Ablation("w/o joint optimization", lambda r: replace(r, joint=False), -0.58),
    "monocular-normals": Ablation("w/o mono normals (in the paper, their loss)", _without_estimated_normals, -0.51),
    "surroundings": Ablation("w/ environment map alone", lambda r: replace(r, mirrors="environment"), -0.47),
    "sabotage": Ablation("w/o color sabotage", _without_sabotage, -0.35),
    "propagation": Ablation("w/o normal propagation", _without_propagation, -0.43),
    "environment": Ablation("surroundings alone (the paper's)", lambda r: replace(r, mirrors="surroundings")),
    "copied-surroundings": Ablation("surroundings spread over the box (the paper's)", _spread_over_the_box),
    "found-mirrors": Ablation("strengths that grow from nothing (the paper's)", _without_search),
    "normal-consistency": Ablation("w/o normal consistency", lambda r: replace(r, consistency_weight=0.0)),
    "hurry-found": Ablation("published rates after propagation", lambda r: replace(r, hurry_found=False)),
    "culling": Ablation("rays wherever anything reflects", lambda r: replace(r, least_strength=0.0)),
}
"""The first five are the rows of EnvGS's Table 4, but for its perceptual loss, which needs a network's weights; the
others are what the paper does not have or does not ablate in training."""

ABLATIONS: dict[Ablated, dict[Switch, Ablation]] = {"planar": PLANAR, "deferred": DEFERRED, "traced": TRACED}
