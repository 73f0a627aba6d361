"""`glassplat train`: photographs to a trained scene."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Generic, TypeVar

import tyro
from rich.console import Console

from glassplat.commands.console.messages import say, warn
from glassplat.commands.console.training_progress import TrainingProgress
from glassplat.data.dataset import Dataset, load_dataset
from glassplat.data.masks import Polarity
from glassplat.data.ranges import Downscale, Positive, Seed, Several
from glassplat.interface.training import Training
from glassplat.kernels.devices import DeviceName, chosen_device
from glassplat.train.background import photo_background
from glassplat.train.messages import Message
from glassplat.train.recipe import Preset, Recipe
from glassplat.train.run import CHECKPOINT_SECONDS, Listener
from glassplat.train.run_directory import RunDirectory, RunSettings, check_output

RecipeKind = TypeVar("RecipeKind", bound=Recipe)


@dataclass(frozen=True)
class Train(Generic[RecipeKind]):
    """Train a scene from photographs.

    Attributes:
        recipe: method and its options; `train_options` tells the command line which there are.
        preset: what the options are unless they are given: the best that this project found, or those of the paper.
        data: directory of the capture (COLMAP or transforms.json; pane masks in masks/).
        output: directory of the run.
        iterations: length of the run; every schedule stretches with it.
        downscale: shrink the photographs by this factor.
        seed: fixes every random choice.
        device: where to train; auto takes an NVIDIA GPU where one can be used.
        resume: go on with the run in `output`.
        mask_polarity: which value of black-and-white masks is the pane.
        checkpoint_every: seconds from one checkpoint to the next; an end or an interrupt writes one in any case.
        view: look at it in the browser meanwhile.
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
    checkpoint_every: Positive = CHECKPOINT_SECONDS
    preset: Preset = "glassplat"
    view: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False

    def run(self, console: Console) -> None:
        """Trains, with a progress bar or lines."""
        check_output(RunDirectory(self.output), resume=self.resume)
        background = photo_background(self.recipe)
        dataset = load_dataset(
            self.data, downscale=self.downscale, background=background, mask_polarity=self.mask_polarity
        )
        describe(dataset, console)
        training = Training(
            dataset,
            self.recipe,
            iterations=self.iterations,
            output=self.output,
            seed=self.seed,
            device=self.device,
            resume=self.resume,
            checkpoint_every=self.checkpoint_every,
        )
        with TrainingProgress(console, self.iterations) as progress, self._watched(training, dataset, console) as watch:

            def listen(message: Message) -> None:
                progress.show(message)
                watch(message)

            scene = training.run(listen).scene
        say(
            console,
            f"trained {self.recipe.method} for {training.step} iterations in {training.seconds:.0f} s: "
            f"{len(scene.primary)} Gaussians, {len(scene.planes)} panes -> {self.output}",
        )
        say(console, f"next: glassplat eval {self.output}")

    @contextmanager
    def _watched(self, training: Training, dataset: Dataset, console: Console) -> Iterator[Listener]:
        """What else listens: the viewer, where it is asked for."""
        if not self.view:
            yield lambda message: None
            return
        from glassplat.commands.looking.viewing import announce
        from glassplat.interface.watching import WatchedTraining
        from glassplat.viewer.ports import LOCAL, vacant_port

        watched = WatchedTraining(
            training, dataset, host=LOCAL, port=vacant_port(LOCAL), announce=lambda viewer: announce(viewer, console)
        )
        try:
            yield watched.hear
        finally:
            watched.stop()

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
    given = f", {len(dataset.planes)} in planes.json" if dataset.planes is not None else ""
    say(
        console,
        f"{dataset.root}: {len(dataset.train)} training and {len(dataset.test)} test views, "
        f"{len(dataset.points.positions)} points, {annotated} annotated views with {len(dataset.pane_labels)} panes"
        f"{given}",
    )
    for warning in dataset.warnings:
        warn(console, warning)
