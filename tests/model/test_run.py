"""A whole run: interrupted, resumed, and its output files."""

from __future__ import annotations

import errno
import json
import math
import os
import resource
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from glassplat.captures.dataset import load_dataset
from glassplat.captures.view import PixelCache, View
from glassplat.errors import InputError
from glassplat.files import writing
from glassplat.methods.glossy_recipes import DeferredRecipe
from glassplat.methods.planar_recipe import PlanarRecipe, ReflectionWeights
from glassplat.methods.recipe import recipe_from_json, recipe_to_json
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model import training
from glassplat.model.run_directory import CHECKPOINT_SECONDS, RunDirectory, RunSettings, masks_checksum
from glassplat.model.training import OutputFiles, Run, TrainingSession
from glassplat.panes import PlaneFitError
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene
from glassplat.training.checkpoint import load_checkpoint, read_progress, save_checkpoint
from glassplat.training.messages import CheckpointWritten, Message, RunBegun, StepDone, Working
from glassplat.training.ranks import Ranks
from glassplat.training.stage import Clock, TrainState
from tests.training.rank_process import LONGEST, forked
from tests.training.tiny_capture import tiny_capture, true_scene, write_tiny_capture

SETTINGS = RunSettings("tiny", iterations=12)
RECIPE = SplatRecipe(sh_degree=1)


def run(
    path: Path,
    *,
    resume: bool = False,
    interrupt_at: int | None = None,
    by: signal.Signals = signal.SIGINT,
    heard: list[Message] | None = None,
    checkpoint_every: float = math.inf,
) -> Any:
    def listen(message: Message) -> None:
        if heard is not None:
            heard.append(message)
        if isinstance(message, StepDone) and message.step == interrupt_at:
            signal.raise_signal(by)

    begun = Run(RECIPE, SETTINGS, RunDirectory(path), tiny_capture(), resume=resume, checkpoint_every=checkpoint_every)
    return begun.run_to_end(listen)


@cache
def whole() -> Scene:
    """The result of an uninterrupted run."""
    with TemporaryDirectory() as folder:
        return run(Path(folder) / "run").scene


def killed_at(path: Path, stem: str, suffix: str) -> None:
    """Runs, and kills the process before a file is flushed to the disk."""
    flush = writing._flush_to_disk

    def flushed(written: Path) -> None:
        if written.name.startswith(stem) and written.suffix == suffix:
            os.kill(os.getpid(), signal.SIGKILL)
        flush(written)

    writing._flush_to_disk = flushed
    run(path, checkpoint_every=0)


@pytest.mark.skipif(sys.platform == "win32", reason="no process is killed there")
@pytest.mark.parametrize(("stem", "suffix"), [(".point_cloud.", ".ply"), (".scene.", ".json")])
def test_partial_files_of_a_killed_run_are_removed(tmp_path: Path, stem: str, suffix: str) -> None:
    process = forked(killed_at, tmp_path / "run", stem, suffix)
    process.join(LONGEST)
    assert process.exitcode == -signal.SIGKILL
    scene = tmp_path / "run" / "point_cloud" / "iteration_12"
    assert any(path.name.startswith(stem) for path in scene.iterdir())
    (tmp_path / "run" / ".checkpoint.0123456789ab.tmp.safetensors").touch()
    kept = [tmp_path / "run" / name for name in (".results.0123456789ab.tmp.json", ".mine.ply")]
    for path in kept:
        path.touch()
    run(tmp_path / "run", resume=True)
    assert sorted(path.name for path in scene.iterdir()) == ["point_cloud.ply", "scene.json"]
    assert sorted((tmp_path / "run").glob(".*")) == sorted(kept)


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_run_resumes_to_the_same_scene(tmp_path: Path, by: signal.Signals) -> None:
    before = signal.getsignal(by)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "stopped", interrupt_at=5, by=by)
    assert load_checkpoint(RunDirectory(tmp_path / "stopped").checkpoint).step == 5
    resumed = run(tmp_path / "stopped", resume=True)
    assert_same(whole(), resumed.scene)
    assert signal.getsignal(by) is before


