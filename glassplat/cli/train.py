"""`glassplat train`: methods, presets, and the options that help shows."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import operator
import typing
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import tyro
from rich.console import Console

from glassplat.captures.files import CaptureFiles, read_capture
from glassplat.captures.masks import Polarity
from glassplat.cli.console import Command, message_console, print_line, unknown_name_message
from glassplat.cli.places import check_targets
from glassplat.errors import InputError, convert_to_input_error
from glassplat.files.records import read_text
from glassplat.files.writing import check_folder, real_path
from glassplat.kernels.backend.devices import DeviceName, chosen_device
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.recipe import RECIPES, Preset, recipe_from_json, recipe_of
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model.run_directory import CHECKPOINT_SECONDS, RunDirectory, RunSettings, check_output
from glassplat.options import Downscale, Essential, Positive, PositiveCount, Seed
from glassplat.training.options import MethodRecipe

RecipeKind = TypeVar("RecipeKind", bound=MethodRecipe)


@dataclass(frozen=True)
class Train(Command, Generic[RecipeKind]):
    """Train a scene from photographs.

    Attributes:
        recipe: method and its options; `glassplat train planar --help` lists the most common ones.
        preset: default values of the options: the best known, or those of the paper.
        data: directory of the capture: COLMAP or transforms.json, with pane masks in panes/.
        output: directory of the run.
        iterations: length of the run; all schedules scale with it.
        downscale: factor by which to downscale the photographs.
        seed: random seed.
        device: training device; auto uses an NVIDIA GPU if available.
        resume: continue the run in `output`.
        mask_polarity: mask value that marks panes.
        checkpoint_every: seconds between checkpoints.
        memory: gigabytes of memory for photographs; by default a quarter of what the machine or job allows.
        config: recipe.json with default values of the options.
        view: watch the training in the browser.
    """

    entry_point = "runs:train"

    recipe: Annotated[RecipeKind, tyro.conf.arg(name="")]
    data: Path
    output: Path
    iterations: PositiveCount = 30_000
    downscale: Downscale = 1.0
    seed: Seed = 0
    device: DeviceName = "auto"
    resume: bool = False
    mask_polarity: Polarity = "auto"
    checkpoint_every: Positive = CHECKPOINT_SECONDS
    preset: Preset = "glassplat"
    memory: Positive | None = None
    config: Path | None = None
    view: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False

    def check(self) -> None:
        """Checks options, capture and output, and prints a summary of the capture."""
        if real_path(self.output) == real_path(self.data):
            raise InputError(f"{self.output} is the capture itself; choose another folder for --output")
        if self.recipe.strategy != "mcmc" and self.recipe.mcmc.cap is not None:
            raise InputError("--cap belongs to --strategy mcmc; expected that strategy, or --densify.cap")
        check_output(RunDirectory(self.output), resume=self.resume)
        print_line(message_console(), self.files)
        if not self.resume:  # A checkpoint holds the panes.
            self.recipe.check_capture(self.files)

    def set_up(self) -> None:
        """Checks options and paths, imports the training code, and checks the length of the stages."""
        super().set_up()
        self.recipe.renderer()  # Imports the method's modules before anything is written.
        from glassplat.training.stage import check_length

        check_length(self.recipe.stages(self.seed, self.iterations), self.iterations)

    @cached_property
    def files(self) -> CaptureFiles:
        """Contents of the capture's folder, read at first use, without PyTorch."""
        return read_capture(self.data, mask_polarity=self.mask_polarity)

    def interrupt_message(self) -> str:
        """Message after an interrupt: the state on disk, and how to continue."""
        if RunDirectory(self.output).checkpoint.is_file():
            return f"{self.output} holds a checkpoint: repeat the command with --resume to continue from it"
        return "no checkpoint was written yet: repeat the command to start again"

    def settings(self) -> RunSettings:
        """Settings of the run apart from the recipe."""
        device = str(chosen_device(self.device))
        data = str(self.data.resolve())  # Later commands may be started in another folder.
        return RunSettings(data, self.iterations, self.downscale, self.seed, device, self.mask_polarity)


PATH_OPTIONS = ("--data", "--output", "--config")
HELP, FULL_HELP = ("-h", "--help"), "--help-advanced"
HELP_POINTER = f"These are the most common options; {FULL_HELP} shows all of them."


def help_of_method(arguments: Sequence[str]) -> str:
    """Pointer to the full help of the method that the arguments name, instead of tyro's, which lists none."""
    method = named_method(arguments) or PlanarRecipe.method
    return f"all options of a method: glassplat train {method} {FULL_HELP}"


def train_command(arguments: Sequence[str]) -> tuple[Any, list[str]]:
    """Type and settings for tyro of a command line of `train`.

    Returns:
        `Train` with the recipes of the named preset or file as defaults, reduced to common options for `--help`; and
        the arguments for it.
    """
    first = arguments[0] if arguments else "-"
    if first not in RECIPES and not first.startswith("-"):
        raise InputError(unknown_name_message("method", first, RECIPES, "glassplat train --help"))
    if named_method(arguments) is None and not {*HELP, FULL_HELP} & set(arguments):
        raise InputError(unknown_name_message("method", "", RECIPES, "glassplat train --help"))
    full = FULL_HELP in arguments
    # An unknown preset is refused by the parser.
    preset: Preset = "paper" if last_option_value(arguments, "--preset") == "paper" else "glassplat"
    recipes = [recipe_of(method, preset) for method in RECIPES]
    if (config := last_option_value(arguments, "--config")) is not None:
        given = read_recipe(Path(config), arguments)
        recipes = [given if recipe.method == given.method else recipe for recipe in recipes]
    if not full and any(help_option in arguments for help_option in HELP):
        note = HELP_POINTER if named_method(arguments) else ""  # Not for each method of the list.
        recipes = [hide_advanced_options(recipe, note) for recipe in recipes]
    choices = [Annotated[type(r), tyro.conf.subcommand(r.method, default=r)] for r in recipes]
    any_recipe: Any = functools.reduce(operator.or_, choices)
    return Train[any_recipe], ["--help" if argument == FULL_HELP else argument for argument in arguments]


