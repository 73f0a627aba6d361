"""Training runs: data in, run directory out, with checkpoints, a log and a clean stop."""

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
from types import FrameType
from typing import Any, NamedTuple, NoReturn

import torch

from glassplat import __version__
from glassplat.captures.dataset import Dataset, check_dataset, photographs_read, with_corrected_cameras
from glassplat.errors import InputError, RankLostError, first_names
from glassplat.files.writing import make_folder
from glassplat.kernels.backend.devices import DeviceName, chosen_device, compile_seconds
from glassplat.methods.recipe import RECIPES, Recipe, recipe_to_json, resolve_background
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
from glassplat.training.ranks import Ranks, join
from glassplat.training.stage import Stage, TrainState, check_length, stage_starts

log = logging.getLogger("glassplat.training")

Listener = Callable[[Message], None]
STOP_SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Ctrl-C, what a shut-down or a job scheduler sends before it kills, and what a closed terminal leaves behind."""


@dataclass(eq=False)
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
        """Return whether the run is to stop."""
        return self.number is not None

    def end(self) -> NoReturn:
        """Ends the run as the signal would have ended it, so that the caller can tell one from the other."""
        if callable(self.answer) and self.number is not None:
            self.answer(self.number, None)
        raise KeyboardInterrupt


_asked: list[StopRequest] = []
"""Of the runs that go on in the main thread; there may be several, followed by turns."""
_before: dict[int, Any] = {}
"""Handlers of the signals as they were before these runs."""


@contextmanager
def stop_on_interrupt() -> Iterator[StopRequest]:
    """Turns the first Ctrl-C, termination or hang-up into a request to stop after the step; a second one interrupts.

    What is ignored stays ignored, as a hang-up is under `nohup`. Only the main thread can be asked.
    """
    request = StopRequest()
    if threading.current_thread() is threading.main_thread():
        _asked.append(request)
        for number in STOP_SIGNALS:
            if (handler := signal.getsignal(number)) not in (None, signal.SIG_IGN, _ask):
                _before[number] = handler
                signal.signal(number, _ask)
    try:
        yield request
    finally:
        if request in _asked:
            _asked.remove(request)
        if not _asked and threading.current_thread() is threading.main_thread():
            _put_handlers_back()


def _ask(number: int, frame: FrameType | None) -> None:
    """Asks all runs to stop; once they have been asked, interrupts.

    `torchrun` passes on what a scheduler may have sent already; there, a second signal says nothing new.
    """
    if not _asked:  # The last run ended in another thread, where handlers cannot be set.
        is_own = signal.getsignal(number) is _ask
        _put_handlers_back()
        if is_own:
            signal.raise_signal(number)
    elif not all(request.requested for request in _asked):
        for request in _asked:
            request.number, request.answer = number, _before[number]
    elif "TORCHELASTIC_RUN_ID" not in os.environ:  # It is set where `torchrun` has started a single process, too.
        _asked[-1].end()


def _put_handlers_back() -> None:
    for number, handler in _before.items():
        if signal.getsignal(number) is _ask:
            signal.signal(number, handler)


def with_gradients(messages: Generator[Message, None, None]) -> Generator[Message, None, None]:
    """Passes messages on, made where gradients are switched on; between them that is as the caller has it.

    PyTorch's own decorators of generators throw in a way that Python is about to give up.
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
        except BaseException as error:  # noqa: BLE001 - It is the messages' to answer.
            following = partial(messages.throw, error)
        else:
            following = partial(next, messages)


