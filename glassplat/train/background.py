"""The colour behind everything: what transparent photographs are laid over is what renders are laid over."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from glassplat.data.backgrounds import BLACK, WHITE, Rgb
from glassplat.data.errors import InputError

if TYPE_CHECKING:
    from glassplat.data.dataset import Dataset


def photo_background(recipe: Any) -> Rgb:
    """What to lay transparent photographs over: the recipe's background, or white, as results are published over."""
    return WHITE if recipe.background is None else recipe.background


def with_background(recipe: Any, background: Rgb | None) -> Any:
    """The recipe over a background, unless it names one itself."""
    return recipe if recipe.background is not None else replace(recipe, background=background)


def settled(recipe: Any, dataset: Dataset) -> Any:
    """The recipe with a background: its own, or else what transparent photographs are laid over, or else black.

    Raises:
        InputError: the photographs are laid over another colour than the recipe names.
    """
    chosen = with_background(recipe, dataset.background or BLACK)
    if dataset.background not in (None, chosen.background):
        raise InputError(
            f"the photographs of {dataset.root} are laid over {dataset.background}, but the recipe renders over "
            f"{chosen.background}; expected one colour: load the data set with background={chosen.background}"
        )
    return chosen
