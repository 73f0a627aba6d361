"""Content of the viewer: a model, or a training run in progress."""

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
from glassplat.viewer.render_loop import RenderBudget, check_port
from glassplat.viewer.server import Viewer

VALID_NAME = re.compile(r"\w[\w .+-]{0,99}")
LEAST_KEYFRAMES = 2


class FolderWriter:
    """Writes edited scenes and keyframes to a folder, under unused names.

    Names come from browsers, and are checked not to lead out of the folder.
    """

    def __init__(self, model: Model, folder: Path) -> None:
        """Writes nothing yet.

        Args:
            model: the viewed model; edited scenes are saved with its recipe and cameras.
            folder: output folder; created when needed.
        """
        self._model, self._folder = model, folder

    def write_scene(self, scene: Scene, name: str) -> str:
        """Writes a scene in the layout of a run; returns a message.

        Raises:
            InputError: the name is not valid.
            FileExistsError: the name is taken; nothing was written.
            OSError: the disk is full, or the folder is not writable.
        """
        path = self._path(name)
        save_folder(self._model.with_scene(scene.to("cpu")), path)
        return f"{path}: view it with `glassplat view {quote(str(path))}`"

    def write_keyframes(self, cameras: Sequence[Camera], name: str) -> str:
        """Writes keyframe cameras; returns a message.

        Raises:
            InputError: there are too few keyframes, or the name is not valid.
            FileExistsError: the name is taken; nothing was written.
            OSError: the disk is full, or the folder is not writable.
        """
        if len(cameras) < LEAST_KEYFRAMES:
            raise InputError(f"a video needs at least two keyframes, not {len(cameras)}; add views first")
        path = self._path(f"{name.strip().removesuffix('.json')}.json")
        if os.path.lexists(path):
            raise FileExistsError(f"{path} already exists; nothing was written. Choose another name")
        make_folder(self._folder)
        write_cameras(path, [(f"keyframe {index}", camera) for index, camera in enumerate(cameras, start=1)])
        source = "RUN" if self._model.path is None else quote(str(self._model.path))
        return (
            f"{path}: render them with `glassplat video {source} --path keyframes --keyframes {quote(str(path))} "
            "--output video.mp4`"
        )

    def _path(self, name: str) -> Path:
        if VALID_NAME.fullmatch(name.strip()) is None:
            raise InputError(
                f"{name[:100]!r} is not a valid name; expected one that begins with a letter or digit, then letters, "
                "digits, spaces, dots, + and -, at most 100 of them"
            )
        return self._folder / name.strip()


REFRESH_SECONDS = 2.0
"""Seconds between two images of a scene in training while the camera does not move."""
PAUSE_SECONDS = 0.2
"""Seconds between checks for a stop request while training is paused."""


class WatchedTraining:
    """A viewer of a training run, which draws between its steps.

    The training thread draws, so that kernels are never entered concurrently and images show finished steps. Drawing
    takes at most 15 % of the time while a browser is connected.
    """

    def __init__(
        self, training: Training, dataset: Dataset, *, host: str, port: int, announce: Callable[[Viewer], None]
    ) -> None:
        """Prepares the viewer, which starts after the first step.

        Args:
            training: the training run; its messages have to be passed to `handle_message`.
            dataset: data set with the photographs to show.
            host: address to listen on.
            port: port to listen on.
            announce: called once the viewer runs.

        Raises:
            InputError: the port cannot be used.
        """
        check_port(host, port)
        self._training, self._dataset = training, dataset
        self._host, self._port, self._announce = host, port, announce
        self._viewer: Viewer | None = None
        self._share: RenderBudget | None = None
        self._refreshed = 0.0
        self._is_paused, self._is_save_requested = False, False

    def handle_message(self, message: Message) -> None:
        """Handles a message of the training run: draws, pauses and saves."""
        if not isinstance(message, StepDone):
            return
        if self._viewer is None or self._share is None:
            self._viewer = Viewer(self._state(), self._host, self._port, {"pause": self._pause, "save": self._save})
            self._share = RenderBudget(self._viewer.loop)
            self._announce(self._viewer)
        if self._viewer.is_watched:
            self._update(self._viewer, message)
        self._share.draw()
        self._handle_requests(self._viewer, message)

    def stop(self) -> None:
        """Stops the viewer."""
        if self._viewer is not None:
            self._viewer.stop()

    def _state(self) -> ViewerState:
        views = (*self._dataset.train, *self._dataset.test)
        return viewer_state(self._training.model, {view.name: view.read_photo for view in views})

    def _update(self, viewer: Viewer, message: StepDone) -> None:
        """Shows the current scene, and requests new images at intervals."""
        scene = self._training.state.scene  # Not `model`, which would correct all cameras at every step.
        viewer.replace_scene(scene, current_renderer(self._training.recipe, scene))
        now = time.monotonic()
        if now - self._refreshed >= REFRESH_SECONDS and viewer.loop.expected_seconds() is None:
            self._refreshed = now
            viewer.refresh(self._status(message))

    def _handle_requests(self, viewer: Viewer, message: StepDone) -> None:
        """Saves if requested, and waits while paused, drawing without a time limit."""
        while self._is_save_requested or (self._is_paused and not self._training.is_stopping):
            if self._is_save_requested:
                self._is_save_requested = False
                try:
                    self._training.save()
                    outcome = "saved"
                except Exception as error:  # noqa: BLE001 - A click must never end the training.
                    outcome = f"not saved: {error}"
                viewer.refresh(f"{self._status(message)}, {outcome}")
            if self._is_paused and not viewer.loop.serve():
                viewer.loop.wait(PAUSE_SECONDS)

    def _status(self, message: StepDone) -> str:
        paused = ", paused" if self._is_paused else ""
        return f"step {message.step} of {self._training.iterations}, loss {message.loss:.4f}{paused}"

    def _pause(self) -> None:
        """Pauses or continues; called from the viewer's threads."""
        self._is_paused = not self._is_paused
        if self._viewer is not None:
            self._viewer.refresh("paused" if self._is_paused else "going on")

    def _save(self) -> None:
        self._is_save_requested = True


def current_renderer(recipe: Any, scene: Scene) -> Renderer:
    """The recipe's renderer, or a plain one while the scene lacks the parts that it needs."""
    renderer: Renderer = recipe.renderer()
    try:
        renderer.check(scene)
    except ValueError:
        return Splat(recipe.background)
    return renderer
