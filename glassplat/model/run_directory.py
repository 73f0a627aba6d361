"""The directory of a run: its settings, log, lock, and whether it may be written.

Its checks do not need PyTorch.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import logging
import os
import re
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from filelock import FileLock, Timeout

from glassplat.captures.masks import Polarity
from glassplat.errors import InputError, convert_to_input_error, join_names
from glassplat.files.records import parse_json, read_text
from glassplat.files.writing import check_folder, check_links, make_folder, remove_unfinished, write_text
from glassplat.options import Downscale, PositiveCount, Seed, check_value
from glassplat.training.messages import Message, StepDone, Working
from glassplat.training.ranks import is_leader

if TYPE_CHECKING:
    from glassplat.captures.dataset import Dataset
    from glassplat.scene.camera import Camera
    from glassplat.scene.scene import Scene

log = logging.getLogger("glassplat.training")

LOCK_FILE = "train.lock"
"""The empty file remains; its lock ends with the process."""
NO_LOCK_ERRORS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)
"""Errors of file systems without locks."""


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Locks the folder against other training processes, if the file system supports it.

    Raises:
        InputError: another training process writes to it.
    """
    lock = FileLock(folder / LOCK_FILE, blocking=False, mode=0o666, thread_local=False)
    try:
        lock.acquire()
    except Timeout as error:
        raise InputError(
            f"another training is writing to {folder}; each needs its own folder. Wait until it has finished, or "
            "choose another --output"
        ) from error
    except OSError as error:
        if error.errno not in NO_LOCK_ERRORS:
            raise
        log.warning("%s cannot be locked (%s); make sure that no second training writes to it", folder, error.strerror)
    try:
        yield
    finally:
        lock.release()


def check_unlocked(folder: Path) -> None:
    """Check that no other training process writes to a folder.

    Raises:
        InputError: another one does.
    """
    if (folder / LOCK_FILE).is_file():
        with run_lock(folder):
            pass


CHECKPOINT_SECONDS = 120.0
"""Default interval of checkpoints, the most that a power cut can cost."""


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run apart from the recipe.

    Attributes:
        data: directory of the capture, from the root of the file system.
        iterations: length of the run.
        downscale: factor by which photographs are shrunk.
        seed: random seed.
        device: training device.
        mask_polarity: value of black-and-white masks that marks panes.
        photographs: the checksum of the photographs with which the run began; empty if unknown.
        masks: the same of the masks.
    """

    data: str
    iterations: PositiveCount
    downscale: Downscale = 1.0
    seed: Seed = 0
    device: str = "cpu"
    mask_polarity: Polarity = "auto"
    photographs: str = ""
    masks: str = ""


def photographs_checksum(dataset: Dataset) -> str:
    """A checksum of the sizes of the photographs' files, which copies keep; empty without files."""
    paths = {view.name: view.image_path for view in (*dataset.train, *dataset.test)}
    sizes = [(name, path.stat().st_size) for name, path in sorted(paths.items()) if path.is_file()]
    return f"{zlib.crc32(repr(sizes).encode()):08x}" if sizes else ""


def masks_checksum(dataset: Dataset) -> str:
    """A checksum of the masks' files; that of no masks is not empty."""
    paths = sorted({(view.name, path) for view in (*dataset.train, *dataset.test) for path in view.mask_paths})
    return f"{zlib.crc32(repr([(name, zlib.crc32(path.read_bytes())) for name, path in paths]).encode()):08x}"


EVALUATION_FILES = ("per_view.json", "sheets", "uses.png", "index.html")
RUN_FILES = ("recipe.json", "settings.json", "log.jsonl", "cameras.json", *EVALUATION_FILES)
"""Other files of a run."""
MOST_MOVED = 0.02
"""Tolerance of camera positions, as a share of the scene's extent."""
ROUNDING = 1e-5
"""Additional tolerance for single precision, as a share of the distance from the origin."""
ITERATION_FOLDER = re.compile(r"iteration_([0-9]{1,18})")
"""Name of a scene's folder; users may keep renamed copies."""


