"""Training runs: from data to a run directory, with checkpoints, a log and orderly interruption."""

from __future__ import annotations

import dataclasses
import json
import logging
import os
import signal
import threading
import time
import zlib
from collections.abc import Callable, Container, Generator, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from shlex import quote
from types import FrameType
from typing import Any, NamedTuple, NoReturn

import torch

from glassplat import __version__
from glassplat.captures.dataset import Dataset, check_dataset, read_photographs_in_background, with_corrected_cameras
from glassplat.errors import InputError, RankLostError, join_names
from glassplat.files.writing import make_folder
from glassplat.kernels.backend.devices import DeviceName, chosen_device, compile_seconds
from glassplat.methods.recipe import RECIPES, recipe_to_json, resolve_background
from glassplat.model import run_directory
from glassplat.model.model import Model
from glassplat.options import check_value, short_repr
from glassplat.scene.panes import name_labels
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.loop import train
from glassplat.training.messages import (
    ActionDone,
    CheckpointWritten,
    Message,
    RunBegun,
    StageEntered,
    StepDone,
    Working,
)
from glassplat.training.options import MethodRecipe
from glassplat.training.ranks import Ranks, join_ranks
from glassplat.training.stage import Stage, TrainState, check_length, stage_starts

log = logging.getLogger("glassplat.training")

