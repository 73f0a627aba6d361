"""Layers that each method renders."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from glassplat.errors import InputError

Layer = Literal[
    "rgb",
    "transmission",
    "without_panes",
    "reflection",
    "strength",
    "mask",
    "depth",
    "alpha",
    "base",
    "normal",
    "environment",
    "surroundings",
    "median_depth",
    "photographed",
]

LAYERS: dict[str, tuple[Layer, ...]] = {
    "splat": ("rgb", "normal", "depth", "alpha"),
    "planar": ("rgb", "transmission", "without_panes", "reflection", "strength", "mask", "normal", "depth", "alpha"),
    "deferred": ("rgb", "base", "reflection", "strength", "normal", "environment", "depth", "alpha"),
    "traced": ("rgb", "base", "reflection", "strength", "normal", "surroundings", "depth", "alpha"),
}
"""What each method renders that is worth looking at; its frames hold more for the losses."""

DISC_LAYERS: tuple[Layer, ...] = ("median_depth",)
"""What any method renders of discs beside its own layers."""


def layers_of(recipe: Any) -> tuple[Layer, ...]:
    """What a run of a recipe renders that is worth looking at."""
    discs = DISC_LAYERS if getattr(recipe, "primitive", None) == "disc" else ()
    return (*LAYERS[recipe.method], *discs)


def check_layers(layers: Sequence[str], recipe: Any) -> None:
    """Refuses layers that a method does not render, before anything is rendered.

    Raises:
        InputError: there are such, or none is asked for.
    """
    from glassplat.render.layers import PHOTOGRAPHED

    known, method = layers_of(recipe), recipe.method
    if method == "planar" and recipe.photographer.learn:
        known = (*known, PHOTOGRAPHED)
    foreign = [layer for layer in layers if layer not in known]
    if foreign or not layers:
        asked = f"renders no layer {', '.join(foreign)}" if foreign else "renders nothing without --layers"
        raise InputError(f"{method} {asked}; expected --layers out of {', '.join(known)}")
