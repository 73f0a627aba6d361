"""Recipes on the command line and on disk: every number has a range, and invalid recipes are refused."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from glassplat.cli.scene import Render
from glassplat.cli.train import Demo, Train
from glassplat.errors import InputError
from glassplat.methods.recipe import RECIPES, recipe_from_json, recipe_of, recipe_to_json
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model.run_directory import RunDirectory, RunSettings
from glassplat.options import Range, as_option, check_options, unwrap_annotation
from tests.methods.number_fields import number_fields

COMMANDS = [Train, Demo, Render, RunSettings]
DECLARED = [(kind, name, hint) for kind in (*RECIPES.values(), *COMMANDS) for name, hint in number_fields(kind)]


def ranges_of(hint: Any) -> list[Range]:
    return [requirement for requirement in unwrap_annotation(hint)[1] if isinstance(requirement, Range)]


def outside(hint: Any) -> Iterator[float]:
    """Numbers that an annotation excludes, just beyond its bounds and far away."""
    (bounds,) = ranges_of(hint)
    whole = unwrap_annotation(hint)[0] is int
    step = 1 if whole else 1e-6
    if bounds.low is not None:
        yield from (bounds.low - step, -1e30 if not whole else -(10**30))
    if bounds.above is not None:
        yield from (bounds.above, bounds.above - step)
    if bounds.high is not None:
        yield from (bounds.high + step, 1e30 if not whole else 10**30)
    if bounds.below is not None:
        yield bounds.below
    if not whole:
        yield from (math.nan, math.inf, -math.inf)


@pytest.mark.parametrize(("kind", "name", "hint"), DECLARED, ids=lambda part: getattr(part, "__name__", str(part))[:50])
def test_every_number_has_a_range(kind: type, name: str, hint: Any) -> None:
    assert len(ranges_of(hint)) == 1, f"{kind.__name__}.{name} needs a range of glassplat.options in its annotation"
    if unwrap_annotation(hint)[0] is int:
        assert ranges_of(hint)[0].high is not None, f"{name} is counted: say how many at the most"


def with_value(options: Any, name: str, value: Any) -> Any:
    """The options with one of them, possibly nested, set."""
    outer, _, inner = name.partition(".")
    return dataclasses.replace(
        options, **{outer: with_value(getattr(options, outer), inner, value) if inner else value}
    )


def like(old: Any, value: float) -> Any:
    """The number in the shape of an option's value: alone, or as the first element of several."""
    return (value, *old[1:]) if isinstance(old, tuple) and old else value


def value_of(options: Any, name: str) -> Any:
    for part in name.split("."):
        options = getattr(options, part)
    return options


@pytest.mark.parametrize("method", RECIPES)
def test_every_number_out_of_its_range_is_refused(method: str) -> None:
    recipe, refused = recipe_of(method), 0
    sample = {"background": (0.0, 0.0, 0.0), "region": (0.0, 0.0, 0.0, 1.0), "plane_fit.mirror_labels": (1,)}
    for name, hint in number_fields(RECIPES[method]):
        old = value_of(recipe, name) if value_of(recipe, name) not in (None, ()) else sample.get(name, 0)
        for number in outside(hint):
            values = [like(old, number)] if not isinstance(old, tuple) else [(*old[:-1], number), (number, *old[1:])]
            for value in values:
                broken = with_value(recipe, name, value)
                # In a tuple of several kinds, another element may accept the number.
                if isinstance(old, tuple) and name == "region" and math.isfinite(number):
                    continue
                with pytest.raises(InputError) as raised:
                    check_options(broken)
                assert as_option(name) in str(raised.value)
                with pytest.raises(InputError, match=r"expected|finite"):
                    recipe_from_json(recipe_to_json(broken))
                refused += 1
    assert refused > 100


@pytest.mark.parametrize("preset", ["glassplat", "paper"])
@pytest.mark.parametrize("method", RECIPES)
def test_recipes_are_within_their_ranges_and_round_trip(method: str, preset: Any) -> None:
    recipe = recipe_of(method, preset)
    check_options(recipe)
    assert recipe_from_json(recipe_to_json(recipe)) == recipe


def test_a_recipe_of_another_version_is_refused() -> None:
    fields = {**json.loads(recipe_to_json(recipe_of("deferred"))), "shading": "forward"}
    with pytest.raises(InputError, match=r"unknown fields \['shading'\]"):
        recipe_from_json(json.dumps(fields))


def edited(**fields: Any) -> str:
    return json.dumps({**json.loads(recipe_to_json(SplatRecipe())), **fields})


@pytest.mark.parametrize(
    "text",
    [
        "",
        "nonsense",
        "null",
        "[]",
        "5",
        "{}",
        "[" * 100_000,
        '{"method": ' * 100_000,
        edited(method="no such method"),
        edited(method=["splat"]),
        edited(method=None),
        edited(background="red"),
        edited(background=["r", "e", "d"]),
        edited(sh_degree="3"),
        edited(sh_degree=7),
        edited(sh_degree=2.5),
        edited(rates=None),
        edited(rates=[1, 2]),
        edited(rates={"means": -1}),
        edited(rates={"colour": 1}),
        edited(strategy="genetic"),
        edited(strategy=5),
        edited(densify={"whole_passes": "no"}),
        edited(densify={"contribution_moments": 0.5}),
        edited(colour=1),
        edited(ssim_weight=10**400),
        edited(ssim_weight=float("nan")),
    ],
    ids=lambda text: text[:40],
)
def test_invalid_recipes_are_refused_with_one_message(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as raised:
        recipe_from_json(text)
    assert len(str(raised.value)) < 1000 and "\n" not in str(raised.value)
    (tmp_path / "recipe.json").write_text(text)
    with pytest.raises(InputError, match=r"recipe\.json"):
        RunDirectory(tmp_path).recipe()


def test_files_that_are_not_text_are_refused(tmp_path: Path) -> None:
    for name, read in (("recipe.json", RunDirectory.recipe), ("settings.json", RunDirectory.settings)):
        (tmp_path / name).write_bytes(b"\xff\xfe{}")
        with pytest.raises(InputError, match=name):
            read(RunDirectory(tmp_path))


@pytest.mark.parametrize(
    "fields",
    [{"iterations": "10"}, {"iterations": 0}, {"downscale": None}, {"seed": -1}, {"more": 1}, {"mask_polarity": "x"}],
    ids=str,
)
def test_settings_are_checked_as_options_are(fields: dict[str, Any], tmp_path: Path) -> None:
    settings = {"data": "x", "iterations": 5, **fields}
    (tmp_path / "settings.json").write_text(json.dumps(settings))
    with pytest.raises(InputError, match=r"settings\.json"):
        RunDirectory(tmp_path).settings()