Listener = Callable[[Message], None]
STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Ctrl-C, termination by a shutdown or job scheduler, and a closed terminal."""


@dataclass(eq=False)
class StopRequest:
    """A request to stop the run after the current step.

    Attributes:
        signal_number: the signal; None without a request.
        handler: handler of the signal before the run.
    """

    signal_number: int | None = None
    handler: Callable[[int, FrameType | None], Any] | int | None = None

    @property
    def requested(self) -> bool:
        """Return whether a stop was requested."""
        return self.signal_number is not None

    def end(self) -> NoReturn:
        """Ends the run in the way of the signal, so that the caller can distinguish signals."""
        if callable(self.handler) and self.signal_number is not None:
            self.handler(self.signal_number, None)
        raise KeyboardInterrupt


_stop_requests: list[StopRequest] = []
"""Requests of the active runs in the main thread; several may be iterated alternately."""
_previous_handlers: dict[int, Any] = {}
"""Handlers of the signals before these runs."""


@contextmanager
def stop_on_interrupt() -> Iterator[StopRequest]:
    """Turns the first SIGINT, SIGTERM or SIGHUP into a request to stop after the step; a second one interrupts.

    Ignored signals stay ignored, as under `nohup`. Works only in the main thread.
    """
    request = StopRequest()
    if threading.current_thread() is threading.main_thread():
        _stop_requests.append(request)
        for number in STOP_SIGNALS:
            if (handler := signal.getsignal(number)) not in (None, signal.SIG_IGN, _request_stop):
                _previous_handlers[number] = handler
                signal.signal(number, _request_stop)
    try:
        yield request
    finally:
        if request in _stop_requests:
            _stop_requests.remove(request)
        if not _stop_requests and threading.current_thread() is threading.main_thread():
            _restore_handlers()


def _request_stop(number: int, frame: FrameType | None) -> None:
    """Requests all runs to stop; interrupts if they were requested before.

    Under `torchrun`, which forwards signals of a scheduler, repeated signals are ignored.
    """
    if not _stop_requests:  # The last run ended in another thread, where handlers could not be restored.
        is_own = signal.getsignal(number) is _request_stop
        _restore_handlers()
        if is_own:
            signal.raise_signal(number)
    elif not all(request.requested for request in _stop_requests):
        for request in _stop_requests:
            request.signal_number, request.handler = number, _previous_handlers[number]
    elif "TORCHELASTIC_RUN_ID" not in os.environ:  # Also set if `torchrun` started a single process.
        _stop_requests[-1].end()


def _restore_handlers() -> None:
    for number, handler in _previous_handlers.items():
        if signal.getsignal(number) is _request_stop:
            signal.signal(number, handler)


def with_gradients(messages: Generator[Message, None, None]) -> Generator[Message, None, None]:
    """Forwards messages, with gradients enabled only inside of the generator.

    PyTorch's decorators for generators use a deprecated form of `throw`.
    """
    following = partial(next, messages)
    while True:
        try:
            with torch.inference_mode(False):
                message = following()
        except StopIteration:
            return
        try:
            yield message
        except GeneratorExit:
            with torch.inference_mode(False):
                messages.close()
            raise
        except BaseException as error:  # noqa: BLE001 - The generator handles it.
            following = partial(messages.throw, error)
        else:
            following = partial(next, messages)


class Run:
    """A training run in its directory, as a sequence of messages.

    A recipe without a background gets that of the photographs, which is recorded. Nothing is written before the
    initial scene exists. If the consumer stops iterating, a checkpoint is written, from which the run can be resumed.
    Of several ranks, the first one makes the scene and writes files.
    """

    def __init__(
        self,
        recipe: Any,
        settings: run_directory.RunSettings,
        directory: run_directory.RunDirectory,
        dataset: Dataset,
        *,
        resume: bool = False,
        checkpoint_every: float = run_directory.CHECKPOINT_SECONDS,
        ranks: Ranks | None = None,
    ) -> None:
        """Checks the arguments.

        Args:
            recipe: method and options.
            settings: the other settings.
            directory: output directory.
            dataset: photographs to fit.
            resume: continue from the checkpoint in `directory`.
            checkpoint_every: seconds between checkpoints; one is always written at the end.
            ranks: processes that train together; by default only this one.

        Raises:
            InputError: the directory is unsuitable (`check_output`), the run is too short for its stages, or
                backgrounds differ (`resolve_background`).
        """
        self.recipe = resolve_background(recipe, dataset)
        self._stages = self.recipe.stages(settings.seed, settings.iterations)
        check_length(self._stages, settings.iterations)
        run_directory.check_output(directory, resume=resume)
        self._settings, self._directory, self._dataset = settings, directory, dataset
        self._resume, self._checkpoint_every = resume, checkpoint_every
        self._ranks = ranks or Ranks()
        self._session: TrainingSession | None = None
        self.state: TrainState | None = None

    def run_to_end(self, listen: Listener) -> TrainState:
        """Trains to the end or to an interrupt; re-raises exceptions of `listen` after saving."""
        messages = self.messages()
        for message in messages:
            try:
                listen(message)
            except BaseException as error:  # noqa: BLE001 - The run saves its state and re-raises.
                messages.throw(error)
        assert self.state is not None
        return self.state

    def messages(self) -> Generator[Message, None, None]:
        """Trains from one message to the next; restarting the iteration continues from the checkpoint.

        Raises:
            InputError: settings or photographs differ from the recorded ones, or a photograph cannot be read, in which
                case the state is saved.
            KeyboardInterrupt: the user stopped the run; a checkpoint is written.
            TrainingDivergedError: training diverged; the last checkpoint stays.
            OSError: the disk is full or fails; the last checkpoint stays.
            RankLostError: another rank has ended; a checkpoint is written.
        """
        return with_gradients(self._messages())

    def _messages(self) -> Generator[Message, None, None]:
        self._ranks.check_equal(shared_settings(self.recipe, self._settings, self._dataset) | {"resume": self._resume})
        yield from self._run_as_leader() if self._ranks.is_leader else self._run_as_follower()
        self._ranks.exchange()  # Other ranks wait until the leader has written the scene.

    def _run_as_follower(self) -> Generator[Message, None, None]:
        """Trains on a rank that does not write."""
        self.state = self._ranks.broadcast(self.state, self._settings.device)
        self._session = TrainingSession(self.state, self._ranks)
        with self._dataset.memory.cache_on_disk(self._directory.path):
            yield from self._session.run_stages(self._stages, self._dataset, self._settings.iterations)

    def _run_as_leader(self) -> Generator[Message, None, None]:
        directory, settings = self._directory, self._settings
        resume = self._resume or (self.state is not None and directory.checkpoint.is_file())
        state = None
        if not resume:
            yield Working("preparing the first scene", 0, 1)
            state = initial_state(self.recipe, settings, self._dataset)
        make_folder(directory.path)
        with run_directory.run_lock(directory.path):
            directory.remove_partial_files()
            # Another process may have finished training here.
            anew = directory.is_begun and not resume
            if state is None:
                state = resumed_state(self.recipe, settings, directory, self._dataset)
            else:
                directory.check_vacant()
                directory.begin(self.recipe, settings, self._dataset)
            self.state = self._ranks.broadcast(state, settings.device)
            with run_directory.open_log(directory.log, self.state.step) as log:
                files = OutputFiles(directory.checkpoint, log, self._checkpoint_every, self._ensure_directory)
                self._session = TrainingSession(self.state, self._ranks, files)
                yield from self._session.deliver(RunBegun(self.state.step, settings.iterations, anew))
                with self._dataset.memory.cache_on_disk(directory.path):
                    yield from self._session.run_stages(self._stages, self._dataset, settings.iterations)
            self._export()

    @property
    def is_stopping(self) -> bool:
        """Return whether a stop after the step was requested."""
        return self._session is not None and self._session.is_stopping

    def save(self) -> None:
        """Writes a checkpoint and the scene; between two messages, after the first `StageEntered`.

        Of several ranks, only the first one writes.

        Raises:
            RuntimeError: the run has not started.
            OSError: the disk is full or fails.
        """
        if self._session is None or self.state is None:
            raise RuntimeError("nothing to save: the run has not started")
        self._session.save()
        if self._ranks.is_leader:
            self._export()

    def _ensure_directory(self) -> None:
        """Records again what is run where the directory was removed or renamed meanwhile, so that it is a run's."""
        if not (self._directory.path / "recipe.json").is_file():
            self._directory.begin(self.recipe, self._settings, self._dataset)

    def _export(self) -> None:
        assert self.state is not None
        self._ensure_directory()
        self._directory.export(self.state.scene, self.state.step)
        self._directory.write_trained_cameras(self._dataset, self.state.scene)


