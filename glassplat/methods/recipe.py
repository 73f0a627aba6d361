"""Recipes by method name, their form on disk, and the colour behind everything."""

from __future__ import annotations

import dataclasses
import json
import logging
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal, Protocol

from glassplat.errors import InputError, input_checked
from glassplat.files.records import parse_json
from glassplat.methods.glossy_recipes import DeferredRecipe, TracedRecipe
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.options import BLACK, WHITE, Rgb, options_from_json, short_repr
from glassplat.training.options import PUBLISHED_ITERATIONS

if TYPE_CHECKING:
    from glassplat.captures.dataset import Dataset
    from glassplat.render.frame import Renderer
    from glassplat.scene.scene import Scene
    from glassplat.training.stage import Stage


class Recipe(Protocol):
    """Recipe of a method: data, an initialiser and stages."""

    @property
    def method(self) -> str:
        """The method's name on the command line."""
        ...

    @property
    def background(self) -> Rgb | None:
        """Colour behind everything, sRGB; None leaves it to the photographs."""
        ...

    def initialise(self, dataset: Dataset) -> Scene:
        """The first scene."""
        ...

    def stages(self, seed: int, iterations: int = PUBLISHED_ITERATIONS) -> tuple[Stage, ...]:
        """The training stages of a run of this length; only where a method needs one does it matter."""
        ...

    def renderer(self) -> Renderer:
        """The renderer of the finished scene."""
        ...


log = logging.getLogger("glassplat.training")

OWN = "recipe"
"""Name, in JSON, of the class of a recipe of the user's own."""
REMEDY = "Train again, or use the version that wrote it"
Preset = Literal["glassplat", "paper"]
RECIPES: dict[str, type] = {
    recipe.method: recipe for recipe in (SplatRecipe, PlanarRecipe, DeferredRecipe, TracedRecipe)
}


def recipe_of(method: str, preset: Preset = "glassplat") -> Any:
    """The recipe of a method: as this project found it best, or as it was published."""
    kind: Any = RECIPES[method]
    return kind.paper() if preset == "paper" else kind()


def recipe_to_json(recipe: Any) -> str:
    """A recipe as readable JSON; of one of the user's own also the name of its class."""
    name = {} if type(recipe) in RECIPES.values() else {OWN: type(recipe).__name__}
    return json.dumps({"method": recipe.method, **name, **dataclasses.asdict(recipe)}, indent=2)


def recipe_from_json(text: str, where: str = "the recipe") -> Any:
    """The recipe that `recipe_to_json` wrote; `where` names the text in messages.

    One of the user's own comes back as that of its method, without the options that it adds.

    Raises:
        InputError: not a recipe, or written by a version with other fields; says which value is wrong.
    """
    with input_checked():
        fields = parse_json(text, where)
    method = fields.pop("method", None) if isinstance(fields, dict) else None
    if not isinstance(method, str) or method not in RECIPES:
        raise InputError(f"{where}: the method is {short_repr(method)}; expected one of {', '.join(RECIPES)}. {REMEDY}")
    kind: Any = RECIPES[method]
    if (own := fields.pop(OWN, None)) is not None:
        log.warning("%s is of a recipe of one's own, %s; taken as %s", where, short_repr(own), kind.__name__)
        known = {field.name for field in dataclasses.fields(kind)}
        fields = {name: value for name, value in fields.items() if name in known}
    try:
        return options_from_json(kind, fields)
    except InputError as error:
        raise InputError(f"{where} is not one that this version can read: {error}. {REMEDY}") from error


def photo_background(recipe: Any) -> Rgb:
    """Colour behind transparent photographs: the recipe's background, or white, as results are published over."""
    return WHITE if recipe.background is None else recipe.background


def with_background(recipe: Any, background: Rgb | None) -> Any:
    """The recipe over a background, unless it names one itself."""
    return recipe if recipe.background is not None else replace(recipe, background=background)


def resolve_background(recipe: Any, dataset: Dataset) -> Any:
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
