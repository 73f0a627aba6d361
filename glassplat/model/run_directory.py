"""The directory of a run: its settings, log, lock, and whether it may be written.

Where it must not be written, or holds no run, is found out without PyTorch.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import logging
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

from filelock import FileLock, Timeout

from glassplat.captures.masks import Polarity
from glassplat.errors import InputError, first_names, input_checked
from glassplat.files.records import parse_json, read_json, read_text
from glassplat.files.writing import check_folder, check_links, make_folder, remove_unfinished, write_text
from glassplat.options import Downscale, Seed, Several, options_from_json
from glassplat.training.messages import Message, StepDone, Working
from glassplat.training.ranks import leads

if TYPE_CHECKING:
    from glassplat.captures.dataset import Dataset
    from glassplat.scene.camera import Camera
    from glassplat.scene.scene import Scene

log = logging.getLogger("glassplat.training")

NAME = "train.lock"
"""The file stays behind, empty; the lock on it ends with the process, however that ends."""
WITHOUT_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)
"""What file systems answer that know no locks."""


def _is_near(recorded: Camera, camera: Camera, extent: float) -> bool:
    rounding = ROUNDING * float(camera.center.norm())
    return float((recorded.center - camera.center).norm()) <= MOST_MOVED * extent + rounding


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Holds the folder against other trainings; a file system that knows no locks is used without one.

    Raises:
        InputError: another training writes into it.
    """
    lock = FileLock(folder / NAME, blocking=False, mode=0o666, thread_local=False)
    try:
        lock.acquire()
    except Timeout as error:
        raise InputError(
            f"another training is writing into {folder}; expected a folder for each. Wait until it has ended, or "
            "choose another --output"
        ) from error
    except OSError as error:
        if error.errno not in WITHOUT_LOCKS:
            raise
        log.warning("%s cannot be locked (%s); see that no second training writes into it", folder, error.strerror)
    try:
        yield
    finally:
        lock.release()


def check_unlocked(folder: Path) -> None:
    """Look whether another training writes into a folder.

    Raises:
        InputError: one does.
    """
    if (folder / NAME).is_file():
        with run_lock(folder):
            pass


CHECKPOINT_SECONDS = 120.0
"""What a power cut may cost at the most, unless the user says otherwise."""


@dataclass(frozen=True)
class RunSettings:
    """Settings of a run apart from the recipe.

    Attributes:
        data: directory of the capture, from the root of the file system.
        iterations: length of the run.
        downscale: factor by which photographs are shrunk.
        seed: fixes every random choice.
        device: where training runs.
        mask_polarity: which value of black-and-white masks is the pane.
    """

    data: str
    iterations: Several
    downscale: Downscale = 1.0
    seed: Seed = 0
    device: str = "cpu"
    mask_polarity: Polarity = "auto"


