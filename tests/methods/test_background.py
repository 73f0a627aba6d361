"""Renders and transparent photographs are blended with the same background colour."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from glassplat.errors import InputError
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.recipe import photo_background, resolve_background, with_background
from glassplat.methods.splat_recipe import SplatRecipe
from tests.training.tiny_capture import tiny_capture

WHITE, GREEN, BLACK = (1.0, 1.0, 1.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0)
RECIPES = [SplatRecipe(), PlanarRecipe()]


def backgrounds_of(recipe: Any) -> set[tuple[float, float, float]]:
    return {recipe.renderer().background, *(stage.renderer.background for stage in recipe.stages(0))}


@pytest.mark.parametrize("recipe", RECIPES, ids=["splat", "planar"])
@pytest.mark.parametrize(("behind", "expected"), [(None, BLACK), (WHITE, WHITE)])
def test_the_photographs_choose_the_background_of_a_recipe_without_one(recipe: Any, behind: Any, expected: Any) -> None:
    found = resolve_background(recipe, replace(tiny_capture(), background=behind))
    assert found == replace(recipe, background=expected)
    assert backgrounds_of(found) == {expected}


@pytest.mark.parametrize("recipe", RECIPES, ids=["splat", "planar"])
def test_a_background_of_the_recipe_stays(recipe: Any) -> None:
    chosen = replace(recipe, background=GREEN)
    assert photo_background(chosen) == GREEN
    assert photo_background(replace(recipe, background=BLACK)) == BLACK
    assert resolve_background(chosen, tiny_capture()) == chosen
    assert resolve_background(chosen, replace(tiny_capture(), background=GREEN)) == chosen
    assert with_background(chosen, WHITE) == chosen
    assert backgrounds_of(chosen) == {GREEN}


def test_transparent_photographs_are_composited_over_white_by_default() -> None:
    assert photo_background(SplatRecipe()) == WHITE


def test_two_backgrounds_are_refused() -> None:
    with pytest.raises(InputError, match=r"laid over \(1\.0, .*, but the recipe renders over \(0\.0, "):
        resolve_background(SplatRecipe(background=BLACK), replace(tiny_capture(), background=WHITE))
