"""Places named on the command line: scenes to read, edits of them, folders to write into, and splits."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from glassplat.cli.console import message_console, print_line, shell_word
from glassplat.errors import InputError, convert_to_input_error, count_noun, join_names
from glassplat.files.records import read_json, readable_name, wrap_read_errors
from glassplat.files.writing import (
    LOADABLE,
    SPLAT_SUFFIXES,
    check_folder,
    make_folder,
    real_path,
    scene_source,
    write_text,
)
from glassplat.kernels.backend.devices import DeviceName
from glassplat.model.run_directory import RunDirectory
from glassplat.options import Angle, Coordinate, PaneLabel, Share, Up

if TYPE_CHECKING:
    from glassplat.captures.dataset import Dataset
    from glassplat.captures.view import View
    from glassplat.model.model import Model
    from glassplat.scene.scene import Scene

RECORD = "glassplat.json"
"""Marks a folder as written by one of the commands."""


def claim_folder(folder: Path, command: str, run: Path) -> bool:
    """Makes an output folder and records the command that owns it; returns whether images in it are replaced."""
    found = check_claim(folder, command)
    make_folder(folder)
    write_text(folder / RECORD, json.dumps({"command": command, "run": readable_name(run)}) + "\n")
    return found


def check_claim(folder: Path, command: str) -> bool:
    """Check that a command may write to a folder; returns whether it has done so before."""
    check_folder(folder)
    found = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    if found and recorded_value(folder / RECORD, "command") != command:
        raise InputError(
            f"{folder} is not empty, and not from `glassplat {command}` (it holds {join_names(found)}); nothing was "
            "written. Choose a new folder for --output"
        )
    return bool(found)


def check_targets(folder: Path, targets: Sequence[Path], photographs: Sequence[Path]) -> None:
    """Refuse to write through links in a reused folder that lead outside or to a photograph.

    Args:
        folder: output folder.
        targets: the files to write, in it, and folders that they go into.
        photographs: files that must never be overwritten.
    """
    inside, protected = real_path(folder), {real_path(path) for path in photographs}
    for target in (folder / RECORD, *targets):
        real = real_path(target)
        if real in protected or not real.is_relative_to(inside):
            what = "is a photograph of the capture" if real in protected else f"leads out of {folder}, to {real}"
            raise InputError(f"{target} {what}; nothing was written. Choose a new folder for --output")
        if os.path.lexists(real) and not (os.path.isfile(real) or os.path.isdir(real)):
            raise InputError(
                f"{target} is a pipe, a device or a broken link; nothing was written. Choose a new folder for --output"
            )


def recorded_value(record: Path, name: str) -> object:
    """A value of a folder's record, such as the command that wrote the folder; None if it is not recorded."""
    try:
        content = read_json(record)
    except (OSError, ValueError):
        return None
    return content.get(name) if isinstance(content, dict) else None


def check_scene(path: Path) -> None:
    """Checks that a path is a run, an exported scene or a readable splat file."""
    path = scene_source(path)
    if path.is_file() or (path.suffix and not path.is_dir()):
        check_file(path, LOADABLE)
        if path.suffix.lower() not in SPLAT_SUFFIXES:
            raise InputError(f"{path} is not a splat file by its name; expected {LOADABLE}")
        return
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist; expected {LOADABLE}")
    if not (path / "recipe.json").is_file():
        raise InputError(
            f"{path} holds no scene; expected {LOADABLE}. `glassplat info {shell_word(path)}` says what it is"
        )
    RunDirectory(path).check_begun()


def print_scene(path: Path) -> None:
    """Prints the method and length of a run, or the size of a splat file, before it is loaded."""
    print_line(message_console(), f"{path}: {_describe_scene(path)}")


def _describe_scene(path: Path) -> str:
    source = scene_source(path)
    if source.is_file():
        return f"{'a splat file' if source == path else 'an exported scene'} of {source.stat().st_size / 1e6:.1f} MB"
    directory = RunDirectory(path)
    if directory.import_record.is_file():
        return "a scene without a capture"
    recipe, settings = directory.recipe(), directory.settings()
    return f"a {recipe.method} run of {count_noun(settings.iterations, 'iteration')} on {settings.data}"


def check_file(path: Path, expected: str) -> None:
    """Checks that a file can be read; the message about a missing one says what was expected."""
    if not os.path.lexists(path):
        raise FileNotFoundError(f"{path} does not exist; expected {expected}")
    with convert_to_input_error(), wrap_read_errors(path), path.open("rb"):
        pass


