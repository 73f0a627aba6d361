"""The command line of `glassplat train`: its methods, the presets they begin from, and how much of it help shows."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
import typing
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from glassplat.commands.training.train import Train
from glassplat.data.ranges import Essential
from glassplat.train.recipe import RECIPES, Preset, recipe_of

HELP, FULL_HELP = ("-h", "--help"), "--help-advanced"
POINTER = f"These are the options that most runs need; {FULL_HELP} in place of --help shows all of them."


def train_command(arguments: Sequence[str]) -> tuple[Any, list[str]]:
    """What tyro should make of a command line that may be one of `train`.

    Returns:
        `Train`, with the recipes of the preset that the arguments name as defaults and, where they ask for help, with
        the options that help should show; and the arguments for it.
    """
    full = FULL_HELP in arguments
    recipes = [recipe_of(method, asked_preset(arguments)) for method in RECIPES]
    if not full and any(help_option in arguments for help_option in HELP):
        recipes = [in_brief(recipe) for recipe in recipes]
    choices = [Annotated[type(r), tyro.conf.subcommand(r.method, default=r)] for r in recipes]
    any_recipe: Any = functools.reduce(operator.or_, choices)
    return Train[any_recipe], ["--help" if argument == FULL_HELP else argument for argument in arguments]


def asked_preset(arguments: Sequence[str]) -> Preset:
    """The preset that the arguments name last; the default one where that is none, which parsing will refuse."""
    return "paper" if last_value(arguments, "--preset") == "paper" else "glassplat"


def last_value(arguments: Sequence[str], option: str) -> str | None:
    """The value that arguments give to an option last; None where they give none."""
    found = None
    for before, argument in itertools.pairwise(["", *arguments]):
        if argument.startswith(f"{option}="):
            found = argument.removeprefix(f"{option}=")
        elif before == option and not argument.startswith("-"):
            found = argument
    return found


def in_brief(options: Any) -> Any:
    """The same options as another type, of which help shows the essential ones only; it parses no others."""
    kind, hints = type(options), typing.get_type_hints(type(options), include_extras=True)
    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    fields: list[Any] = []
    for name, value in values.items():
        values[name] = in_brief(value) if dataclasses.is_dataclass(value) and has_essentials(type(value)) else value
        if values[name] is not value:
            fields.append((name, type(values[name]), dataclasses.field(default=values[name])))
        elif not is_essential(hints[name]):
            fields.append((name, Annotated[hints[name], tyro.conf.Suppress], dataclasses.field(default=value)))
    summary, _, rest = (kind.__doc__ or "").partition("\n\n")
    namespace = {"__doc__": f"{summary}\n\n    {POINTER}\n\n{rest}", "__module__": kind.__module__}
    return dataclasses.make_dataclass(kind.__name__, fields, bases=(kind,), namespace=namespace, frozen=True)(**values)


def has_essentials(kind: type) -> bool:
    """Whether one of a dataclass's options is essential."""
    return any(is_essential(hint) for hint in typing.get_type_hints(kind, include_extras=True).values())


def is_essential(hint: Any) -> bool:
    """Whether an annotation marks an option as one that many runs need."""
    return any(isinstance(data, Essential) for data in typing.get_args(hint)[1:])