def read_recipe(path: Path, arguments: Sequence[str]) -> Any:
    """The recipe in a file, checked against the method that the arguments name."""
    with convert_to_input_error():
        recipe = recipe_from_json(read_text(path), str(path))
    method = named_method(arguments) or recipe.method
    if method != recipe.method:
        raise InputError(f"{path} is a recipe of {recipe.method}; expected one of {method}, or `train {recipe.method}`")
    return recipe


def named_method(arguments: Sequence[str]) -> str | None:
    """The first argument that is a method's name and not a path; None if there is none."""
    words = itertools.pairwise(["", *arguments])
    return next((word for before, word in words if word in RECIPES and before not in PATH_OPTIONS), None)


def last_option_value(arguments: Sequence[str], option: str) -> str | None:
    """The last value of an option in the arguments; None if it is absent."""
    found = None
    for before, argument in itertools.pairwise(["", *arguments]):
        if argument.startswith(f"{option}="):
            found = argument.removeprefix(f"{option}=")
        elif before == option and not argument.startswith("-"):
            found = argument
    return found


def hide_advanced_options(options: Any, note: str = "") -> Any:
    """The same options as a type whose help shows only the essential ones, and a note."""
    kind, hints = type(options), typing.get_type_hints(type(options), include_extras=True)
    values = {field.name: getattr(options, field.name) for field in dataclasses.fields(options)}
    fields: list[Any] = []
    for name, value in values.items():
        if dataclasses.is_dataclass(value) and has_essentials(type(value)):
            values[name] = hide_advanced_options(value)
        if values[name] is not value:
            fields.append((name, type(values[name]), dataclasses.field(default=values[name])))
        elif not is_essential(hints[name]):
            fields.append((name, Annotated[hints[name], tyro.conf.Suppress], dataclasses.field(default=value)))
    summary, _, rest = (kind.__doc__ or "").partition("\n\n")
    manual = f"{summary}\n\n    {note}\n\n{rest}" if note else kind.__doc__
    namespace = {"__doc__": manual, "__module__": kind.__module__}
    return dataclasses.make_dataclass(kind.__name__, fields, bases=(kind,), namespace=namespace, frozen=True)(**values)


def has_essentials(kind: type) -> bool:
    """Return whether one of a dataclass's options is essential."""
    return any(is_essential(hint) for hint in typing.get_type_hints(kind, include_extras=True).values())


def is_essential(hint: Any) -> bool:
    """Return whether an annotation marks an option as one that many runs need."""
    return any(isinstance(data, Essential) for data in typing.get_args(hint)[1:])


SCENE = Path(__file__).parents[1] / "demo_scene"
DEMO_DOWNSCALE = 3.2
"""Reduces the bundled photographs to 200x150 pixels, which train in minutes on two cores."""
LEAST_ITERATIONS = 8
"""Enough for a step in each stage of `planar`."""


@dataclass(frozen=True)
class Demo:
    """Train planar and splat on the bundled shop window and compare them; continues an interrupted demo.

    Attributes:
        output: directory of the two runs.
        iterations: length of each run.
        seed: random seed.
        device: training device; auto uses an NVIDIA GPU if available.
    """

    output: Path = Path("runs/demo")
    iterations: PositiveCount = 1500
    seed: Seed = 0
    device: DeviceName = "auto"

    def set_up(self) -> None:
        """Checks the folders of both runs, and that the runs are long enough for the stages of `planar`."""
        check_folder(self.output)
        check_targets(self.output, self.folders, [])
        for run in map(RunDirectory, self.folders):
            check_output(run, resume=run.checkpoint.is_file())
        if self.iterations < LEAST_ITERATIONS:
            raise InputError(f"--iterations is {self.iterations}; expected at least {LEAST_ITERATIONS}")

    @property
    def folders(self) -> list[Path]:
        """Directories of the two runs."""
        return [self.output / method for method in (PlanarRecipe.method, SplatRecipe.method)]

    def run(self, console: Console) -> None:
        """Trains and evaluates both methods, and prints where the images are."""
        recipes: tuple[MethodRecipe, ...] = (PlanarRecipe(), SplatRecipe())
        for recipe, folder in zip(recipes, self.folders, strict=True):
            begun = RunDirectory(folder).checkpoint.is_file()
            run = Train(recipe, SCENE, folder, self.iterations, DEMO_DOWNSCALE, self.seed, self.device, resume=begun)
            print_line(console, f"training {recipe.method}")
            run.set_up()
            run.run(console)
        from glassplat.cli.evaluation import evaluate_run, print_results
        from glassplat.cli.runs import open_run

        print_results(console, *(evaluate_run(open_run(folder, self.device)) for folder in self.folders))
        planar = self.output / "planar"
        print_line(console, f"pictures: {planar / 'index.html'} and {planar / 'sheets'}")

    def interrupt_message(self) -> str:
        """Message after an interrupt: the state on disk, and how to continue."""
        return f"finished work stays in {self.output}: repeat the command to continue"
