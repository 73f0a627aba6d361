"""A whole training run: data in, run directory out, with checkpoints, a log and a clean stop."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import FrameType
from typing import Any, TextIO

from glassplat.data.dataset import Dataset
from glassplat.data.errors import InputError
from glassplat.data.photographs_read import photographs_read
from glassplat.train.background import settled
from glassplat.train.checkpoint import load_checkpoint, save_checkpoint
from glassplat.train.messages import Message, StepDone
from glassplat.train.run_directory import RunDirectory, RunSettings
from glassplat.train.state import TrainState
from glassplat.train.trainer import train

Listener = Callable[[Message], None]
LOG_EVERY = 10
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Ctrl-C, and what a shut-down or a job scheduler sends before it kills."""


@dataclass
class StopRequest:
    """Set when the user asks a run to stop; the run ends after the current step."""

    requested: bool = False


@contextmanager
def stop_on_interrupt() -> Iterator[StopRequest]:
    """Turns the first Ctrl-C or termination into a request to stop after the step; a second one interrupts at once."""
    request = StopRequest()

    def ask(number: int, frame: FrameType | None) -> None:
        if request.requested:
            raise KeyboardInterrupt
        request.requested = True

    previous = {number: signal.signal(number, ask) for number in STOP_SIGNALS}
    try:
        yield request
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def prepare(recipe: Any, settings: RunSettings, directory: RunDirectory, dataset: Dataset, resume: bool) -> TrainState:
    """The state from which a run starts: fresh, or the checkpoint's.

    Raises:
        InputError: a fresh run would overwrite another one, or a resumed one was recorded with other settings.
    """
    if resume:
        # A run may go on on another device.
        recorded = replace(directory.settings(), device=settings.device)
        if recorded != settings or not directory.was_begun_with(recipe):
            raise InputError(
                f"{directory.path} was started with {directory.settings()} and its own recipe; expected the same to "
                f"resume it, got {settings}. Repeat the original options, with the version of glassplat that began "
                "it, or choose another --output"
            )
        state = load_checkpoint(
            directory.checkpoint, method=recipe.method, seed=settings.seed, iterations=settings.iterations
        )
        return state.to(settings.device)
    if directory.checkpoint.exists() or directory.results.exists():
        raise InputError(
            f"{directory.path} already holds a run; pass --resume to go on with it, or choose another --output"
        )
    directory.begin(recipe, settings, dataset)
    return TrainState(recipe.initialise(dataset), settings.seed, method=recipe.method).to(settings.device)


def run_training(
    recipe: Any, settings: RunSettings, directory: RunDirectory, dataset: Dataset, *, resume: bool, listen: Listener
) -> TrainState:
    """Trains to the end or to the user's interrupt, and leaves a run directory from which both can go on.

    A recipe that names no background gets the one that transparent photographs are laid over; it is recorded.

    Raises:
        InputError: as `prepare` and `settled` do, or a photograph that cannot be read, of the test views too.
        KeyboardInterrupt: the user stopped the run; the checkpoint is written.
        TrainingDivergedError: a loss is not finite; the last checkpoint stays.
    """
    recipe = settled(recipe, dataset)
    state = prepare(recipe, settings, directory, dataset, resume)
    every = max(settings.iterations // 10, 500)
    resumed_seconds, started = state.seconds, time.perf_counter()
    with (
        stop_on_interrupt() as stop,
        open_log(directory, state.step) as log,
        photographs_read(dataset) as check_photographs,
    ):
        for message in train(recipe.stages(settings.seed), dataset, state, settings.iterations):
            check_photographs()
            listen(message)
            write_log(log, message)
            if not isinstance(message, StepDone):
                continue
            state.seconds = resumed_seconds + time.perf_counter() - started
            if stop.requested or state.step % every == 0 or state.step == settings.iterations:
                save_checkpoint(directory.checkpoint, state)
            if stop.requested and state.step < settings.iterations:
                raise KeyboardInterrupt
    directory.export(state.scene, state.step)
    return state


def open_log(directory: RunDirectory, step: int) -> TextIO:
    """The log, cut back to the step from which the run goes on."""
    kept = []
    if step and directory.log.is_file():
        kept = [
            line for line in directory.log.read_text(encoding="utf-8").splitlines() if json.loads(line)["step"] <= step
        ]
    directory.log.write_text("".join(line + "\n" for line in kept), encoding="utf-8")
    return directory.log.open("a", encoding="utf-8")


def write_log(log: TextIO, message: Message) -> None:
    """Appends a message as a line of JSON; of the steps, every tenth."""
    if isinstance(message, StepDone) and message.step % LOG_EVERY:
        return
    log.write(json.dumps({"message": type(message).__name__, **vars(message)}) + "\n")
    log.flush()
