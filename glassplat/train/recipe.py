"""Recipes by method name, and their form on disk."""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Mapping
from typing import Any, Protocol

from glassplat.data.dataset import Dataset
from glassplat.data.errors import InputError
from glassplat.data.view import Rgb
from glassplat.render.frame import Renderer
from glassplat.scene.scene import Scene
from glassplat.train.deferred_recipe import DeferredRecipe
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.splat_recipe import SplatRecipe
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

    def stages(self, seed: int) -> tuple[Stage, ...]:
        """The training stages."""
        ...

    def renderer(self) -> Renderer:
        """The renderer of the finished scene."""
        ...


RECIPES: dict[str, type] = {recipe.method: recipe for recipe in (SplatRecipe, PlanarRecipe, DeferredRecipe)}


def recipe_to_json(recipe: Any) -> str:
    """A recipe as readable JSON."""
    return json.dumps({"method": recipe.method, **dataclasses.asdict(recipe)}, indent=2)


def recipe_from_json(text: str) -> Any:
    """The recipe that `recipe_to_json` wrote.

    Raises:
        InputError: not a recipe, or written by a version with other fields.
    """
    try:
        fields = json.loads(text)
        method = fields.pop("method")
        return built(RECIPES[method], fields)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(
            f"this is not a recipe this version can read ({error!r}); expected JSON with a method out of "
            f"{sorted(RECIPES)} and that recipe's fields. Train again, or use the version that wrote it"
        ) from error


def built(kind: type, fields: Mapping[str, Any]) -> Any:
    """An instance of a dataclass from plain fields, nested dataclasses included."""
    hints = typing.get_type_hints(kind)
    known = {field.name for field in dataclasses.fields(kind)}
    unknown = set(fields) - known
    if unknown:
        raise KeyError(f"unknown fields {sorted(unknown)} of {kind.__name__}")
    return kind(**{name: restored(hints[name], value) for name, value in fields.items()})


def restored(hint: Any, value: Any) -> Any:
    """One field's value in the type that its annotation names."""
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        return built(hint, value)
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        inner = next(option for option in typing.get_args(hint) if option is not type(None))
        return None if value is None else restored(inner, value)
    if origin is typing.Literal and value not in typing.get_args(hint):
        raise ValueError(f"{value!r} where one of {typing.get_args(hint)} is expected")
    if origin is tuple:
        return tuple(value)
    return value