EVALUATED = ("per_view.json", "sheets", "uses.png", "index.html")
FILES = ("recipe.json", "settings.json", "log.jsonl", "cameras.json", *EVALUATED)
"""What a run writes next to its checkpoint, scene and metrics."""
MOST_MOVED = 0.02
"""Share of the scene's extent by which two cameras may differ that are taken for one."""
ROUNDING = 1e-5
"""Share of a camera's distance from the origin by which single precision may displace it as well."""
NUMBERED = re.compile(r"iteration_([0-9]{1,18})")
"""The folder of a scene; people keep copies under other names next to it."""


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
    def imported(self) -> Path:
        """Path of the record of a scene's source if it has no capture: it was made in a program."""
        return self.path / "imported.json"

    @property
    def is_saved(self) -> bool:
        """Return whether there is something in it that took training to make."""
        return any((self.path / name).exists() for name in (self.checkpoint.name, self.results.name, "point_cloud"))

    @property
    def is_begun(self) -> bool:
        """Return whether a run was begun here, whatever has become of it."""
        try:
            self.recipe()
        except InputError:
            return False
        return True

    def check_begun(self) -> None:
        """Refuse what no run was begun in.

        Raises:
            FileNotFoundError: nothing is there.
            InputError: there is no recipe.
        """
        if not self.path.exists():
            raise FileNotFoundError(f"there is nothing at {self.path}; expected what `glassplat train --output` wrote")
        self._read("recipe.json")

    def check_vacant(self) -> None:
        """Refuse to begin a run where something would be lost by it.

        Raises:
            InputError: the directory holds a run, or files of somebody else that have the names of a run's.
        """
        if self.checkpoint.exists():
            raise InputError(
                f"{self.path} already holds a run; pass --resume to go on with it, or choose another --output"
            )
        if self.is_saved:
            raise InputError(f"{self.path} already holds a trained scene; choose another --output, or move it away")
        found = [name for name in FILES if os.path.lexists(self.path / name)]
        if found and not self.is_begun:
            raise InputError(
                f"{self.path} holds {first_names(found)}, which is not from a run of this version and would be "
                "overwritten; choose another --output"
            )

    def check_saved(self) -> None:
        """Refuse to go on with a run of which there is no checkpoint.

        Raises:
            InputError: there is none.
        """
        if self.checkpoint.is_file():
            return
        if self.is_saved:
            raise InputError(
                f"{self.path} holds a trained scene, but no {self.checkpoint.name} to go on from; train it again with "
                "another --output"
            )
        raise InputError(f"nothing was saved yet in {self.path}; begin again without --resume")

    def begin(self, recipe: Any, settings: RunSettings, dataset: Dataset) -> None:
        """Creates the directory and records what is about to run."""
        from glassplat.files.sidecars import write_cameras
        from glassplat.methods.recipe import recipe_to_json

        make_folder(self.path)
        write_text(self.path / "recipe.json", recipe_to_json(recipe) + "\n")
        self.write_settings(settings)
        write_cameras(self.path / "cameras.json", [(v.name, v.camera) for v in (*dataset.train, *dataset.test)])

    def write_settings(self, settings: RunSettings) -> None:
        """Replaces the recorded settings."""
        write_text(self.path / "settings.json", json.dumps(dataclasses.asdict(settings), indent=2) + "\n")

    def clear(self) -> None:
        """Removes what a training left half-written that was killed; for who holds the lock.

        Other commands may be writing JSON and pictures here.
        """
        remove_unfinished(self.path, (self.checkpoint.suffix,))
        for folder in self.path.glob("point_cloud/iteration_*"):
            remove_unfinished(folder, (".ply", ".json", ".safetensors", ".png"))

    def write_trained_cameras(self, dataset: Dataset, scene: Scene) -> None:
        """Writes the recorded cameras again, as training found them if it looked for them.

        Then `sparse/0` is the same as a COLMAP model, of the photographs as training saw them: undistorted and reduced.
        Random points are not in it.
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

        return recipe_from_json(self._read("recipe.json"), str(self.path / "recipe.json"))

    def written_recipe(self) -> Any:
        """The recorded recipe's options as they were written."""
        return parse_json(self._read("recipe.json"), "recipe.json")

    def settings(self) -> RunSettings:
        """The recorded settings."""
        path = self.path / "settings.json"
        with input_checked():
            written = parse_json(self._read(path.name), str(path))
        try:
            return options_from_json(RunSettings, written)
        except InputError as error:
            raise InputError(f"{path} cannot be read: {error}; train again") from error

    def photographs(self) -> set[str] | None:
        """Names of the photographs that the run was begun with; None where that is not recorded legibly."""
        try:
            return {entry["img_name"] for entry in read_json(self.path / "cameras.json")}
        except (OSError, ValueError, TypeError, KeyError):
            return None

    def has_cameras_of(self, dataset: Dataset) -> bool:
        """Return whether the recorded cameras are the capture's, give or take what pose refinement may move them."""
        recorded = self._cameras()
        cameras = {view.name: view.camera for view in (*dataset.train, *dataset.test)}
        return recorded.keys() == cameras.keys() and all(
            _is_near(recorded[name], camera, dataset.extent)
            and (recorded[name].width, recorded[name].height) == (camera.width, camera.height)
            for name, camera in cameras.items()
        )

    def _check_poses(self, dataset: Dataset) -> None:
        """Refuse a capture most of whose cameras are elsewhere: its world is another one than that of the scene."""
        recorded = self._cameras()
        known = {v.name: v.camera for v in (*dataset.train, *dataset.test) if v.name in recorded}
        moved = [name for name, camera in known.items() if not _is_near(recorded[name], camera, dataset.extent)]
        if 2 * len(moved) > len(known):
            raise InputError(
                f"{len(moved)} of {len(known)} cameras of {dataset.root} are elsewhere than when {self.path} was "
                f"trained: {first_names(sorted(moved))}. Has the capture been prepared again? Give the capture as it "
                "was to --data, or train again"
            )

    def _cameras(self) -> dict[str, Camera]:
        """The recorded cameras by name; none where they cannot be read."""
        from glassplat.files.sidecars import read_cameras

        try:
            return dict(read_cameras(self.path / "cameras.json"))
        except (OSError, ValueError):
            return {}

    def check_photographs(self, dataset: Dataset) -> None:
        """Refuse a capture of other photographs than the run was trained on, or with other poses.

        Which of them are for testing follows from all of them; with one more or less, they would be others.

        Raises:
            InputError: says which ones only the run or only the capture has, or that the cameras are elsewhere.
        """
        trained, found = self.photographs(), {view.name for view in (*dataset.train, *dataset.test)}
        if trained is None or trained == found:
            self._check_poses(dataset)
            return
        only = [
            f"{first_names(sorted(names))} only in {where}"
            for names, where in ((trained - found, "the run"), (found - trained, "the capture"))
            if names
        ]
        raise InputError(
            f"{dataset.root} is not the capture that {self.path} was trained on: {', '.join(only)}. Give the same "
            "photographs to --data"
        )

    def export(self, scene: Scene, step: int) -> Path:
        """Writes the scene in the formats that others read; returns its folder."""
        from glassplat.files.scene_folder import write_scene
        from glassplat.files.sidecars import write_equirect
        from glassplat.render.deferred import equirect_from_environment

        folder = self.path / "point_cloud" / f"iteration_{step}"
        write_scene(folder, scene)
        if not scene.environment.is_empty:
            panorama = equirect_from_environment(scene.environment, 2 * scene.environment.size)
            write_equirect(folder / "environment.png", panorama)
        return folder

    def latest_scene(self) -> tuple[Scene, int]:
        """The exported scene of the highest iteration, and that iteration."""
        from glassplat.files.scene_folder import read_scene

        named = {NUMBERED.fullmatch(folder.name): folder for folder in self.path.glob("point_cloud/*")}
        folders = {int(match[1]): folder for match, folder in named.items() if match and folder.is_dir()}
        if not folders:
            raise InputError(
                f"{self.path} holds no point_cloud/iteration_N; expected a finished run. Train first, or --resume it"
            )
        step = max(folders)
        try:
            return read_scene(folders[step]), step
        except (ValueError, FileNotFoundError) as error:
            raise InputError(f"the scene in {folders[step]} cannot be read: {error}") from error

    def _read(self, name: str) -> str:
        file = self.path / name
        if not file.is_file():
            raise InputError(
                f"{self.path} is not a run directory: no {name} in it; expected what `glassplat train --output` wrote"
            )
        with input_checked():
            return read_text(file)