class Run:
    """A training run in its directory, followed message by message.

    A recipe that names no background gets the one that transparent photographs are laid over; it is recorded. Nothing
    is written before the first scene has been made. Who stops following leaves a checkpoint behind, from which the run
    can be resumed. Of several ranks the first one makes the scene and writes; the others train along.
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
        """Checks what can be known beforehand.

        Args:
            recipe: how to train.
            settings: the other settings.
            directory: where everything goes.
            dataset: photographs to fit.
            resume: go on from the checkpoint in `directory`.
            checkpoint_every: seconds from one checkpoint to the next; there is one at the end in any case.
            ranks: the processes that train together; this one alone if not given.

        Raises:
            InputError: the directory is not fit for it (`check_output`), the run is too short for its stages, or as
                `resolve_background` does.
        """
        self.recipe = resolve_background(recipe, dataset)
        self._stages = self.recipe.stages(settings.seed, settings.iterations)
        check_length(self._stages, settings.iterations)
        run_directory.check_output(directory, resume=resume)
        self._settings, self._directory, self._dataset = settings, directory, dataset
        self._resume, self._every = resume, checkpoint_every
        self._ranks = ranks or Ranks()
        self._session: TrainingSession | None = None
        self.state: TrainState | None = None

    def to_the_end(self, listen: Listener) -> TrainState:
        """Trains to the end or to the user's interrupt; raises what `listen` raises, once all is saved."""
        messages = self.messages()
        for message in messages:
            try:
                listen(message)
            except BaseException as error:  # noqa: BLE001 - The run saves itself, and raises it again.
                messages.throw(error)
        assert self.state is not None
        return self.state

    def messages(self) -> Generator[Message, None, None]:
        """Trains from one message to the next; begun again after it ended, from the checkpoint on.

        Raises:
            InputError: the run was recorded with other settings or photographs, or a photograph cannot be read, of the
                test views too; what was trained by then is saved.
            KeyboardInterrupt: the user stopped the run; the checkpoint is written.
            TrainingDivergedError: training cannot go on; the last checkpoint stays.
            OSError: the disk is full or fails; the last checkpoint stays.
            RankLostError: another rank has ended; the checkpoint is written.
        """
        return with_gradients(self._messages())

    def _messages(self) -> Generator[Message, None, None]:
        self._ranks.check_alike(traits(self.recipe, self._settings, self._dataset) | {"resume": self._resume})
        yield from self._leading() if self._ranks.leads else self._following()
        self._ranks.exchange()  # The others stay until the leader has written the scene.

    def _following(self) -> Generator[Message, None, None]:
        """Trains along, and writes nothing."""
        self.state = self._ranks.broadcast(self.state, self._settings.device)
        self._session = TrainingSession(self.state, self._ranks)
        with self._dataset.memory.spool_to(self._directory.path):
            yield from self._session.run_stages(self._stages, self._dataset, self._settings.iterations)

    def _leading(self) -> Generator[Message, None, None]:
        directory, settings = self._directory, self._settings
        resume = self._resume or (self.state is not None and directory.checkpoint.is_file())
        state = None
        if not resume:
            yield Working("preparing the first scene", 0, 1)
            state = first_state(self.recipe, settings, self._dataset)
        make_folder(directory.path)
        with run_directory.run_lock(directory.path):
            directory.clear()
            # Another training may have ended here meanwhile.
            anew = directory.is_begun and not resume
            if state is None:
                state = resumed_state(self.recipe, settings, directory, self._dataset)
            else:
                directory.check_vacant()
                directory.begin(self.recipe, settings, self._dataset)
            self.state = self._ranks.broadcast(state, settings.device)
            with run_directory.open_log(directory.log, self.state.step) as log:
                record = Record(directory.checkpoint, log, self._every, self._restore)
                self._session = TrainingSession(self.state, self._ranks, record)
                yield from self._session.deliver(RunBegun(self.state.step, settings.iterations, anew))
                with self._dataset.memory.spool_to(directory.path):
                    yield from self._session.run_stages(self._stages, self._dataset, settings.iterations)
            self._export()

    @property
    def is_stopping(self) -> bool:
        """Return whether the user has asked the run to end; it does after the step."""
        return self._session is not None and self._session.is_stopping

    def save(self) -> None:
        """Writes a checkpoint and the scene, between two messages of which the last one is `StageEntered` or later.

        Of several ranks the first one writes, and the others do nothing.

        Raises:
            RuntimeError: the run has not begun.
            OSError: the disk is full or fails.
        """
        if self._session is None or self.state is None:
            raise RuntimeError("nothing to save: the run has not begun")
        self._session.save()
        if self._ranks.leads:
            self._export()

    def _restore(self) -> None:
        """Records again what is run where the directory was removed or renamed meanwhile, so that it is a run's."""
        if not (self._directory.path / "recipe.json").is_file():
            self._directory.begin(self.recipe, self._settings, self._dataset)

    def _export(self) -> None:
        assert self.state is not None
        self._restore()
        self._directory.export(self.state.scene, self.state.step)
        self._directory.write_trained_cameras(self._dataset, self.state.scene)


def first_state(recipe: Any, settings: run_directory.RunSettings, dataset: Dataset) -> TrainState:
    """The state from which a fresh run starts."""
    return TrainState(recipe.initialise(dataset), settings.seed, method=recipe.method).to(settings.device)