def initial_state(recipe: Any, settings: run_directory.RunSettings, dataset: Dataset) -> TrainState:
    """The initial state of a new run."""
    return TrainState(recipe.initialise(dataset), settings.seed, method=recipe.method).to(settings.device)


def resumed_state(
    recipe: Any, settings: run_directory.RunSettings, directory: run_directory.RunDirectory, dataset: Dataset
) -> TrainState:
    """The state of the checkpoint.

    Raises:
        InputError: settings or photographs differ from the recorded ones, or there is no checkpoint.
    """
    directory.check_saved()
    # A run may be resumed on another device, and its capture may have moved.
    written = directory.settings()
    has_moved = written.data != settings.data and directory.has_cameras_of(dataset)
    data = settings.data if has_moved else written.data
    photographs, masks = settings.photographs, settings.masks
    recorded = replace(written, device=settings.device, data=data, photographs=photographs, masks=masks)
    # Compared as written: `recipe()` gives what an earlier version did not have its present default.
    if recorded != settings or directory.recipe_as_written() != json.loads(recipe_to_json(recipe)):
        changes = option_changes(vars(recorded), vars(settings)) + recipe_changes(directory, recipe)
        original = [
            f"--{name.replace('_', '-')} {quote(str(getattr(recorded, name)))}"
            for name in differing_options(vars(recorded), vars(settings))
        ]
        original.append(f"--config {quote(str(directory.path / 'recipe.json'))}")  # It has the options of the method.
        raise InputError(
            f"{directory.path} was started with other options: {join_names(changes)}; expected the same to resume it. "
            f"Repeat the original options by {' '.join(original)}, or choose another --output"
        )
    directory.check_photographs(dataset)
    for what, begun, now, differs in (
        ("photographs", written.photographs, run_directory.photographs_checksum(dataset), "have other sizes"),
        ("masks", written.masks, run_directory.masks_checksum(dataset), "differ"),
    ):
        if begun not in ("", now):
            log.warning(
                "%s of %s have changed since this run began (their files %s); if they look different, train again",
                what,
                dataset.root,
                differs,
            )
    state = load_checkpoint(
        directory.checkpoint, method=recipe.method, seed=settings.seed, iterations=settings.iterations
    )
    if has_moved:
        directory.write_settings(replace(written, data=settings.data))
    known = state.scene.planes.labels
    if known and (later := [label for label in dataset.pane_labels if label not in known]):
        log.warning(
            "the planes of this run were fitted before pane %s was marked: it is learned like everything else; train "
            "again to make it a pane",
            name_labels(later),
        )
    return state.to(settings.device)


def shared_settings(recipe: Any, settings: run_directory.RunSettings, dataset: Dataset) -> dict[str, object]:
    """Options, versions and capture of a run, which must agree on all ranks; only the folder may differ."""
    views = (*dataset.train, *dataset.test)
    shapes = [(v.name, v.camera.intrinsics.tolist(), v.camera.cam_from_world.tolist(), v.is_annotated) for v in views]
    sizes = run_directory.photographs_checksum(dataset)
    contents = zlib.crc32(repr((shapes, sizes)).encode(), zlib.crc32(dataset.points.positions.numpy().tobytes()))
    of_settings = {name: value for name, value in vars(settings).items() if name not in ("data", "device")}
    return {
        "version": __version__,
        "version of PyTorch": torch.__version__,
        "capture": f"{len(views)} photographs and {len(dataset.points)} points ({contents:08x})",
        "device": settings.device.partition(":")[0],
        "method": recipe.method,
        **of_settings,
        **dict(_flatten_options(json.loads(recipe_to_json(recipe)), "")),
    }


