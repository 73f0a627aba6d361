"""Recipes by method name, and their form on disk."""

from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING, Any, Literal, Protocol

from glassplat.data.backgrounds import Rgb
from glassplat.data.errors import InputError, input_checked
from glassplat.data.options import options_from_json, shown
from glassplat.files.json_text import parse_json
from glassplat.train.deferred_recipe import DeferredRecipe
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.rates import PUBLISHED_ITERATIONS
from glassplat.train.splat_recipe import SplatRecipe
from glassplat.train.traced_recipe import TracedRecipe

if TYPE_CHECKING:
    from glassplat.data.dataset import Dataset
    from glassplat.render.frame import Renderer
    from glassplat.scene.scene import Scene
    from glassplat.train.stage import Stage


class Recipe(Protocol):
    """How a method trains: data, an initialiser and stages."""

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
    """A recipe as readable JSON."""
    return json.dumps({"method": recipe.method, **dataclasses.asdict(recipe)}, indent=2)


def recipe_from_json(text: str, where: str = "the recipe") -> Any:
    """The recipe that `recipe_to_json` wrote; `where` names the text in messages.

    Raises:
        InputError: not a recipe, or written by a version with other fields; says which value is wrong.
    """
    with input_checked():
        fields = parse_json(text, where)
    method = fields.pop("method", None) if isinstance(fields, dict) else None
    if not isinstance(method, str) or method not in RECIPES:
        raise InputError(f"{where}: the method is {shown(method)}; expected one of {', '.join(RECIPES)}. {REMEDY}")
    try:
        return options_from_json(RECIPES[method], fields)
    except InputError as error:
        raise InputError(f"{where} is not one that this version can read: {error}. {REMEDY}") from error
