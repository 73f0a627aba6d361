"""Recipes by method name, their JSON form, and their background."""

from __future__ import annotations

import dataclasses
import json
import logging
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from glassplat.errors import InputError, convert_to_input_error
from glassplat.files.records import parse_json
from glassplat.methods.glossy_recipes import DeferredRecipe, TracedRecipe
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.options import BLACK, WHITE, Rgb, check_value, short_repr

if TYPE_CHECKING:
    from glassplat.captures.dataset import Dataset

log = logging.getLogger("glassplat.training")

OWN = "recipe"
"""JSON key of the class name of a custom recipe."""
REMEDY = "Train again, or use the version that wrote it"
Preset = Literal["glassplat", "paper"]
RECIPES: dict[str, type] = {
    recipe.method: recipe for recipe in (SplatRecipe, PlanarRecipe, DeferredRecipe, TracedRecipe)
}


def recipe_of(method: str, preset: Preset = "glassplat") -> Any:
    """The recipe of a method: the best known one, or that of the paper."""
    kind: Any = RECIPES[method]
    return kind.paper() if preset == "paper" else kind()


def recipe_to_json(recipe: Any) -> str:
    """A recipe as readable JSON; with the class name of a custom one."""
    name = {} if type(recipe) in RECIPES.values() else {OWN: type(recipe).__name__}
    return json.dumps({"method": recipe.method, **name, **dataclasses.asdict(recipe)}, indent=2)


def recipe_from_json(text: str, where: str = "the recipe") -> Any:
    """The recipe written by `recipe_to_json`; `where` names the file in messages.

    A custom recipe is read as that of its method, without additional options.

    Raises:
        InputError: it is not a recipe, or was written by a version with other fields; the message names the wrong
            value.
    """
    with convert_to_input_error():
        fields = parse_json(text, where)
    method = fields.pop("method", None) if isinstance(fields, dict) else None
    if not isinstance(method, str) or method not in RECIPES:
        raise InputError(f"{where}: the method is {short_repr(method)}; expected one of {', '.join(RECIPES)}. {REMEDY}")
    kind: Any = RECIPES[method]
    if (own := fields.pop(OWN, None)) is not None:
        log.warning("%s is of a custom recipe, %s; read as %s", where, short_repr(own), kind.__name__)
        known = {field.name for field in dataclasses.fields(kind)}
        fields = {name: value for name, value in fields.items() if name in known}
    try:
        return check_value(kind, fields)
    except InputError as error:
        raise InputError(f"{where} cannot be read by this version: {error}. {REMEDY}") from error


def photo_background(recipe: Any) -> Rgb:
    """Background of transparent photographs: that of the recipe, or white, as in published results."""
    return WHITE if recipe.background is None else recipe.background


def with_background(recipe: Any, background: Rgb | None) -> Any:
    """The recipe with a background, unless it has one."""
    return recipe if recipe.background is not None else replace(recipe, background=background)


def resolve_background(recipe: Any, dataset: Dataset) -> Any:
    """The recipe with a background: its own, that of transparent photographs, or black.

    Raises:
        InputError: the photographs have a different background than the recipe.
    """
    chosen = with_background(recipe, dataset.background or BLACK)
    if dataset.background not in (None, chosen.background):
        raise InputError(
            f"the photographs of {dataset.root} are laid over {dataset.background}, but the recipe renders over "
            f"{chosen.background}; expected one colour: load the data set with background={chosen.background}"
        )
    return chosen
