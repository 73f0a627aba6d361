"""A model, or a training while it goes on, as something to look at."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from shlex import quote
from typing import Any

from glassplat.captures.dataset import Dataset
from glassplat.errors import InputError
from glassplat.files.sidecars import write_cameras
from glassplat.files.writing import make_folder
from glassplat.model.model import Model, save_folder, viewer_state
from glassplat.model.training import Training
from glassplat.render.frame import Renderer
from glassplat.render.splat import Splat
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene
from glassplat.training.messages import Message, StepDone
from glassplat.viewer.drawing import ViewerState
from glassplat.viewer.render_loop import DrawingShare, check_port
from glassplat.viewer.server import Viewer

NAME = re.compile(r"\w[\w .+-]{0,99}")
LEAST_KEYFRAMES = 2


class FolderWriter:
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

    def write_scene(self, scene: Scene, name: str) -> str:
        """Writes a scene as a run of its own; returns what to say.

        Raises:
            InputError: it cannot have that name.
            FileExistsError: the name is taken; nothing was written.
            OSError: the disk is full, or nothing may be written.
        """
        path = self._path(name)
        save_folder(self._model.with_scene(scene.to("cpu")), path)
        return f"{path}: look at it with `glassplat view {quote(str(path))}`"

    def write_keyframes(self, cameras: Sequence[Camera], name: str) -> str:
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


REFRESH_SECONDS = 2.0
"""From one picture of a scene that is being trained to the next, where nobody moves."""
PAUSE_SECONDS = 0.2
"""How soon a paused training hears that it should end."""


class WatchedTraining:
    """A viewer next to a training, which draws between its steps.

    The thread that trains draws, so that no kernel is entered twice and every picture is of a finished step. Drawing
    takes at most 15 % of the time while a browser is connected, and none while there is none.
    """

    def __init__(
        self, training: Training, dataset: Dataset, *, host: str, port: int, announce: Callable[[Viewer], None]
    ) -> None:
        """Does nothing yet: there is something to look at after the first step.

        Args:
            training: to be watched; its messages go to `hear`.
            dataset: whose photographs are shown.
            host: who may look.
            port: where the browser finds it.
            announce: is told once the viewer is there.

        Raises:
            InputError: the port cannot be used.
        """
        check_port(host, port)
        self._training, self._dataset = training, dataset
        self._host, self._port, self._announce = host, port, announce
        self._viewer: Viewer | None = None
        self._share: DrawingShare | None = None
        self._refreshed = 0.0
        self._is_paused, self._is_save_asked = False, False

    def hear(self, message: Message) -> None:
        """Follows the training; here it is drawn, paused and saved."""
        if not isinstance(message, StepDone):
            return
        if self._viewer is None or self._share is None:
            self._viewer = Viewer(self._state(), self._host, self._port, {"pause": self._pause, "save": self._save})
            self._share = DrawingShare(self._viewer.loop)
            self._announce(self._viewer)
        if self._viewer.is_watched:
            self._update(self._viewer, message)
        self._share.draw()
        self._obey(self._viewer, message)

    def stop(self) -> None:
        """Ends the viewer."""
        if self._viewer is not None:
            self._viewer.stop()

    def _state(self) -> ViewerState:
        views = (*self._dataset.train, *self._dataset.test)
        return viewer_state(self._training.model, {view.name: view.read_photo for view in views})

    def _update(self, viewer: Viewer, message: StepDone) -> None:
        """Shows the scene as it is now, and asks for pictures of it now and then."""
        scene = self._training.state.scene  # Not that of its model, whose cameras would be corrected at every step.
        viewer.change(scene, renderer_now(self._training.recipe, scene))
        now = time.monotonic()
        if now - self._refreshed >= REFRESH_SECONDS and viewer.loop.expected_seconds() is None:
            self._refreshed = now
            viewer.refresh(self._status(message))

    def _obey(self, viewer: Viewer, message: StepDone) -> None:
        """Saves, and waits while it is paused; pictures are then drawn as fast as they can be."""
        while self._is_save_asked or (self._is_paused and not self._training.is_stopping):
            if self._is_save_asked:
                self._is_save_asked = False
                try:
                    self._training.save()
                    outcome = "saved"
                except Exception as error:  # noqa: BLE001 - Whatever it is, the training does not end by a click.
                    outcome = f"not saved: {error}"
                viewer.refresh(f"{self._status(message)}, {outcome}")
            if self._is_paused and not viewer.loop.serve():
                viewer.loop.wait(PAUSE_SECONDS)

    def _status(self, message: StepDone) -> str:
        paused = ", paused" if self._is_paused else ""
        return f"step {message.step} of {self._training.iterations}, loss {message.loss:.4f}{paused}"

    def _pause(self) -> None:
        """Pauses, or goes on; called by the viewer's threads."""
        self._is_paused = not self._is_paused
        if self._viewer is not None:
            self._viewer.refresh("paused" if self._is_paused else "going on")

    def _save(self) -> None:
        self._is_save_asked = True


def renderer_now(recipe: Any, scene: Scene) -> Renderer:
    """The recipe's renderer, or, where the scene lacks what that needs yet, a plain one."""
    renderer: Renderer = recipe.renderer()
    try:
        renderer.check(scene)
    except ValueError:
        return Splat(recipe.background)
    return renderer
