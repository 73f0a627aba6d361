"""What was made in the viewer, written beside what was opened."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path
from shlex import quote

from glassplat.data.errors import InputError
from glassplat.files.cameras_json import write_cameras
from glassplat.files.folders import make_folder
from glassplat.interface.model import Model
from glassplat.interface.saving import save_folder
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene

NAME = re.compile(r"\w[\w .+-]{0,99}")
LEAST_KEYFRAMES = 2


class KeptBeside:
    """Writes edited scenes and keyframes into one folder, under names of which none is taken.

    The names come from browsers, so that none leads out of the folder.
    """

    def __init__(self, model: Model, folder: Path) -> None:
        """Writes nothing yet.

        Args:
            model: what is looked at; an edited scene is saved with its recipe and cameras.
            folder: where things go; made when it is needed.
        """
        self._model, self._folder = model, folder

    def keep_scene(self, scene: Scene, name: str) -> str:
        """Writes a scene as a run of its own; returns what to say.

        Raises:
            InputError: it cannot have that name.
            FileExistsError: the name is taken; nothing was written.
            OSError: the disk is full, or nothing may be written.
        """
        path = self._path(name)
        save_folder(self._model.with_scene(scene.to("cpu")), path)
        return f"{path}: look at it with `glassplat view {quote(str(path))}`"

    def keep_keyframes(self, cameras: Sequence[Camera], name: str) -> str:
        """Writes the cameras of a film; returns what to say.

        Raises:
            InputError: they are too few, or cannot have that name.
            FileExistsError: the name is taken; nothing was written.
            OSError: the disk is full, or nothing may be written.
        """
        if len(cameras) < LEAST_KEYFRAMES:
            raise InputError(f"a film needs at least two keyframes, not {len(cameras)}; add views first")
        path = self._path(f"{name.strip().removesuffix('.json')}.json")
        if os.path.lexists(path):
            raise FileExistsError(f"{path} is already there; nothing was written. Choose another name")
        make_folder(self._folder)
        write_cameras(path, [(f"keyframe {index}", camera) for index, camera in enumerate(cameras, start=1)])
        source = "RUN" if self._model.path is None else quote(str(self._model.path))
        return (
            f"{path}: film them with `glassplat video {source} --path keyframes --keyframes {quote(str(path))} "
            "--output film.mp4`"
        )

    def _path(self, name: str) -> Path:
        if NAME.fullmatch(name.strip()) is None:
            raise InputError(
                f"{name[:100]!r} cannot be a name here; expected one that begins with a letter or digit, then letters, "
                "digits, spaces, dots, + and -, at most 100 of them"
            )
        return self._folder / name.strip()