def assert_same(first: Scene, second: Scene) -> None:
    for name, tensor in first.parameters().items():
        assert torch.equal(tensor, second.parameters()[name]), name


def test_an_ignored_sighup_stays_ignored(tmp_path: Path) -> None:
    previous = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert run(tmp_path, interrupt_at=5, by=signal.SIGHUP).step == 12
    finally:
        signal.signal(signal.SIGHUP, previous)


def test_training_works_outside_the_main_thread(tmp_path: Path) -> None:
    states: list[Any] = []
    thread = threading.Thread(target=lambda: states.append(run(tmp_path)))
    thread.start()
    thread.join()
    assert [state.step for state in states] == [12]


@pytest.mark.parametrize("gone", [OSError(errno.EIO, "Input/output error"), SystemExit(1), KeyboardInterrupt()])
@pytest.mark.parametrize("asked", [False, True])
def test_a_failing_listener_loses_no_progress(gone: BaseException, asked: bool, tmp_path: Path) -> None:
    """As when a terminal is closed, or `train | head` has read enough."""

    def listen(message: Message) -> None:
        if isinstance(message, StepDone) and message.step == 7:
            if asked:
                signal.raise_signal(signal.SIGHUP)
            raise gone

    directory = RunDirectory(tmp_path)
    with pytest.raises(KeyboardInterrupt if asked and isinstance(gone, OSError) else type(gone)):
        Run(RECIPE, SETTINGS, directory, tiny_capture(), resume=False).run_to_end(listen)
    assert load_checkpoint(directory.checkpoint).step == 7
    assert_same(run(tmp_path, resume=True).scene, whole())


def test_checkpoints_are_written_by_time_and_reported(tmp_path: Path) -> None:
    often: list[Message] = []
    run(tmp_path / "often", checkpoint_every=1e-9, heard=often)
    assert [m.step for m in often if isinstance(m, CheckpointWritten)] == list(range(1, 13))
    once: list[Message] = []
    run(tmp_path / "once", heard=once)
    assert [m.step for m in once if isinstance(m, CheckpointWritten)] == [12]
    log = RunDirectory(tmp_path / "once").log.read_text()
    assert '"CheckpointWritten"' in log and '"Working"' not in log


def test_checkpoints_are_at_most_two_minutes_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps, the edits between them and writing take time too."""
    now, kept = 0.0, [0.0]

    def write(path: Path, state: Any) -> None:
        nonlocal now
        begun, now = now, now + 9.0
        assert now - kept[-1] <= CHECKPOINT_SECONDS <= 120
        kept.append(begun)

    monkeypatch.setattr(training, "time", SimpleNamespace(perf_counter=lambda: now))
    monkeypatch.setattr(training, "save_checkpoint", write)
    log: Any = SimpleNamespace(write=lambda message: None)
    session = TrainingSession(
        TrainState(true_scene(), 0), Ranks(), OutputFiles(Path("checkpoint"), log, CHECKPOINT_SECONDS)
    )
    for step in range(1, 300):
        now += 31.0 if step % 10 == 0 else 4.0
        list(session._save_if_due(StepDone(step, "a", 0.0, {}, {}), 1000))
    assert len(kept) > 10


def test_the_training_time_excludes_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiler runs once on a machine: if it counted, a first run would look slower than later ones."""
    now, compiling = 10.0, 3.0
    monkeypatch.setattr(training, "time", SimpleNamespace(perf_counter=lambda: now))
    monkeypatch.setattr(training, "compile_seconds", lambda: compiling)
    state = TrainState(true_scene(), 0, seconds=100.0)
    session = TrainingSession(state, Ranks())
    now, compiling = 30.0, 10.0
    session.save()
    assert state.seconds == 100 + 20 - 7


def test_a_resumed_run_reports_its_first_step(tmp_path: Path) -> None:
    heard: list[Message] = []
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, interrupt_at=5, heard=heard)
    assert isinstance(heard[0], Working) and heard[1] == RunBegun(0, 12)
    heard.clear()
    run(tmp_path, resume=True, heard=heard)
    assert heard[0] == RunBegun(5, 12)
    assert min(message.step for message in heard if isinstance(message, StepDone)) == 6


