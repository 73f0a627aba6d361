"""The directory that a run leaves behind.

Where it must not be written, or holds no run, is found out without PyTorch: methods import what they need of it.
"""

from __future__ import annotations

import dataclasses
import json
import os
import re
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from glassplat.data.errors import InputError, first_names, input_checked
from glassplat.data.masks import Polarity
from glassplat.data.options import options_from_json
from glassplat.data.ranges import Downscale, Seed, Several
from glassplat.files.atomic import atomic_write
from glassplat.files.folders import check_folder, make_folder
from glassplat.files.json_text import parse_json, read_json
from glassplat.files.reading import read_text
from glassplat.train.run_lock import check_unlocked

if TYPE_CHECKING:
    from glassplat.data.dataset import Dataset
    from glassplat.scene.scene import Scene

CHECKPOINT_SECONDS = 120.0
"""What a power cut may cost at the most, unless the user says otherwise."""


@dataclass(frozen=True)
class RunSettings:
    """What was asked for, beside the recipe.

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


FILES = (
    "recipe.json",
    "settings.json",
    "log.jsonl",
    "cameras.json",
    "per_view.json",
    "sheets",
    "uses.png",
    "index.html",
)
"""What a run writes beside its checkpoint, scene and metrics."""
NUMBERED = re.compile(r"iteration_([0-9]{1,18})")
"""The folder of a scene; people keep copies under other names beside it."""


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
        """Where the newest checkpoint is."""
        return self.path / "checkpoint.safetensors"

    @property
    def log(self) -> Path:
        """Where the training log is."""
        return self.path / "log.jsonl"

    @property
    def results(self) -> Path:
        """Where the metrics are."""
        return self.path / "results.json"

    @property
    def imported(self) -> Path:
        """Where the source of a scene is recorded that has no capture: it was imported, or made in a program."""
        return self.path / "imported.json"

    @property
    def is_saved(self) -> bool:
        """Whether there is something in it that took training to make."""
        return any((self.path / name).exists() for name in (self.checkpoint.name, self.results.name, "point_cloud"))

    @property
    def is_begun(self) -> bool:
        """Whether a run was begun here, whatever has become of it."""
        try:
            self.recipe()
        except InputError:
            return False
        return True

    def check_begun(self) -> None:
        """Refuse what no run was begun in.

        Raises:
            InputError: there is no recipe.
        """
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
        from glassplat.files.cameras_json import write_cameras
        from glassplat.train.recipe import recipe_to_json

        make_folder(self.path)
        write_text(self.path / "recipe.json", recipe_to_json(recipe))
        write_text(self.path / "settings.json", json.dumps(dataclasses.asdict(settings), indent=2))
        write_cameras(self.path / "cameras.json", [(v.name, v.camera) for v in (*dataset.train, *dataset.test)])

    def write_refined(self, dataset: Dataset, scene: Scene) -> None:
        """Replaces the recorded cameras by those that training found, if it looked for them.

        `sparse/0` is the same as a COLMAP model, of the photographs as training saw them: undistorted and reduced.
        """
        from glassplat.data.corrected_views import with_corrected_cameras
        from glassplat.files.cameras_json import write_cameras
        from glassplat.files.colmap_text import write_colmap

        if not len(scene.poses):
            return
        refined = with_corrected_cameras(dataset, scene)
        cameras = [(view.name, view.camera) for view in (*refined.train, *refined.test)]
        write_cameras(self.path / "cameras.json", cameras)
        positions, colors = dataset.points.positions.numpy(), dataset.points.colors.numpy()
        write_colmap(self.path / "sparse" / "0", sorted(cameras, key=itemgetter(0)), positions, colors)

    def recipe(self) -> Any:
        """The recorded recipe."""
        from glassplat.train.recipe import recipe_from_json

        return recipe_from_json(self._read("recipe.json"), str(self.path / "recipe.json"))

    def was_begun_with(self, recipe: Any) -> bool:
        """Whether `begin` recorded just this recipe.

        Compared as written: `recipe()` gives options that an earlier version did not have their present defaults,
        with which the run was not made.
        """
        from glassplat.train.recipe import recipe_to_json

        written = self._read("recipe.json")
        return self.recipe() == recipe and parse_json(written, "recipe.json") == json.loads(recipe_to_json(recipe))

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

    def export(self, scene: Scene, step: int) -> Path:
        """Writes the scene in the formats that others read; returns its folder."""
        from glassplat.files.environment_image import write_equirect
        from glassplat.files.scene_folder import write_scene
        from glassplat.render.environment import equirect_from_environment

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


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