@dataclass(frozen=True)
class RunDirectory:
    """Names of the files of a run.

    ```
    recipe.json  settings.json         what was run
    log.jsonl                          one line per logged step
    train.lock                         held while a training writes here
    checkpoint.safetensors             to resume from
    cameras.json                       all cameras, where training refined them if it did
    sparse/0/                          the same as a COLMAP model, only of refined ones
    point_cloud/iteration_N/           point_cloud.ply, scene.json, and what else the scene has
    results.json  per_view.json        metrics
    sheets/  uses.png  index.html      pictures
    ```
    """

    path: Path

    @property
    def checkpoint(self) -> Path:
        """Path of the newest checkpoint."""
        return self.path / "checkpoint.safetensors"

    @property
    def log(self) -> Path:
        """Path of the training log."""
        return self.path / "log.jsonl"

    @property
    def results(self) -> Path:
        """Path of the metrics."""
        return self.path / "results.json"

    @property
    def import_record(self) -> Path:
        """Path of the record of a scene's origin, for scenes that were not trained."""
        return self.path / "imported.json"

    @property
    def is_saved(self) -> bool:
        """Return whether it contains results of training."""
        return any((self.path / name).exists() for name in (self.checkpoint.name, self.results.name, "point_cloud"))

    @property
    def is_begun(self) -> bool:
        """Return whether a run was started here."""
        try:
            self.recipe()
        except InputError:
            return False
        return True

    def check_begun(self) -> None:
        """Refuse a folder in which no run was started.

        Raises:
            FileNotFoundError: nothing is there.
            InputError: there is no recipe.
        """
        if not self.path.exists():
            raise FileNotFoundError(f"{self.path} does not exist; expected what `glassplat train --output` wrote")
        self._read_file("recipe.json")

    def check_vacant(self) -> None:
        """Refuse to start a run that would overwrite something.

        Raises:
            InputError: the directory holds a run, or other files with the same names.
        """
        if self.checkpoint.exists():
            raise InputError(
                f"{self.path} already holds a run; resume it (--resume, resume=True), or choose another output"
            )
        if self.is_saved:
            raise InputError(f"{self.path} already holds a trained scene; choose another --output, or move it away")
        found = [name for name in RUN_FILES if os.path.lexists(self.path / name)]
        if found and not self.is_begun:
            raise InputError(
                f"{self.path} holds {join_names(found)}, which is not from a run of this version and would be "
                "overwritten; choose another --output"
            )

    def check_saved(self) -> None:
        """Refuse to resume a run without a checkpoint.

        Raises:
            InputError: there is none.
        """
        if self.checkpoint.is_file():
            return
        if self.is_saved:
            raise InputError(
                f"{self.path} holds a trained scene, but no {self.checkpoint.name} to continue from; train it again "
                "with another --output"
            )
        raise InputError(f"nothing was saved yet in {self.path}; start again without --resume")

    def begin(self, recipe: Any, settings: RunSettings, dataset: Dataset) -> None:
        """Creates the directory and records recipe and settings."""
        from glassplat.files.sidecars import write_cameras
        from glassplat.methods.recipe import recipe_to_json

        make_folder(self.path)
        write_text(self.path / "recipe.json", recipe_to_json(recipe) + "\n")
        photographs, masks = photographs_checksum(dataset), masks_checksum(dataset)
        self.write_settings(dataclasses.replace(settings, photographs=photographs, masks=masks))
        write_cameras(self.path / "cameras.json", [(v.name, v.camera) for v in (*dataset.train, *dataset.test)])

    def write_settings(self, settings: RunSettings) -> None:
        """Replaces the recorded settings."""
        write_text(self.path / "settings.json", json.dumps(dataclasses.asdict(settings), indent=2) + "\n")

    def remove_partial_files(self) -> None:
        """Removes partial files of a killed run; requires the lock.

        Other commands may be writing JSON and images here.
        """
        remove_unfinished(self.path, (self.checkpoint.suffix,))
        for folder in self.path.glob("point_cloud/iteration_*"):
            remove_unfinished(folder, (".ply", ".json", ".safetensors", ".png"))

    def write_trained_cameras(self, dataset: Dataset, scene: Scene) -> None:
        """Writes the cameras, with refined poses if training refined them.

        With refined poses, `sparse/0` has them as a COLMAP model of the undistorted, downscaled photographs, without
        random points.
        """
        from glassplat.captures.dataset import with_corrected_cameras
        from glassplat.files.sidecars import write_cameras, write_colmap

        refined = with_corrected_cameras(dataset, scene)
        cameras = [(view.name, view.camera) for view in (*refined.train, *refined.test)]
        write_cameras(self.path / "cameras.json", cameras)
        if not len(scene.poses):
            return
        measured = slice(None if dataset.measured_points else 0)
        positions, colors = (part[measured].numpy() for part in (dataset.points.positions, dataset.points.colors))
        write_colmap(self.path / "sparse" / "0", sorted(cameras, key=itemgetter(0)), positions, colors)

    def recipe(self) -> Any:
        """The recorded recipe."""
        from glassplat.methods.recipe import recipe_from_json

        return recipe_from_json(self._read_file("recipe.json"), str(self.path / "recipe.json"))

    def recipe_as_written(self) -> Any:
        """The recorded options, as written."""
        return parse_json(self._read_file("recipe.json"), "recipe.json")

    def settings(self) -> RunSettings:
        """The recorded settings."""
        if self.import_record.is_file():
            raise InputError(
                f"{self.path} is a scene without a capture, as `clean --scale` writes it; expected a run with its "
                "photographs: give the one that the scene was made from"
            )
        path = self.path / "settings.json"
        with convert_to_input_error():
            written = parse_json(self._read_file(path.name), str(path))
        try:
            return check_value(RunSettings, written)
        except InputError as error:
            raise InputError(f"{path} cannot be read: {error}; train again") from error

    def has_cameras_of(self, dataset: Dataset) -> bool:
        """Return whether the recorded cameras match the capture's, up to pose refinement."""
        recorded = self._cameras()
        cameras = {view.name: view.camera for view in (*dataset.train, *dataset.test)}
        return recorded.keys() == cameras.keys() and all(
            _is_unmoved(recorded[name], camera, dataset.extent)
            and (recorded[name].width, recorded[name].height) == (camera.width, camera.height)
            for name, camera in cameras.items()
        )

    def _check_poses(self, recorded: Mapping[str, Camera], dataset: Dataset) -> None:
        """Refuse a capture in which most cameras have moved, since it has another world frame."""
        known = {v.name: v.camera for v in (*dataset.train, *dataset.test) if v.name in recorded}
        moved = [name for name, camera in known.items() if not _is_unmoved(recorded[name], camera, dataset.extent)]
        if 2 * len(moved) > len(known):
            raise InputError(
                f"{len(moved)} of {len(known)} cameras of {dataset.root} have moved since {self.path} was "
                f"trained: {join_names(sorted(moved))}. Was the capture prepared again? Give the original "
                "capture to --data, or train again"
            )

    def _cameras(self) -> dict[str, Camera]:
        """The recorded cameras by name; empty if they cannot be read."""
        from glassplat.files.sidecars import read_cameras

        try:
            return dict(read_cameras(self.path / "cameras.json"))
        except (OSError, ValueError):
            return {}

    def check_photographs(self, dataset: Dataset) -> None:
        """Refuse a capture whose photographs or poses differ from those of the run.

        A missing or additional photograph would change the split into training and test views. Nothing is compared if
        the run's cameras cannot be read.

        Raises:
            InputError: photographs are missing or additional, or cameras have moved.
        """
        recorded, found = self._cameras(), {view.name for view in (*dataset.train, *dataset.test)}
        trained = set(recorded)
        if not recorded or trained == found:
            self._check_poses(recorded, dataset)
            return
        only = [
            f"{join_names(sorted(names))} only in {where}"
            for names, where in ((trained - found, "the run"), (found - trained, "the capture"))
            if names
        ]
        raise InputError(
            f"{dataset.root} is not the capture that {self.path} was trained on: {', '.join(only)}. Give the same "
            "photographs to --data"
        )

    def record_origin(self, source: Path | None, **more: str) -> None:
        """Records the path from which a scene that was not trained comes, if any, and other facts by name."""
        file = None if source is None else str(source.resolve())
        write_text(self.import_record, json.dumps({"file": file, **more}) + "\n")

    def export(self, scene: Scene, step: int) -> Path:
        """Writes the scene as an export; returns its folder."""
        from glassplat.files.scene_folder import write_scene
        from glassplat.files.sidecars import write_equirect
        from glassplat.render.deferred import equirect_from_environment

        folder = self.path / "point_cloud" / f"iteration_{step}"
        write_scene(folder, scene)
        if not scene.environment.is_empty:
            panorama = equirect_from_environment(scene.environment, 2 * scene.environment.size)
            write_equirect(folder / "environment.png", panorama)
        return folder

    def scene_folders(self) -> dict[int, Path]:
        """The folders of saved scenes, by iteration."""
        named = {ITERATION_FOLDER.fullmatch(folder.name): folder for folder in self.path.glob("point_cloud/*")}
        return {int(match[1]): folder for match, folder in named.items() if match and folder.is_dir()}

    def latest_scene(self) -> tuple[Scene, int]:
        """The scene of the last saved iteration, and that iteration."""
        from glassplat.files.scene_folder import read_scene

        folders = self.scene_folders()
        if not folders:
            resumed, anew = "Finish it with `glassplat train ... --resume`", "Nothing was saved yet: train it again"
            remedy = resumed if self.checkpoint.is_file() else anew
            raise InputError(f"{self.path} holds no point_cloud/iteration_N; expected a finished run. {remedy}")
        step = max(folders)
        try:
            return read_scene(folders[step]), step
        except (ValueError, FileNotFoundError) as error:
            raise InputError(f"the scene in {folders[step]} cannot be read: {error}") from error

    def _read_file(self, name: str) -> str:
        file = self.path / name
        if not file.is_file():
            raise InputError(
                f"{self.path} is not a run directory: no {name} in it; expected what `glassplat train --output` wrote"
            )
        with convert_to_input_error():
            return read_text(file)


