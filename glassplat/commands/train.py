"""`glassplat train`: photographs to a trained scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Generic, TypeVar

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from glassplat.data.dataset import Dataset, load_dataset
from glassplat.data.masks import Polarity
from glassplat.data.ranges import Downscale, Seed, Several
from glassplat.kernels.devices import DeviceName, chosen_device
from glassplat.train.background import photo_background
from glassplat.train.messages import ActionDone, Message, StageEntered, StepDone
from glassplat.train.recipe import Preset, Recipe
from glassplat.train.run import run_training
from glassplat.train.run_directory import RunDirectory, RunSettings

RecipeKind = TypeVar("RecipeKind", bound=Recipe)


@dataclass(frozen=True)
class Train(Generic[RecipeKind]):
    """Train a scene from photographs.

    Attributes:
        recipe: method and its options; `train_options` tells the command line which there are.
        preset: what the options of the method are unless they are given: those that this project found best, or those
            of the paper, to compare with its results.
        data: directory of the capture (COLMAP or transforms.json; pane masks in masks/).
        output: directory of the run.
        iterations: length of the run; every schedule stretches with it.
        downscale: shrink the photographs by this factor.
        seed: fixes every random choice.
        device: where to train; auto takes an NVIDIA GPU where one can be used.
        resume: go on with the run in `output`.
        mask_polarity: which value of black-and-white masks is the pane.
    """

    recipe: Annotated[RecipeKind, tyro.conf.arg(name="")]
    data: Path
    output: Path
    iterations: Several = 30_000
    downscale: Downscale = 1.0
    seed: Seed = 0
    device: DeviceName = "auto"
    resume: bool = False
    mask_polarity: Polarity = "auto"
    preset: Preset = "glassplat"

    def run(self, console: Console) -> None:
        """Trains, with a progress bar."""
        background = photo_background(self.recipe)
        dataset = load_dataset(
            self.data, downscale=self.downscale, background=background, mask_polarity=self.mask_polarity
        )
        describe(dataset, console)
        settings = self.settings()
        directory = RunDirectory(self.output)
        with TrainingProgress(console, self.iterations) as progress:
            state = run_training(self.recipe, settings, directory, dataset, resume=self.resume, listen=progress.show)
        console.print(
            f"trained {self.recipe.method} for {state.step} iterations in {state.seconds:.0f} s: "
            f"{len(state.scene.primary)} Gaussians, {len(state.scene.planes)} panes -> {self.output}"
        )
        console.print(f"next: glassplat eval {self.output}")

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        if RunDirectory(self.output).checkpoint.is_file():
            return f"{self.output} holds a checkpoint: repeat the command with --resume to go on from it"
        return "no checkpoint was written yet: repeat the command to begin again"

    def settings(self) -> RunSettings:
        """What the run's directory records beside the recipe."""
        device = str(chosen_device(self.device))
        data = str(self.data.resolve())  # The run may be looked at from another folder than it was started in.
        return RunSettings(data, self.iterations, self.downscale, self.seed, device, self.mask_polarity)

    def resuming(self, begun: bool) -> Train:
        """The same run, going on from its checkpoint if it has begun."""
        return replace(self, resume=begun)


def describe(dataset: Dataset, console: Console) -> None:
    """Says what was loaded, with the loader's warnings."""
    annotated = sum(view.is_annotated for view in dataset.train)
    console.print(
        f"{dataset.root}: {len(dataset.train)} training and {len(dataset.test)} test views, "
        f"{len(dataset.points.positions)} points, {annotated} annotated views with {len(dataset.pane_labels)} panes"
    )
    for warning in dataset.warnings:
        console.print(f"[yellow]warning:[/yellow] {warning}")


class TrainingProgress:
    """A progress bar with loss, number of Gaussians and remaining time."""

    def __init__(self, console: Console, iterations: int) -> None:
        columns = (
            TextColumn("{task.fields[stage]}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("loss {task.fields[loss]:.4f}"),
            TextColumn("{task.fields[count]} Gaussians"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(compact=True),
        )
        self._bar = Progress(*columns, console=console, refresh_per_second=4)
        self._task = self._bar.add_task("train", total=iterations, stage="", loss=0.0, count=0)
        self._loss = 0.0

    def __enter__(self) -> TrainingProgress:
        self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._bar.stop()

    def show(self, message: Message) -> None:
        """Follows a run's messages."""
        if isinstance(message, StageEntered):
            self._bar.update(self._task, stage=message.stage, completed=message.step)
            self._bar.console.print(f"step {message.step}: stage {message.stage}, {_counted(message.counts)}")
        elif isinstance(message, ActionDone) and not message.action.startswith(("densify", "grow")):
            self._bar.console.print(f"step {message.step}: {message.action}")
        elif isinstance(message, StepDone):
            self._loss = message.loss if not self._loss else 0.98 * self._loss + 0.02 * message.loss
            total = message.counts["primary"] + message.counts["glass"]
            self._bar.update(self._task, completed=message.step, loss=self._loss, count=total)


def _counted(counts: object) -> str:
    return ", ".join(f"{number} {name}" for name, number in dict(counts).items())  # type: ignore[call-overload]