def resumed_state(
    recipe: Any, settings: run_directory.RunSettings, directory: run_directory.RunDirectory, dataset: Dataset
) -> TrainState:
    """The checkpoint's state.

    Raises:
        InputError: the run was recorded with other settings or photographs, or nothing is saved.
    """
    directory.check_saved()
    # A run may go on on another device, and its capture may have been moved.
    written = directory.settings()
    has_moved = written.data != settings.data and directory.has_cameras_of(dataset)
    recorded = replace(written, device=settings.device, data=settings.data if has_moved else written.data)
    # Compared as written: `recipe()` gives what an earlier version did not have its present default.
    if recorded != settings or directory.written_recipe() != json.loads(recipe_to_json(recipe)):
        changes = differences(vars(recorded), vars(settings)) + changes_of_recipe(directory, recipe)
        raise InputError(
            f"{directory.path} was started with other options: {first_names(changes)}; expected the same to resume it. "
            "Repeat the original options, with the version of glassplat that began it, or choose another --output"
        )
    directory.check_photographs(dataset)
    state = load_checkpoint(
        directory.checkpoint, method=recipe.method, seed=settings.seed, iterations=settings.iterations
    )
    if has_moved:
        directory.write_settings(replace(written, data=settings.data))
    known = state.scene.planes.labels
    if known and (later := [label for label in dataset.pane_labels if label not in known]):
        log.warning(
            "the planes of this run were fitted before pane %s was marked: it is learned like all else; to have it as "
            "a pane, train again",
            name_labels(later),
        )
    return state.to(settings.device)


def traits(recipe: Any, settings: run_directory.RunSettings, dataset: Dataset) -> dict[str, object]:
    """The options, versions and capture of a run, which must be the same on every rank; only its folder may differ."""
    views = (*dataset.train, *dataset.test)
    shapes = [(v.name, v.camera.intrinsics.tolist(), v.camera.cam_from_world.tolist(), v.is_annotated) for v in views]
    sizes = [view.image_path.stat().st_size if view.image_path.is_file() else 0 for view in views]
    contents = zlib.crc32(repr((shapes, sizes)).encode(), zlib.crc32(dataset.points.positions.numpy().tobytes()))
    of_settings = {name: value for name, value in vars(settings).items() if name not in ("data", "device")}
    return {
        "version": __version__,
        "version of PyTorch": torch.__version__,
        "capture": f"{len(views)} photographs and {len(dataset.points)} points ({contents:08x})",
        "device": settings.device.partition(":")[0],
        "method": recipe.method,
        **of_settings,
        **dict(_values(json.loads(recipe_to_json(recipe)), "")),
    }


def changes_of_recipe(directory: run_directory.RunDirectory, recipe: Any) -> list[str]:
    """The options of a recipe that differ from those that a run was begun with, as they were written."""
    recorded = directory.recipe()
    if recorded.method != recipe.method:  # The options of two methods have little in common.
        return differences({"method": recorded.method}, {"method": recipe.method})
    of_both = directory.written_recipe(), json.loads(recipe_to_json(recipe))
    kind = type(recorded).__name__
    return differences(*({"recipe": kind, **dict(_values(options, ""))} for options in of_both))


def differences(before: Mapping[str, object], now: Mapping[str, object]) -> list[str]:
    """The options that differ, each with both values."""
    names = [name for name in dict.fromkeys((*before, *now)) if before.get(name, UNKNOWN) != now.get(name, UNKNOWN)]
    return [f"{name} was {before.get(name, UNKNOWN)} and is {now.get(name, UNKNOWN)}" for name in names]


def _values(options: Any, name: str) -> Iterator[tuple[str, object]]:
    """Every value of nested options by its dotted name."""
    if isinstance(options, dict):
        for key, inner in options.items():
            yield from _values(inner, f"{name}.{key}" if name else key)
    else:
        yield name, options


UNKNOWN = "unknown"
"""Said of an option that a version does not have."""


class Record(NamedTuple):
    """Files that the leader writes while it trains: a checkpoint every so many seconds, and the log.

    Before a checkpoint, `restore` sees to it that its directory is that of a run.
    """

    checkpoint: Path
    log: run_directory.RunLog
    every: float
    restore: Callable[[], None] = lambda: None