@pytest.mark.parametrize("tail", [b'{"message": "StepDone", "st', b"\0" * 4000, b"[" * 9000, b"\xff\xfe\n[]\n7\n{}\n"])
def test_a_truncated_log_is_repaired_and_continued(tail: bytes, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, interrupt_at=11)
    log = RunDirectory(tmp_path).log
    log.write_bytes(log.read_bytes() + tail)
    run(tmp_path, resume=True)
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["step"] for line in lines if line["message"] == "StepDone"] == [10]
    assert [line["step"] for line in lines if line["message"] == "RunBegun"] == [0, 11]


@contextmanager
def no_room_beyond(size: int) -> Iterator[None]:
    """Limits the size of files, as a full disk would."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)


def test_a_full_disk_leaves_the_last_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, interrupt_at=5)
    directory = RunDirectory(tmp_path)
    before = directory.checkpoint.read_bytes()
    room = max(directory.log.stat().st_size + 4000, len(before) // 2)
    assert room < len(before)
    with no_room_beyond(room), pytest.raises(OSError, match="could not write"):
        run(tmp_path, resume=True)
    assert directory.checkpoint.read_bytes() == before
    assert not list(tmp_path.glob("*.tmp*"))
    assert_same(run(tmp_path, resume=True).scene, whole())


def test_a_disk_too_full_for_the_log_is_reported(tmp_path: Path) -> None:
    with no_room_beyond(0), pytest.raises(OSError, match="could not write"):
        run(tmp_path)


def test_resuming_without_a_checkpoint_is_refused(tmp_path: Path) -> None:
    directory, heard = RunDirectory(tmp_path / "run"), list[Message]()
    with pytest.raises(InputError, match=r"nothing was saved yet in .*; start again without --resume"):
        run(directory.path, resume=True)
    assert not directory.path.exists()
    directory.begin(RECIPE, SETTINGS, tiny_capture())
    with pytest.raises(InputError, match="start again without --resume"):
        run(directory.path, resume=True)
    run(directory.path, heard=heard)
    assert RunBegun(0, 12, anew=True) in heard
    directory.checkpoint.unlink()
    with pytest.raises(InputError, match="holds a trained scene, but no checkpoint"):
        run(directory.path, resume=True)
    with pytest.raises(InputError, match="already holds a trained scene"):
        run(directory.path)


@pytest.mark.parametrize(
    "name", ["cameras.json", "settings.json", "recipe.json", "index.html", "results.json", "point_cloud/iteration_7/x"]
)
def test_foreign_files_are_not_overwritten(name: str, tmp_path: Path) -> None:
    file = tmp_path / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("{}")
    with pytest.raises(InputError, match="choose another --output"):
        run(tmp_path)
    assert file.read_text() == "{}"
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [file]


def test_two_trainings_do_not_share_a_folder(tmp_path: Path) -> None:
    refused: list[str] = []

    def listen(message: Message) -> None:
        if isinstance(message, StepDone) and message.step == 3:
            for resume in (False, True):
                with pytest.raises(InputError) as caught:
                    run(tmp_path, resume=resume)
                refused.append(str(caught.value))

    Run(RECIPE, SETTINGS, RunDirectory(tmp_path), tiny_capture(), resume=False).run_to_end(listen)
    assert len(refused) == 2 and all("another training is writing to" in text for text in refused)


def test_a_run_too_short_for_its_stages_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    settings = replace(SETTINGS, iterations=6)
    with pytest.raises(InputError, match=r"6 iterations are too few for the stage '2 .*'; expected at least 8"):
        Run(PlanarRecipe(), settings, RunDirectory(tmp_path / "run"), tiny_capture(), resume=False).run_to_end(print)
    assert not (tmp_path / "run").exists()


def test_a_scene_that_cannot_be_initialised_leaves_no_folder(tmp_path: Path) -> None:
    bare = replace(tiny_capture(), pane_labels=())
    with pytest.raises(PlaneFitError, match="needs to know the panes"):
        Run(PlanarRecipe(), SETTINGS, RunDirectory(tmp_path / "run"), bare, resume=False).run_to_end(print)
    assert not (tmp_path / "run").exists()


def test_the_log_has_every_tenth_step_once(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, interrupt_at=11)
    run(tmp_path, resume=True)
    lines = [json.loads(line) for line in RunDirectory(tmp_path).log.read_text().splitlines()]
    assert [line["step"] for line in lines if line["message"] == "StepDone"] == [10]


def test_the_training_time_is_read_without_the_tensors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = run(tmp_path)
    monkeypatch.setattr("glassplat.training.checkpoint.restored_state", None)
    assert read_progress(RunDirectory(tmp_path).checkpoint).seconds == state.seconds > 0


@pytest.mark.parametrize("content", [b"", b"no checkpoint at all"])
def test_a_broken_checkpoint_has_no_training_time(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "broken").write_bytes(content)
    with pytest.raises(InputError, match="truncated or not a checkpoint"):
        read_progress(tmp_path / "broken")


def test_the_exported_scene_is_the_trained_one(tmp_path: Path) -> None:
    state = run(tmp_path)
    scene, iterations = RunDirectory(tmp_path).latest_scene()
    assert iterations == 12
    assert scene.extent == state.scene.extent
    for name, tensor in state.scene.primary.tensors().items():
        assert torch.equal(tensor, scene.primary.tensors()[name]), name


def test_a_broken_test_photograph_ends_a_run_at_the_start(tmp_path: Path) -> None:
    dataset = load_dataset(write_tiny_capture(tmp_path / "capture"))
    path = dataset.test[0].image_path
    os.truncate(path, path.stat().st_size // 2)

    def listen(message: Message) -> None:
        assert not isinstance(message, StepDone) or message.step < 2000, "the photograph was not found"

    with pytest.raises(InputError, match=path.name):
        Run(RECIPE, RunSettings("", 10**6), RunDirectory(tmp_path / "run"), dataset, resume=False).run_to_end(listen)


def test_resuming_a_checkpoint_of_another_method_is_refused(tmp_path: Path) -> None:
    run(tmp_path)
    state = load_checkpoint(RunDirectory(tmp_path).checkpoint)
    for changed, message in (
        (replace(state, method="planar"), "is a checkpoint of planar; expected one of splat"),
        (replace(state, step=13), "is of step 13; expected one of at most 12"),
        (replace(state, seed=1), "is of a run with the seed 1; expected 0"),
    ):
        save_checkpoint(RunDirectory(tmp_path).checkpoint, changed)
        with pytest.raises(InputError, match=message):
            run(tmp_path, resume=True)


class Following(Ranks):
    """A rank that does not lead, although it is alone."""

    @property
    def is_leader(self) -> bool:
        return False


def test_a_rank_that_does_not_lead_saves_nothing(tmp_path: Path) -> None:
    following = Run(RECIPE, SETTINGS, RunDirectory(tmp_path / "run"), tiny_capture(), ranks=Following())
    following.state = training.initial_state(RECIPE, SETTINGS, tiny_capture())
    for message in following.messages():
        if isinstance(message, StepDone):
            following.save()
    assert following.state.step == 12
    assert list(tmp_path.rglob("*.*")) == []


@pytest.mark.parametrize("kind", [InputError, FileNotFoundError])
def test_an_unreadable_photograph_ends_training_with_a_checkpoint(
    tmp_path: Path, kind: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    gone, memory = threading.Event(), PixelCache(0.0)
    monkeypatch.setattr("glassplat.captures.view.DISK_RATE", 1e-9)  # Never copied to disk, however slow the reader.

    def guarded(view: View) -> View:
        def read() -> torch.Tensor:
            if gone.is_set():
                raise kind(f"{view.name} cannot be read")
            return view.read_photo()

        return replace(view, read_photo=read, memory=memory)

    def listen(message: Message) -> None:
        if isinstance(message, StepDone) and message.step == 5:
            gone.set()

    directory = RunDirectory(tmp_path / "run")
    dataset = replace(tiny_capture(), train=tuple(map(guarded, tiny_capture().train)))
    hint = r"; step \d is saved; .* repeat with --resume" if kind is InputError else "$"
    with pytest.raises(kind, match=f"png cannot be read{hint}") as caught:
        Run(RECIPE, SETTINGS, directory, dataset, checkpoint_every=math.inf).run_to_end(listen)
    step = load_checkpoint(directory.checkpoint).step
    assert step >= 5 and (kind is not InputError or f"step {step} is saved" in str(caught.value))
    assert_same(run(directory.path, resume=True).scene, whole())


class Unreadable:
    """An action that needs a photograph whose file has been deleted."""

    name = "look"

    def due(self, clock: Clock) -> bool:
        return clock.step == 5

    def apply(self, state: TrainState, dataset: Any, clock: Clock) -> bool:
        raise InputError("1.png cannot be read")


def test_a_state_in_the_middle_of_a_change_is_not_saved(tmp_path: Path) -> None:
    """The step is done, but the actions after it are not."""
    record: Any = OutputFiles(
        tmp_path / "checkpoint.safetensors", SimpleNamespace(write=lambda message: None), math.inf
    )
    stages = tuple(replace(stage, actions=(Unreadable(),)) for stage in RECIPE.stages(seed=0, iterations=12))
    state = training.initial_state(RECIPE, SETTINGS, tiny_capture())
    with pytest.raises(InputError, match=r"^1\.png cannot be read$"):
        list(TrainingSession(state, Ranks(), record).run_stages(stages, tiny_capture(), 12))
    assert state.step == 5 and not record.checkpoint.exists()


@pytest.mark.parametrize(
    ("recipe", "settings", "told", "original"),
    [
        (RECIPE, replace(SETTINGS, iterations=13), "iterations was 12 and is 13", "--iterations 12 "),
        (
            RECIPE,
            replace(SETTINGS, iterations=13, mask_polarity="dark"),
            "iterations was 12 and is 13, mask_polarity was auto and is dark",
            "--iterations 12 --mask-polarity auto ",
        ),
        (
            replace(RECIPE, intervals=replace(RECIPE.intervals, sh=0.5), sh_degree=2),
            replace(SETTINGS, seed=3),
            f"seed was 0 and is 3, sh_degree was 1 and is 2, intervals.sh was {RECIPE.intervals.sh} and is 0.5",
            "--seed 0 ",
        ),
        (DeferredRecipe(), SETTINGS, "method was splat and is deferred", ""),
    ],
)
def test_resuming_names_changed_options(recipe: Any, settings: Any, told: str, original: str, tmp_path: Path) -> None:
    folder = tmp_path / "my run"
    with pytest.raises(KeyboardInterrupt):
        run(folder, interrupt_at=5)
    with pytest.raises(InputError) as caught:
        Run(recipe, settings, RunDirectory(folder), tiny_capture(), resume=True).run_to_end(print)
    assert f" was started with other options: {told}; expected the same to resume it. Repeat" in str(caught.value)
    assert f"options by {original}--config '{folder / 'recipe.json'}', or" in str(caught.value)


def test_a_run_resumes_with_its_moved_capture_only(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, interrupt_at=5)
    moved, capture, directory = replace(SETTINGS, data="elsewhere"), tiny_capture(), RunDirectory(tmp_path)
    *others, last = capture.train
    pose = last.camera.cam_from_world.clone()
    pose[0, 3] += 0.1 * capture.extent
    other = replace(capture, train=(*others, last.with_camera(replace(last.camera, cam_from_world=pose))))
    with pytest.raises(InputError, match="data was tiny and is elsewhere"):
        Run(RECIPE, moved, directory, other, resume=True).run_to_end(print)
    assert Run(RECIPE, moved, directory, capture, resume=True).run_to_end(print).step == SETTINGS.iterations
    assert directory.settings() == replace(moved, masks=masks_checksum(capture))


@pytest.mark.parametrize("what", ["photographs", "masks"])
def test_changed_files_are_warned_about_on_resuming(
    what: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    capture, directory = write_tiny_capture(tmp_path / "capture"), RunDirectory(tmp_path / "run")
    settings = replace(SETTINGS, data=str(capture))
    for change in (False, True):
        if change:
            folder = capture / ("images" if what == "photographs" else "panes")
            (folder / "0.png").write_bytes((folder / "1.png").read_bytes() + b"0")
        else:
            Run(RECIPE, settings, directory, load_dataset(capture), resume=False).run_to_end(lambda message: None)
        Run(RECIPE, settings, directory, load_dataset(capture), resume=True).run_to_end(lambda message: None)
        assert [record.args[0] for record in caplog.records if "have changed since" in record.msg] == [what] * change
        settings = directory.settings()  # Has the checksums.


def test_resuming_names_an_option_that_the_earlier_version_lacked(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, interrupt_at=5)
    written = json.loads((tmp_path / "recipe.json").read_text())
    del written["ssim_weight"]
    (tmp_path / "recipe.json").write_text(json.dumps(written))
    with pytest.raises(InputError, match=r"options: ssim_weight was unknown and is 0\.2; expected the same"):
        run(tmp_path, resume=True)


def test_resuming_with_another_kind_of_recipe_is_refused(tmp_path: Path) -> None:
    class Own(SplatRecipe):
        """A recipe that could have other stages."""

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, interrupt_at=5)
    with pytest.raises(InputError, match="options: recipe was SplatRecipe and is Own; expected the same"):
        Run(Own(sh_degree=1), SETTINGS, RunDirectory(tmp_path), tiny_capture(), resume=True).run_to_end(print)


def test_resuming_with_other_photographs_is_refused(tmp_path: Path) -> None:
    """Views other than before would be held out for testing."""
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, interrupt_at=5)
    before = RunDirectory(tmp_path).checkpoint.read_bytes()
    fewer = replace(tiny_capture(), train=tiny_capture().train[1:], test=tiny_capture().train[1:2])
    with pytest.raises(InputError, match=r"tiny is not the capture that .* was trained on: 0\.png only in the run"):
        Run(RECIPE, SETTINGS, RunDirectory(tmp_path), fewer, resume=True).run_to_end(print)
    assert RunDirectory(tmp_path).checkpoint.read_bytes() == before


@pytest.mark.parametrize(
    "recipe", [RECIPE, PlanarRecipe(fresnel="none", weights=ReflectionWeights(depth=0.0), background=(1.0, 1.0, 1.0))]
)
def test_a_recipe_round_trips_through_its_file(recipe: Any) -> None:
    assert recipe_from_json(recipe_to_json(recipe)) == recipe
    assert recipe_from_json(recipe_to_json(recipe)) != replace(recipe, sh_degree=0)


def test_a_recipe_with_a_removed_choice_is_refused() -> None:
    text = recipe_to_json(PlanarRecipe()).replace('"fresnel": "pane"', '"fresnel": true')
    with pytest.raises(InputError, match="fresnel is True; expected one of pane, schlick, none"):
        recipe_from_json(text)


@pytest.mark.parametrize("launched", [True, False])
def test_a_second_signal_interrupts_unless_torchrun_may_have_passed_it_on(
    launched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "1")
    if launched:
        monkeypatch.setenv("TORCHELASTIC_RUN_ID", "run")
    with training.stop_on_interrupt() as request:
        signal.raise_signal(signal.SIGINT)
        with nullcontext() if launched else pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert request.requested


def test_resuming_with_reestimated_poses_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, interrupt_at=5)
    before = RunDirectory(tmp_path).checkpoint.read_bytes()
    capture = tiny_capture()

    def turned(camera: Camera) -> Camera:
        pose = camera.cam_from_world.clone()
        pose[:3, 3] *= 2
        return replace(camera, cam_from_world=pose)

    other = replace(capture, train=tuple(view.with_camera(turned(view.camera)) for view in capture.train))
    with pytest.raises(InputError, match=r"cameras of tiny have moved since .*: 1\.png.*prepared again\?"):
        Run(RECIPE, SETTINGS, RunDirectory(tmp_path), other, resume=True).run_to_end(print)
    assert RunDirectory(tmp_path).checkpoint.read_bytes() == before
