"""The parts of `planar` that can be switched off one at a time (TR-Gaussians, Table IV)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

from glassplat.train.planar_recipe import PlanarRecipe

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
]


@dataclass(frozen=True)
class Ablation:
    """One part to leave out.

    Attributes:
        title: what the table calls the recipe without it.
        off: the recipe without it.
        paper_psnr: what leaving it out changes in the paper, dB on two of its own scenes; None for what the paper
            does not ablate.
    """

    title: str
    off: Callable[[PlanarRecipe], PlanarRecipe]
    paper_psnr: float | None = None


def _without(*terms: str) -> Callable[[PlanarRecipe], PlanarRecipe]:
    """Sets the weights of some loss terms to zero."""
    return lambda recipe: replace(recipe, weights=replace(recipe.weights, **dict.fromkeys(terms, 0.0)))


def _without_perturbation(recipe: PlanarRecipe) -> PlanarRecipe:
    return replace(recipe, perturbation=replace(recipe.perturbation, amplitude=0.0))


ABLATIONS: dict[Switch, Ablation] = {
    "multi-stage": Ablation("w/o multi-stage optimization", lambda r: replace(r, multi_stage=False), -1.32),
    "depth-and-conflict": Ablation("w/o L_d and L_c", _without("depth", "conflict"), -0.50),
    "depth": Ablation("w/o L_d", _without("depth"), -0.30),
    "conflict": Ablation("w/o L_c", _without("conflict"), -0.27),
    "perturbation": Ablation("w/o opacity perturbation", _without_perturbation, -0.24),
    "intensity": Ablation("w/o reflection intensity", lambda r: replace(r, intensity=False), -0.37),
    "fresnel": Ablation("w/o Fresnel-based reflection", lambda r: replace(r, fresnel=False), -0.24),
    "mask": Ablation("w/o L_m", _without("mask")),
    "mirrors": Ablation("w/o mirror detection", lambda r: replace(r, detect_mirrors=False)),
    "seeded-reflections": Ablation("w/o seeded reflections", lambda r: replace(r, seed_reflections=False)),
    "linear-blend": Ablation("blended in sRGB", lambda r: replace(r, blend="srgb")),
}
"""Every switch; the first seven are the rows of Table IV, the others are parts that the paper does not ablate."""

SWITCHES: tuple[Switch, ...] = get_args(Switch)
