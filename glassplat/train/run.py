"""A whole training run: data in, run directory out, with checkpoints, a log and a clean stop."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import FrameType
from typing import Any, NoReturn

from glassplat.data.dataset import Dataset
from glassplat.data.errors import InputError
from glassplat.data.photographs_read import photographs_read
from glassplat.files.folders import check_folder, make_folder
from glassplat.train.background import settled
from glassplat.train.checkpoint import load_checkpoint, save_checkpoint
from glassplat.train.messages import ActionDone, CheckpointWritten, Message, RunBegun, StepDone, Working
from glassplat.train.run_directory import RunDirectory, RunSettings
from glassplat.train.run_lock import check_unlocked, run_lock
from glassplat.train.run_log import RunLog, open_log
from glassplat.train.stage import Stage, check_length
from glassplat.train.state import TrainState
from glassplat.train.trainer import train

Listener = Callable[[Message], None]
CHECKPOINT_SECONDS = 120.0
"""What a power cut may cost at the most, unless the user says otherwise."""
STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Ctrl-C, what a shut-down or a job scheduler sends before it kills, and what a closed terminal leaves behind."""


@dataclass
class StopRequest:
    """Set when the user asks a run to stop; the run ends after the current step.

    Attributes:
        number: the signal by which it was asked; None as long as it was not.
        answer: what the signal did before the run began.
    """

    number: int | None = None
    answer: Callable[[int, FrameType | None], Any] | int | None = None

    @property
    def requested(self) -> bool:
        """Whether the run is to stop."""
        return self.number is not None

    def end(self) -> NoReturn:
        """Ends the run as the signal would have ended it, so that the caller can tell one from the other."""
        if callable(self.answer) and self.number is not None:
            self.answer(self.number, None)
        raise KeyboardInterrupt


@contextmanager
def stop_on_interrupt() -> Iterator[StopRequest]:
    """Turns the first Ctrl-C, termination or hang-up into a request to stop after the step; a second one interrupts.

    What is ignored stays ignored, as a hang-up is under `nohup`. Only the main thread can be asked.
    """
    request = StopRequest()

    def ask(number: int, frame: FrameType | None) -> None:
        if request.requested:
            request.end()
        request.number, request.answer = number, previous[number]

    main = threading.current_thread() is threading.main_thread()
    heard = [number for number in STOP_SIGNALS if main and signal.getsignal(number) != signal.SIG_IGN]
    previous = {number: signal.signal(number, ask) for number in heard}
    try:
        yield request
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def check_output(directory: RunDirectory, *, resume: bool) -> None:
    """What can be told about a run's directory before the photographs are read; writes nothing.

    Raises:
        InputError: a fresh run would overwrite something, there is nothing to go on from, or another training writes
            there.
        NotADirectoryError: it is a file, or goes through one.
        PermissionError: nothing may be written there.
    """
    check_folder(directory.path)
    check_unlocked(directory.path)
    if resume:
        directory.check_saved()
    else:
        directory.check_vacant()


def run_training(
    recipe: Any,
    settings: RunSettings,
    directory: RunDirectory,
    dataset: Dataset,
    *,
    resume: bool,
    listen: Listener,
    checkpoint_every: float = CHECKPOINT_SECONDS,
) -> TrainState:
    """Trains to the end or to the user's interrupt, and leaves a run directory from which both can go on.

    A recipe that names no background gets the one that transparent photographs are laid over; it is recorded.
    Nothing is written before the first scene has been made.

    Args:
        recipe: how to train.
        settings: what was asked for beside it.
        directory: where everything goes.
        dataset: photographs to fit.
        resume: go on from the checkpoint in `directory`.
        listen: gets every message.
        checkpoint_every: seconds from one checkpoint to the next; there is one at the end in any case.

    Raises:
        InputError: the directory is not fit for it (`check_output`), the run was recorded with other settings, it is
            too short for its stages, a photograph cannot be read, of the test views too, or as `settled` does.
        KeyboardInterrupt: the user stopped the run; the checkpoint is written.
        TrainingDivergedError: training cannot go on; the last checkpoint stays.
        OSError: the disk is full or fails; the last checkpoint stays.
    """
    recipe = settled(recipe, dataset)
    stages = recipe.stages(settings.seed, settings.iterations)
    check_length(stages, settings.iterations)
    check_output(directory, resume=resume)
    first = None if resume else first_state(recipe, settings, dataset, listen)
    make_folder(directory.path)
    with run_lock(directory.path):
        # Another training may have ended here meanwhile.
        anew = directory.is_begun and not resume
        state = resumed_state(recipe, settings, directory) if first is None else first
        if not resume:
            directory.check_vacant()
            directory.begin(recipe, settings, dataset)
        with open_log(directory.log, state.step) as log:
            sitting = Sitting(directory, state, log=log, listen=listen, checkpoint_every=checkpoint_every)
            sitting.tell(RunBegun(state.step, settings.iterations, anew))
            sitting.train(stages, dataset, settings.iterations)
        directory.export(state.scene, state.step)
    return state


def first_state(recipe: Any, settings: RunSettings, dataset: Dataset, listen: Listener) -> TrainState:
    """The state from which a fresh run starts."""
    listen(Working("preparing the first scene", 0, 1))
    return TrainState(recipe.initialise(dataset), settings.seed, method=recipe.method).to(settings.device)


def resumed_state(recipe: Any, settings: RunSettings, directory: RunDirectory) -> TrainState:
    """The checkpoint's state.

    Raises:
        InputError: the run was recorded with other settings, or nothing is saved.
    """
    directory.check_saved()
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


class Sitting:
    """One stretch of a run: from its beginning or a checkpoint to its end or an interrupt."""

    def __init__(
        self,
        directory: RunDirectory,
        state: TrainState,
        *,
        log: RunLog,
        listen: Listener,
        checkpoint_every: float,
    ) -> None:
        self._directory, self._state = directory, state
        self._log, self._listen, self._every = log, listen, checkpoint_every
        self._seconds_before, self._started = state.seconds, time.perf_counter()
        self._saved = self._started
        self._stop = StopRequest()

    def train(self, stages: tuple[Stage, ...], dataset: Dataset, iterations: int) -> None:
        """Trains to the end, or raises KeyboardInterrupt after the step in which the user asks for it."""
        with stop_on_interrupt() as self._stop, photographs_read(dataset) as check_photographs:
            for message in train(stages, dataset, self._state, iterations):
                check_photographs()
                self.tell(message)
                if not isinstance(message, StepDone):
                    continue
                is_last = message.step == iterations
                if self._stop.requested or is_last or time.perf_counter() - self._saved >= self._every:
                    self._save()
                    self.tell(CheckpointWritten(message.step))
                if self._stop.requested and not is_last:
                    self._stop.end()

    def tell(self, message: Message) -> None:
        """Passes a message on; should nobody be there any more to hear it, what was trained is saved first."""
        try:
            self._log.write(message)
            self._listen(message)
        except BaseException as error:
            if isinstance(message, StepDone | ActionDone):
                self._save()
            if self._stop.requested and isinstance(error, OSError):
                self._stop.end()  # A terminal that was closed can show nothing, and that is no failure.
            raise

    def _save(self) -> None:
        self._state.seconds = self._seconds_before + time.perf_counter() - self._started
        save_checkpoint(self._directory.checkpoint, self._state)
        self._saved = time.perf_counter()