def _is_unmoved(recorded: Camera, camera: Camera, extent: float) -> bool:
    rounding = ROUNDING * float(camera.center.norm())
    return float((recorded.center - camera.center).norm()) <= MOST_MOVED * extent + rounding


def check_output(directory: RunDirectory, *, resume: bool) -> None:
    """Check a run's directory before the photographs are read; writes nothing.

    Raises:
        InputError: a fresh run would overwrite something, there is nothing to resume, another training writes
            there, or a link leads out of it.
        NotADirectoryError: it is a file, or goes through one.
        PermissionError: the folder is not writable.
    """
    if not is_leader():
        return  # Rank 0 may have started writing.
    check_folder(directory.path)
    links = (*RUN_FILES, directory.checkpoint.name, directory.results.name, "point_cloud", "sparse")
    check_links(directory.path, links)
    check_unlocked(directory.path)
    if resume:
        directory.check_saved()
    else:
        directory.check_vacant()


LOG_EVERY = 10


class RunLog:
    """Appends messages to an open log."""

    def __init__(self, file: TextIO, path: Path, step: int = 0) -> None:
        self._file, self._path, self._step = file, path, step

    def write(self, message: Message) -> None:
        """Appends a message, but only every tenth step and no progress of work.

        Raises:
            OSError: the disk is full or fails.
        """
        if isinstance(message, Working):
            return
        if isinstance(message, StepDone):
            before, self._step = self._step, message.step
            if message.step // LOG_EVERY == before // LOG_EVERY:
                return
        try:
            self._file.write(json.dumps({"message": type(message).__name__, **vars(message)}) + "\n")
            self._file.flush()
        except OSError as error:
            raise OSError(error.errno, f"could not write {self._path} ({error.strerror})") from error


@contextmanager
def open_log(path: Path, step: int) -> Iterator[RunLog]:
    """The log, truncated at the step from which the run continues.

    A killed run or a power cut may leave partial lines or zeros; these are dropped.
    """
    kept = lines_until(path, step) if step and path.is_file() else []
    write_text(path, "".join(line + "\n" for line in kept))
    file = path.open("a", encoding="utf-8")
    try:
        yield RunLog(file, path, step)
    finally:
        with suppress(OSError):  # Every line was flushed after writing.
            file.close()


def lines_until(path: Path, step: int) -> list[str]:
    """The valid lines of a log up to a step."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return [line for line in lines if 0 <= _step_of(line) <= step]


def _step_of(line: str) -> int:
    """The step of a line; -1 if it is not a log line."""
    try:
        step = json.loads(line)["step"]
    except (ValueError, KeyError, TypeError, IndexError, RecursionError):
        return -1
    return step if isinstance(step, int) else -1
