"""The keyframes of a film: set where one stands, looked at, and saved for `glassplat video --path keyframes`."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from glassplat.publish.camera_paths import interpolated
from glassplat.scene.camera import Camera
from glassplat.viewer.callbacks import survived
from glassplat.viewer.rotations import wxyz_of

MOST_KEYFRAMES = 200
FRUSTUM_SHARE = 0.06
"""Size of a keyframe in the view, of the scene's extent."""
PLAYED_PER_SECOND, SECONDS_BETWEEN = 8, 2
KEYFRAME_COLOR = (249, 140, 10)


class KeyframeControls:
    """A folder of controls, and the keyframes as small cameras in the view. They outlive a new layout."""

    def __init__(self, handle: Any, extent: float, camera: Callable[[], Camera | None]) -> None:
        """Has no keyframe yet, and no controls before `lay_out`.

        Args:
            handle: of the client.
            extent: of the scene, world units.
            camera: where the client stands now, None while that is not known.
        """
        self._handle, self._extent, self._camera = handle, extent, camera
        self._frusta: list[Any] = []
        self.keyframes: tuple[Camera, ...] = ()
        self._playing: threading.Event | None = None
        # viser's threads call at once what is clicked in quick succession.
        self._lock = threading.Lock()
        self._step = threading.Lock()

    def lay_out(self, go: Callable[[Camera], None], save: Callable[[str], None] | None) -> None:
        """Puts the controls there.

        Args:
            go: moves the client's camera.
            save: keeps the keyframes under a name; None where nothing may be written.
        """
        gui = self._handle.gui
        with gui.add_folder("Keyframes", expand_by_default=False):
            self._count = gui.add_markdown(self._counted())
            gui.add_button("Add this view").on_click(survived(lambda _: self.add()))
            gui.add_button("Remove the last").on_click(survived(lambda _: self.remove()))
            gui.add_button("Play or stop").on_click(survived(lambda _: self.play(go)))
            if save is not None:
                name = gui.add_text("Name", "keyframes")
                gui.add_button("Save keyframes").on_click(survived(lambda _: save(name.value)))

    def add(self) -> None:
        """One more keyframe, where the client stands."""
        camera = self._camera()
        with self._lock:
            if camera is None or len(self._frusta) == MOST_KEYFRAMES:
                return
            frustum = self._handle.scene.add_camera_frustum(
                f"/keyframes/{len(self._frusta)}",
                2 * float(np.arctan(camera.height / 2 / camera.fy)),
                camera.width / camera.height,
                scale=FRUSTUM_SHARE * self._extent,
                thickness=2.0,
                thickness_units="screen",
                color=KEYFRAME_COLOR,
                wxyz=wxyz_of(camera.cam_from_world[:3, :3].double().numpy().T),
                position=camera.center.double().numpy(),
            )
            self._frusta.append(frustum)
            self.keyframes = (*self.keyframes, camera)
            self._count.content = self._counted()

    def remove(self) -> None:
        """The last keyframe goes."""
        with self._lock:
            if self._frusta:
                self._frusta.pop().remove()
                self.keyframes = self.keyframes[:-1]
                self._count.content = self._counted()

    def play(self, go: Callable[[Camera], None]) -> None:
        """Begins to move the client along the path as the film will, or stops that."""
        keyframes = self.keyframes
        with self._lock:
            was_playing = self._playing is not None and not self._playing.is_set()
            self.stop()
            if was_playing or len(keyframes) < 2:
                return
            ended = self._playing = threading.Event()
        frames = (len(keyframes) - 1) * SECONDS_BETWEEN * PLAYED_PER_SECOND + 1
        # A thread of its own: viser has few, and all clients share them.
        path = interpolated(keyframes, frames)
        threading.Thread(target=_play, args=(path, go, ended, self._step), daemon=True).start()

    def stop(self) -> None:
        """Ends the playing, as when the client leaves or stands elsewhere; nothing moves it afterwards."""
        with self._step:
            if self._playing is not None:
                self._playing.set()

    def _counted(self) -> str:
        count = len(self.keyframes)
        return f"{count} {'keyframe' if count == 1 else 'keyframes'}" + (", a film needs two" if count < 2 else "")


def _play(path: list[Camera], go: Callable[[Camera], None], ended: threading.Event, step: threading.Lock) -> None:
    """Moves along a path until it or the playing ends; `step` is held while it moves."""
    for camera in path:
        with step:
            if ended.is_set():
                return
            go(camera)
        if ended.wait(1 / PLAYED_PER_SECOND):
            return
    ended.set()