def recipe_changes(directory: run_directory.RunDirectory, recipe: Any) -> list[str]:
    """The options of a recipe that differ from the recorded ones."""
    recorded = directory.recipe()
    if recorded.method != recipe.method:  # Options of different methods are not comparable.
        return option_changes({"method": recorded.method}, {"method": recipe.method})
    of_both = directory.recipe_as_written(), json.loads(recipe_to_json(recipe))
    kind = type(recorded).__name__
    return option_changes(*({"recipe": kind, **dict(_flatten_options(options, ""))} for options in of_both))


def differing_options(before: Mapping[str, object], now: Mapping[str, object]) -> list[str]:
    """Names of the options whose values differ."""
    return [name for name in dict.fromkeys((*before, *now)) if before.get(name, UNKNOWN) != now.get(name, UNKNOWN)]


def option_changes(before: Mapping[str, object], now: Mapping[str, object]) -> list[str]:
    """The differing options, each with both values."""
    return [
        f"{name} was {before.get(name, UNKNOWN)} and is {now.get(name, UNKNOWN)}"
        for name in differing_options(before, now)
    ]


def _flatten_options(options: Any, name: str) -> Iterator[tuple[str, object]]:
    """All values of nested options by dotted name."""
    if isinstance(options, dict):
        for key, inner in options.items():
            yield from _flatten_options(inner, f"{name}.{key}" if name else key)
    else:
        yield name, options


UNKNOWN = "unknown"
"""Shown for options that a version does not have."""


class OutputFiles(NamedTuple):
    """Files that the leader writes during training: checkpoints at intervals, and the log.

    Before a checkpoint, `ensure_directory` sees to it that its directory is that of a run.
    """

    checkpoint: Path
    log: run_directory.RunLog
    every: float
    ensure_directory: Callable[[], None] = lambda: None


class TrainingSession:
    """One session of a run: from its start or a checkpoint to its end or an interrupt."""

    def __init__(self, state: TrainState, ranks: Ranks, files: OutputFiles | None = None) -> None:
        self._state, self._ranks, self._files = state, ranks, files
        self._seconds_before, self._started = state.seconds, time.perf_counter()
        self._compiled_before = compile_seconds()
        self._last_save_time = self._started
        self._last_step_time: float | None = None  # The first step may compile kernels, and is not representative.
        self._longest_step = self._save_seconds = 0.0
        self._stop = StopRequest()

    def run_stages(
        self, stages: tuple[Stage, ...], dataset: Dataset, iterations: int
    ) -> Generator[Message, None, None]:
        """Trains to the end, or raises KeyboardInterrupt after the step of a stop request."""
        with stop_on_interrupt() as self._stop, read_photographs_in_background(dataset) as check_photographs:
            self._ranks.is_stop_requested = lambda: self._stop.requested
            messages = train(stages, dataset, self._state, iterations, ranks=self._ranks)
            starts = zip(stages, stage_starts(stages, iterations), strict=False)
            setups = {start for stage, start in starts if stage.setup is not None}
            for message in self._save_on_failure(messages, check_photographs):
                yield from self.deliver(message)
                if isinstance(message, StepDone):
                    yield from self._save_if_due(message, iterations, setups)

    def _save_on_failure(self, messages: Iterator[Message], check: Callable[[], None]) -> Iterator[Message]:
        """Forwards messages; if a rank is lost or a photograph cannot be read, it saves first."""
        begun = self._state.step
        try:
            for message in messages:
                check()
                yield message
        except (RankLostError, InputError, OSError) as error:
            if not self._state.is_consistent or self._state.step == begun:
                raise
            self.save()
            if not isinstance(error, InputError):
                raise
            step = self._state.step
            raise InputError(f"{error}; step {step} is saved; fix that, then repeat with --resume") from error

    def _save_if_due(
        self, message: StepDone, iterations: int, setups: Container[int] = ()
    ) -> Generator[Message, None, None]:
        """Writes a checkpoint if one is due, and ends training if a stop was requested.

        One is also due before a setup, which may fail, for example because of masks.
        """
        is_last, is_ending = message.step == iterations, self._ranks.is_ending
        is_due = self._files is not None and (message.step in setups or self._is_checkpoint_due(self._files.every))
        if is_ending or is_last or is_due:
            self.save()
            yield from self.deliver(CheckpointWritten(message.step))
        if is_ending and not is_last:
            self._stop.end()
        self._last_step_time = time.perf_counter()

    def _is_checkpoint_due(self, every: float) -> bool:
        """Return whether a checkpoint after the next step would exceed the interval.

        The next step is assumed to take as long as the longest one so far, and the checkpoint as long as the last one;
        together at most half of the interval, so that checkpoints are at most twice as frequent.
        """
        now = time.perf_counter()
        if self._last_step_time is not None:
            self._longest_step = max(self._longest_step, now - self._last_step_time)
        return now - self._last_save_time + min(self._longest_step + self._save_seconds, every / 2) >= every

    def deliver(self, message: Message) -> Generator[Message, None, None]:
        """Forwards a message; if the consumer stops iterating, the state is saved first."""
        try:
            if self._files is not None:
                self._files.log.write(message)
            yield message
        except BaseException as error:
            if isinstance(message, StageEntered | StepDone | ActionDone):
                self.save()
            if self._stop.requested and isinstance(error, OSError):
                self._stop.end()  # A closed terminal is not a failure.
            raise

    @property
    def is_stopping(self) -> bool:
        """Return whether a signal requested the end."""
        return self._stop.requested

    def save(self) -> None:
        """Writes a checkpoint if this process is the leader; the state must be consistent."""
        self._last_save_time = time.perf_counter()  # Before writing, as later steps are not in it.
        compiling = compile_seconds() - self._compiled_before
        self._state.seconds = self._seconds_before + self._last_save_time - self._started - compiling
        if self._files is not None:
            self._files.ensure_directory()
            save_checkpoint(self._files.checkpoint, self._state)
        self._save_seconds = time.perf_counter() - self._last_save_time