class TrainingSession:
    """One stretch of a run: from its beginning or a checkpoint to its end or an interrupt."""

    def __init__(self, state: TrainState, ranks: Ranks, record: Record | None = None) -> None:
        self._state, self._ranks, self._record = state, ranks, record
        self._seconds_before, self._started = state.seconds, time.perf_counter()
        self._compiled_before = compile_seconds()
        self._saved = self._started
        self._stepped: float | None = None  # The first step may compile kernels, and says nothing of the next.
        self._longest = self._writing = 0.0
        self._stop = StopRequest()

    def run_stages(
        self, stages: tuple[Stage, ...], dataset: Dataset, iterations: int
    ) -> Generator[Message, None, None]:
        """Trains to the end, or raises KeyboardInterrupt after the step in which the user asks for it."""
        with stop_on_interrupt() as self._stop, photographs_read(dataset) as check_photographs:
            self._ranks.asked = lambda: self._stop.requested
            messages = train(stages, dataset, self._state, iterations, ranks=self._ranks)
            starts = zip(stages, stage_starts(stages, iterations), strict=False)
            setups = {start for stage, start in starts if stage.setup is not None}
            for message in self._saved_where_it_fails(messages, check_photographs):
                yield from self.deliver(message)
                if isinstance(message, StepDone):
                    yield from self._saved_in_time(message, iterations, setups)

    def _saved_where_it_fails(self, messages: Iterator[Message], check: Callable[[], None]) -> Iterator[Message]:
        """Passes messages on; where a rank is lost, or a photograph cannot be read or is gone, it saves first."""
        begun = self._state.step
        try:
            for message in messages:
                check()
                yield message
        except (RankLostError, InputError, OSError) as error:
            if not self._state.is_whole or self._state.step == begun:
                raise
            self.save()
            if not isinstance(error, InputError):
                raise
            step = self._state.step
            raise InputError(f"{error}; step {step} is saved; mend that, then repeat with --resume") from error

    def _saved_in_time(
        self, message: StepDone, iterations: int, setups: Container[int] = ()
    ) -> Generator[Message, None, None]:
        """Writes a checkpoint where it is time for one, and ends training where it was asked to end.

        It is time before a setup, too, at whichever of these steps: a setup may refuse what it is given, such as masks.
        """
        is_last, is_ending = message.step == iterations, self._ranks.is_ending
        is_time = self._record is not None and (message.step in setups or self._is_time(self._record.every))
        if is_ending or is_last or is_time:
            self.save()
            yield from self.deliver(CheckpointWritten(message.step))
        if is_ending and not is_last:
            self._stop.end()
        self._stepped = time.perf_counter()

    def _is_time(self, every: float) -> bool:
        """Return whether a checkpoint that is written after the next step would come later than every so many seconds.

        The longest step so far is expected, with what is edited before it, and the time that the last checkpoint took;
        both together no longer than half of the time, so that checkpoints become twice as frequent at most.
        """
        now = time.perf_counter()
        if self._stepped is not None:
            self._longest = max(self._longest, now - self._stepped)
        return now - self._saved + min(self._longest + self._writing, every / 2) >= every

    def deliver(self, message: Message) -> Generator[Message, None, None]:
        """Passes a message on; should nobody be there any more to hear it, what was trained is saved first."""
        try:
            if self._record is not None:
                self._record.log.write(message)
            yield message
        except BaseException as error:
            if isinstance(message, StageEntered | StepDone | ActionDone):
                self.save()
            if self._stop.requested and isinstance(error, OSError):
                self._stop.end()  # A terminal that was closed can show nothing, and that is no failure.
            raise

    @property
    def is_stopping(self) -> bool:
        """Return whether a signal asked for the end."""
        return self._stop.requested

    def save(self) -> None:
        """Writes a checkpoint, if this process is to; the state must not be in the middle of a change."""
        self._saved = time.perf_counter()  # Before it is written: what is trained from now on is not in it.
        compiling = compile_seconds() - self._compiled_before
        self._state.seconds = self._seconds_before + self._saved - self._started - compiling
        if self._record is not None:
            self._record.restore()
            save_checkpoint(self._record.checkpoint, self._state)
        self._writing = time.perf_counter() - self._saved