def check_output(directory: RunDirectory, *, resume: bool) -> None:
    """Check a run's directory before the photographs are read; writes nothing.

    Raises:
        InputError: a fresh run would overwrite something, there is nothing to go on from, another training writes
            there, or a link leads out of it.
        NotADirectoryError: it is a file, or goes through one.
        PermissionError: nothing may be written there.
    """
    if not leads():
        return  # Rank 0 writes, and may have begun already.
    check_folder(directory.path)
    check_links(directory.path, (*FILES, directory.checkpoint.name, directory.results.name, "point_cloud", "sparse"))
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
        """Appends a message; of the steps the first in every ten iterations, and nothing of work between two.

        Raises:
            OSError: the disk is full or fails; names the log.
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
    """The log, cut back to the step from which the run goes on.

    A run that was killed may leave half a line, or the zeros of a power cut; such lines are left out.
    """
    kept = lines_until(path, step) if step and path.is_file() else []
    write_text(path, "".join(line + "\n" for line in kept))
    file = path.open("a", encoding="utf-8")
    try:
        yield RunLog(file, path, step)
    finally:
        with suppress(OSError):  # Every line was flushed when it was written.
            file.close()


def lines_until(path: Path, step: int) -> list[str]:
    """The legible lines of a log up to a step."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return [line for line in lines if 0 <= _step_of(line) <= step]


def _step_of(line: str) -> int:
    """The step of a line; -1 where it is none of a log."""
    try:
        step = json.loads(line)["step"]
    except (ValueError, KeyError, TypeError, IndexError, RecursionError):
        return -1
    return step if isinstance(step, int) else -1