class Training:
    """A training run: iterating over it trains from one message to the next.

        for message in glassplat.Training(dataset, "planar", iterations=7000, output="runs/shop"):
            match message:
                case glassplat.StepDone(step=step, loss=loss):
                    print(step, loss)

    Under `torchrun`, several processes train together, each with one view per step. Between two messages, after the
    first `StageEntered`, `model` is the current scene. With an `output`, the run is written as by `glassplat train`;
    after `break` or Ctrl-C, `resume=True` continues it. Without `output`, everything stays in memory, and a `break`
    at a `Working` message loses the edit in progress.

    Attributes:
        recipe: method and options, with the background of the photographs.
        iterations: length of the run.
    """

    def __init__(
        self,
        dataset: Dataset,
        recipe: str | MethodRecipe = "planar",
        *,
        iterations: int = 30_000,
        output: str | os.PathLike[str] | None = None,
        seed: int = 0,
        device: DeviceName = "auto",
        resume: bool = False,
        checkpoint_every: float = run_directory.CHECKPOINT_SECONDS,
    ) -> None:
        """Checks the arguments; nothing is trained or written yet.

        Args:
            dataset: photographs to fit.
            recipe: name of a method, for its default options; or a recipe, such as `PlanarRecipe(fresnel="schlick")` or
                a custom one.
            iterations: length of the run; all schedules scale with it.
            output: directory of the run.
            seed: random seed.
            device: training device; `auto` uses an NVIDIA GPU if available.
            resume: continue the run in `output`.
            checkpoint_every: seconds between checkpoints; one is always written at the end.

        Raises:
            CudaUnavailableError: a GPU was requested, but cannot be used.
            InputError: `dataset` is not a data set or has no training views; the method is unknown; an option is
                invalid; `output` holds something else, or nothing to resume; the run is too short for its stages; or
                the photographs have a different background than the recipe.
        """
        check_dataset(dataset)
        if not dataset.train:
            raise InputError(f"{dataset.root} has no training views; expected one or more in `dataset.train`")
        chosen = chosen_recipe(recipe)
        if type(chosen) in RECIPES.values():  # A custom recipe may hold anything.
            check_value(type(chosen), chosen, "")
        self._ranks = join_ranks()
        root = str(dataset.root.resolve())  # Later commands may be started in another folder.
        self.iterations, self._dataset = iterations, dataset
        self._settings = run_directory.RunSettings(
            root, iterations, dataset.downscale, seed, str(chosen_device(device)), dataset.mask_polarity
        )
        check_value(run_directory.RunSettings, self._settings, "")
        self._run: Run | None = None
        self._state: TrainState | None = None
        if output is None:
            if resume:
                raise InputError("resume=True needs the output of the run to continue")
            self.recipe: Any = resolve_background(chosen, dataset)
            self._stages = self.recipe.stages(seed, iterations)
            check_length(self._stages, iterations)
            return
        self._run = Run(
            chosen,
            self._settings,
            run_directory.RunDirectory(Path(output)),
            dataset,
            resume=resume,
            checkpoint_every=checkpoint_every,
            ranks=self._ranks,
        )
        self.recipe = self._run.recipe

    def __iter__(self) -> Generator[Message, None, None]:
        """Trains to the end, from one message to the next.

        Raises:
            InputError: a photograph cannot be read, or the run in `output` has other options.
            KeyboardInterrupt: the user stopped the run.
            TrainingDivergedError: training diverged.
            OSError: the disk is full or fails.
            RankLostError: another process of `torchrun` has ended.
        """
        return with_gradients(self._in_memory()) if self._run is None else self._run.messages()

    def run(self, listen: Listener | None = None) -> Model:
        """Trains to the end; returns the trained model.

        Args:
            listen: receives every message; its exceptions end the run after saving.
        """
        listen = listen or (lambda message: None)
        if self._run is not None:
            self._run.run_to_end(listen)
        else:
            for message in self:
                listen(message)
        return self.model

    @property
    def state(self) -> TrainState:
        """The mutable state of training: scene, optimiser, statistics.

        Raises:
            RuntimeError: the initial scene does not exist yet.
        """
        state = self._state if self._run is None else self._run.state
        if state is None:
            raise RuntimeError("the run has not started; iterate over it first, at least to `StageEntered`")
        return state

    @property
    def step(self) -> int:
        """Iterations done; 0 before the run starts."""
        state = self._state if self._run is None else self._run.state
        return 0 if state is None else state.step

    @property
    def seconds(self) -> float:
        """Training time over all sessions, up to the last checkpoint, without compilation of kernels."""
        return self.state.seconds

    @property
    def is_stopping(self) -> bool:
        """Return whether a stop after the step was requested, as by Ctrl-C."""
        return self._run is not None and self._run.is_stopping

    @property
    def model(self) -> Model:
        """The current scene; its tensors keep changing, so `save` it, or clone the tensors to keep.

        Its cameras have the current refined poses, if poses are refined.

        Raises:
            RuntimeError: the initial scene does not exist yet.
        """
        seen = with_corrected_cameras(self._dataset, self.state.scene)
        cameras = {view.name: view.camera for view in (*seen.train, *seen.test)}
        return Model(self.state.scene, self.recipe, cameras, self._dataset.root.name)

    def save(self) -> None:
        """Writes a checkpoint and the scene to `output` now; between two messages, after the first `StageEntered`.

        Of several processes, only the first one writes.

        Raises:
            RuntimeError: there is no `output`, or the run has not started.
        """
        if self._run is None:
            raise RuntimeError("this training has no output to save to; use `training.model.save(path)`")
        self._run.save()

    def _in_memory(self) -> Generator[Message, None, None]:
        self._ranks.check_equal(shared_settings(self.recipe, self._settings, self._dataset))
        if self._state is None:
            yield Working("preparing the first scene", 0, 1)
            first = initial_state(self.recipe, self._settings, self._dataset) if self._ranks.is_leader else None
            self._state = self._ranks.broadcast(first, self._settings.device)
        yield from train(self._stages, self._dataset, self._state, self.iterations, ranks=self._ranks)


def chosen_recipe(recipe: str | MethodRecipe) -> Any:
    """The recipe itself, or the default one of a method's name.

    Raises:
        InputError: the method is unknown, or the object is not a recipe.
    """
    given: Any = recipe
    if isinstance(given, str):
        if given not in RECIPES:
            raise InputError(f"there is no method {given!r}; expected {', '.join(RECIPES)}, or a recipe")
        return RECIPES[given]()
    if isinstance(given, type) or not dataclasses.is_dataclass(given) or not hasattr(given, "stages"):
        raise InputError(f"recipe is {short_repr(given)}; expected a method's name, or a recipe such as SplatRecipe()")
    return given