class Training:
    """A training run: iterate over it, and it trains from one message to the next.

        for message in glassplat.Training(dataset, "planar", iterations=7000, output="runs/shop"):
            match message:
                case glassplat.StepDone(step=step, loss=loss):
                    print(step, loss)

    Started by `torchrun`, several processes train together, one view of each step for each.
    Between two messages, from the first `StepDone` on, `model` is the scene as trained so far. With an `output` the run
    is written as `glassplat train` writes it, `for` may be left with `break`, Ctrl-C ends it after a step, and either
    way `resume=True` goes on. Without one, everything stays in memory, and a `break` at a `Working` message loses the
    edit that it tells of.

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
        checkpoint_every: float = run_directory.CHECKPOINT_SECONDS,
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
            InputError: `dataset` is something else, or has no training views; no method has that name; an option has a
                value that it cannot have; `output` holds something else, or nothing to go on from; the run is too short
                for its stages; or the photographs lie over another background than the recipe's.
        """
        check_dataset(dataset)
        if not dataset.train:
            raise InputError(f"{dataset.root} has no training views; expected one or more in `dataset.train`")
        chosen = chosen_recipe(recipe)
        if type(chosen) in RECIPES.values():  # A recipe of one's own may hold anything.
            check_value(type(chosen), chosen, "")
        self._ranks = join()
        root = str(dataset.root.resolve())  # The run may be looked at from another folder than it was started in.
        self.iterations, self._dataset = iterations, dataset
        self._settings = run_directory.RunSettings(
            root, iterations, dataset.downscale, seed, str(chosen_device(device)), dataset.mask_polarity
        )
        check_value(run_directory.RunSettings, self._settings, "")
        self._run: Run | None = None
        self._state: TrainState | None = None
        if output is None:
            if resume:
                raise InputError("resume=True needs the output that it is to go on with")
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
        """Trains from one message to the next, to the end.

        Raises:
            InputError: a photograph cannot be read; or the run in `output` was recorded with other options.
            KeyboardInterrupt: the user stopped the run.
            TrainingDivergedError: training cannot go on.
            OSError: the disk is full or fails.
            RankLostError: another process that `torchrun` started has ended.
        """
        return with_gradients(self._in_memory()) if self._run is None else self._run.messages()

    def run(self, listen: Listener | None = None) -> Model:
        """Trains to the end; returns the trained model.

        Args:
            listen: gets every message; what it raises ends the run, once what was trained is saved.
        """
        if self._run is not None:
            self._run.to_the_end(listen or _nobody)
        else:
            for message in self:
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
        """Time spent training, over all sessions, up to the last checkpoint; without compiling kernels."""
        return self.state.seconds

    @property
    def is_stopping(self) -> bool:
        """Return whether the user has asked the run to end, as with Ctrl-C; it does after the step."""
        return self._run is not None and self._run.is_stopping

    @property
    def model(self) -> Model:
        """The scene as trained so far; its tensors go on changing, so `save` it, or clone what has to stay.

        Its cameras are where training has found them by now, if it looks for them.

        Raises:
            RuntimeError: the first scene has not been made yet.
        """
        seen = with_corrected_cameras(self._dataset, self.state.scene)
        cameras = {view.name: view.camera for view in (*seen.train, *seen.test)}
        return Model(self.state.scene, self.recipe, cameras, self._dataset.root.name)

    def save(self) -> None:
        """Writes a checkpoint and the scene into `output` now; between two messages, from the first `StageEntered` on.

        Of several processes the first one writes, and the others do nothing.

        Raises:
            RuntimeError: there is no `output`, or the run has not begun.
        """
        if self._run is None:
            raise RuntimeError("this training has no output to save to; use `training.model.save(path)`")
        self._run.save()

    def _in_memory(self) -> Generator[Message, None, None]:
        self._ranks.check_alike(traits(self.recipe, self._settings, self._dataset))
        if self._state is None:
            yield Working("preparing the first scene", 0, 1)
            first = first_state(self.recipe, self._settings, self._dataset) if self._ranks.leads else None
            self._state = self._ranks.broadcast(first, self._settings.device)
        yield from train(self._stages, self._dataset, self._state, self.iterations, ranks=self._ranks)


def chosen_recipe(recipe: str | Recipe) -> Any:
    """The recipe, or that of a method's name.

    Raises:
        InputError: no method has that name, or it is no recipe.
    """
    given: Any = recipe
    if isinstance(given, str):
        if given not in RECIPES:
            raise InputError(f"no method is called {given!r}; expected {', '.join(RECIPES)}, or a recipe")
        return RECIPES[given]()
    if isinstance(given, type) or not dataclasses.is_dataclass(given) or not hasattr(given, "stages"):
        raise InputError(f"recipe is {short_repr(given)}; expected a method's name, or a recipe such as SplatRecipe()")
    return given


def _nobody(message: Message) -> None:
    """Listens to nothing."""
