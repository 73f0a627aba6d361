"""Training, followed message by message."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

from glassplat.data.dataset import Dataset
from glassplat.data.errors import InputError
from glassplat.interface.model import Model
from glassplat.kernels.backend.devices import DeviceName, chosen_device
from glassplat.train.background import settled
from glassplat.train.messages import Message, Working
from glassplat.train.recipe import RECIPES, Recipe
from glassplat.train.run import Listener, Run, first_state
from glassplat.train.run_directory import CHECKPOINT_SECONDS, RunDirectory, RunSettings
from glassplat.train.stage import check_length
from glassplat.train.state import TrainState
from glassplat.train.trainer import train


class Training:
    """A training run: iterate over it, and it trains from one message to the next.

        for message in glassplat.Training(dataset, "planar", iterations=7000, output="runs/shop"):
            match message:
                case glassplat.StepDone(step=step, loss=loss):
                    print(step, loss)

    Between two messages, from the first `StepDone` on, `model` is the scene as trained so far. With an `output` the run
    is written as `glassplat train` writes it, `for` may be left with `break`, Ctrl-C ends it after a step, and either
    way `resume=True` goes on. Without one, everything stays in memory.

    Attributes:
        recipe: how to train, with the background that the photographs have.
        iterations: length of the run.
    """

    def __init__(
        self,
        dataset: Dataset,
        recipe: str | Recipe = "planar",
        *,
        iterations: int = 30_000,
        output: str | os.PathLike[str] | None = None,
        seed: int = 0,
        device: DeviceName = "auto",
        resume: bool = False,
        checkpoint_every: float = CHECKPOINT_SECONDS,
    ) -> None:
        """Checks what can be known beforehand; nothing is trained or written yet.

        Args:
            dataset: photographs to fit.
            recipe: the name of a method, with its options as they are by default; or a recipe, such as
                `PlanarRecipe(fresnel="schlick")`, or one of your own.
            iterations: length of the run; every schedule stretches with it.
            output: directory of the run.
            seed: fixes every random choice.
            device: where to train; `auto` takes an NVIDIA GPU where one can be used.
            resume: go on with the run in `output`.
            checkpoint_every: seconds from one checkpoint to the next; there is one at the end in any case.

        Raises:
            CudaUnavailableError: the GPU was asked for and cannot be used.
            InputError: no method has that name; `output` holds something else, or nothing to go on from; the run is too
                short for its stages; or the photographs lie over another background than the recipe's.
        """
        chosen = chosen_recipe(recipe)
        root = str(dataset.root.resolve())  # The run may be looked at from another folder than it was started in.
        self.iterations, self._dataset = iterations, dataset
        self._settings = RunSettings(
            root, iterations, dataset.downscale, seed, str(chosen_device(device)), dataset.mask_polarity
        )
        self._run: Run | None = None
        self._state: TrainState | None = None
        if output is None:
            if resume:
                raise InputError("resume=True needs the output that it is to go on with")
            self.recipe: Any = settled(chosen, dataset)
            self._stages = self.recipe.stages(seed, iterations)
            check_length(self._stages, iterations)
            return
        self._run = Run(
            chosen,
            self._settings,
            RunDirectory(Path(output)),
            dataset,
            resume=resume,
            checkpoint_every=checkpoint_every,
        )
        self.recipe = self._run.recipe

    def __iter__(self) -> Generator[Message, None, None]:
        """Trains from one message to the next, to the end.

        Raises:
            InputError: a photograph cannot be read; or the run in `output` was recorded with other options.
            KeyboardInterrupt: the user stopped the run.
            TrainingDivergedError: training cannot go on.
            OSError: the disk is full or fails.
        """
        return self._in_memory() if self._run is None else self._run.messages()

    def run(self, listen: Listener | None = None) -> Model:
        """Trains to the end; returns the trained model.

        Args:
            listen: gets every message; what it raises ends the run, once what was trained is saved.
        """
        if self._run is not None:
            self._run.to_the_end(listen or _nobody)
        else:
            for message in self._in_memory():
                (listen or _nobody)(message)
        return self.model

    @property
    def state(self) -> TrainState:
        """Everything that changes while training: scene, optimiser, statistics.

        Raises:
            RuntimeError: the first scene has not been made yet.
        """
        state = self._state if self._run is None else self._run.state
        if state is None:
            raise RuntimeError("the run has not begun; ask after its first message from a step")
        return state

    @property
    def step(self) -> int:
        """Iterations done; 0 before the run begins."""
        state = self._state if self._run is None else self._run.state
        return 0 if state is None else state.step

    @property
    def seconds(self) -> float:
        """Time spent training, over all sittings, up to the last checkpoint."""
        return self.state.seconds

    @property
    def is_stopping(self) -> bool:
        """Whether the user has asked the run to end, as with Ctrl-C; it does after the step."""
        return self._run is not None and self._run.is_stopping

    @property
    def model(self) -> Model:
        """The scene as trained so far; its tensors go on changing, so `save` it, or clone what has to stay.

        Raises:
            RuntimeError: the first scene has not been made yet.
        """
        cameras = {view.name: view.camera for view in (*self._dataset.train, *self._dataset.test)}
        return Model(self.state.scene, self.recipe, cameras, self._dataset.root.name)

    def save(self) -> None:
        """Writes a checkpoint and the scene into `output` now; between two messages, after a `StepDone`.

        Raises:
            RuntimeError: there is no `output`, or the run has not begun.
        """
        if self._run is None:
            raise RuntimeError("this training has no output to save to; use `training.model.save(path)`")
        self._run.save()

    def _in_memory(self) -> Generator[Message, None, None]:
        if self._state is None:
            yield Working("preparing the first scene", 0, 1)
            self._state = first_state(self.recipe, self._settings, self._dataset)
        yield from train(self._stages, self._dataset, self._state, self.iterations)


def chosen_recipe(recipe: str | Recipe) -> Any:
    """The recipe, or that of a method's name.

    Raises:
        InputError: no method has that name.
    """
    if not isinstance(recipe, str):
        return recipe
    if recipe not in RECIPES:
        raise InputError(f"no method is called {recipe!r}; expected {', '.join(RECIPES)}, or a recipe")
    return RECIPES[recipe]()


def _nobody(message: Message) -> None:
    """Listens to nothing."""
