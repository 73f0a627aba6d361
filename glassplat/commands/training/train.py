"""`glassplat train`: photographs to a trained scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Generic, TypeVar

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.commands.console.messages import message_console, say
from glassplat.data.capture_files import CaptureFiles, read_capture
from glassplat.data.masks import Polarity
from glassplat.data.ranges import Downscale, Positive, Seed, Several
from glassplat.kernels.backend.devices import DeviceName, chosen_device
from glassplat.train.recipe import Preset, Recipe
from glassplat.train.run_directory import CHECKPOINT_SECONDS, RunDirectory, RunSettings, check_output

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

    def ready(self) -> None:
        """Refuses what stands in the way, says what the capture's folder holds, and imports what trains."""
        check_output(RunDirectory(self.output), resume=self.resume)
        say(message_console(), self.files)
        import_now("glassplat.commands.training.training_run")
        self.recipe.renderer()  # Imports what this method trains with, too, before anything is written.

    @cached_property
    def files(self) -> CaptureFiles:
        """What the capture's folder holds; read when it is first asked for, without PyTorch."""
        return read_capture(self.data, mask_polarity=self.mask_polarity)

    def run(self, console: Console) -> None:
        """Trains, with a progress bar or lines."""
        from glassplat.commands.training.training_run import train

        train(self, console)

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