@dataclass(frozen=True)
class SplatFile:
    """Properties of a scene that a run records and a splat file does not.

    Attributes:
        planes: panes of a splat file: planes.json, written by hand or by `export`; by default the one next to it.
        up: up direction of a splat file, from which its cameras are placed (y points down in most files); ignored if
            there is a cameras.json next to the file, as `export` writes it.
    """

    planes: Path | None = None
    up: Up = "-y"

    def check(self) -> None:
        """Checks that the panes can be read."""
        if self.planes is not None:
            check_file(self.planes, "panes as in the planes.json of a capture, a run or an export")

    def open(self, path: Path, device: DeviceName) -> Model:
        """The run or the splat file at a path."""
        from glassplat.model.model import load

        return load(path, device=device, planes=self.planes, up=self.up)


@dataclass(frozen=True)
class SceneEdits:
    """Changes to panes and surroundings, which leave the run unchanged. Pane labels are those of the masks.

    Attributes:
        remove_glass: remove all reflections and show only what is behind the panes.
        as_mirror: labels of panes to turn into perfect mirrors.
        reflectance: pane label and its reflectance R0 at normal incidence, 0 to 1; `--reflectance 1 0.5 2 0`.
        tilt: pane label and two angles in degrees, about the pane's first and second side; `--tilt 1 10 0`.
        shift: pane label and a signed distance along the pane's normal, in world units (those of the capture's poses);
            results.json has the normal; `--shift 1 0.05`.
        surroundings: panorama (.exr or .png, equirectangular, z up) to be reflected by glossy objects instead of their
            learned surroundings.
    """

    remove_glass: bool = False
    as_mirror: tuple[PaneLabel, ...] = ()
    reflectance: dict[PaneLabel, Share] = field(default_factory=dict)
    tilt: dict[PaneLabel, tuple[Angle, Angle]] = field(default_factory=dict)
    shift: dict[PaneLabel, Coordinate] = field(default_factory=dict)
    surroundings: Path | None = None

    def apply(self, scene: Scene) -> Scene:
        """The edited scene."""
        from glassplat.scene.scene import (
            as_mirrors,
            glass_of_pane,
            row_of_label,
            shift_pane,
            tilt_pane,
            with_reflectance,
            without_glass,
        )

        if self.surroundings is not None:
            scene = replace_environment(scene, self.surroundings)
        if replace(self, surroundings=None) == SceneEdits():
            return scene
        self._check(scene)
        with convert_to_input_error():
            for label, reflectance in self.reflectance.items():
                scene = with_reflectance(scene, label, reflectance)
            moved = {*self.tilt, *self.shift}
            owned = {label: glass_of_pane(scene, row_of_label(scene.planes, label)) for label in moved}
            for label, angles in self.tilt.items():
                scene = tilt_pane(scene, label, *angles, owned=owned[label])
            for label, distance in self.shift.items():
                scene = shift_pane(scene, label, distance, owned=owned[label])
            scene = as_mirrors(scene, self.as_mirror)
        return without_glass(scene) if self.remove_glass else scene

    def _check(self, scene: Scene) -> None:
        if not len(scene.planes):
            raise InputError("the scene has no panes to edit; train it with `glassplat train planar` and pane masks")
        if self.remove_glass and replace(self, surroundings=None) != SceneEdits(remove_glass=True):
            raise InputError("--remove-glass leaves no pane to edit; give it without the other edits")
        twice = sorted(set(self.as_mirror) & set(self.reflectance))
        if twice:
            raise InputError(f"panes {twice} have a --reflectance and are --as-mirror; give one of the two")


def replace_environment(scene: Scene, panorama: Path) -> Scene:
    """The scene with another environment, at the resolution of its own, and without near surroundings."""
    from glassplat.files.sidecars import read_equirect
    from glassplat.render.deferred import environment_from_equirect
    from glassplat.scene.gaussians import Gaussians

    if scene.environment.is_empty and not len(scene.surroundings):
        raise InputError("nothing in the scene reflects an environment; train it with `glassplat train deferred`")
    with convert_to_input_error():
        image = read_equirect(panorama)
        size = scene.environment.size or min(LARGEST_FACE, max(1, image.shape[0] // 2))
        environment = environment_from_equirect(image, size)
    raw = environment.raw.to(scene.primary.means)
    return replace(scene, environment=replace(scene.environment, raw=raw), surroundings=Gaussians.empty())


LARGEST_FACE = 512
"""Texels along a face of the new environment if the scene had none."""


Split = Literal["train", "test", "all"]


def chosen_views(dataset: Dataset, split: Split) -> tuple[View, ...]:
    """The views of a split, by name."""
    parts = {"train": dataset.train, "test": dataset.test, "all": (*dataset.train, *dataset.test)}
    if not parts[split]:
        raise InputError(f"{dataset.root} has no {split} views; choose another --split")
    return tuple(sorted(parts[split], key=lambda view: view.name))
