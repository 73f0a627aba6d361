"""The keyframes of a film: set where one stands, looked at, and saved for `glassplat video --path keyframes`."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from glassplat.publish.camera_paths import interpolated
from glassplat.scene.camera import Camera
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
        self.keyframes: list[Camera] = []
        self._is_playing = False

    def lay_out(self, go: Callable[[Camera], None], save: Callable[[str], None] | None) -> None:
        """Puts the controls there.

        Args:
            go: moves the client's camera.
            save: keeps the keyframes under a name; None where nothing may be written.
        """
        gui = self._handle.gui
        with gui.add_folder("Keyframes", expand_by_default=False):
            self._count = gui.add_markdown(self._counted())
            gui.add_button("Add this view").on_click(lambda _: self.add())
            gui.add_button("Remove the last").on_click(lambda _: self.remove())
            gui.add_button("Play or stop").on_click(lambda _: self.play(go))
            if save is not None:
                name = gui.add_text("Name", "keyframes")
                gui.add_button("Save keyframes").on_click(lambda _: save(name.value))

    def add(self) -> None:
        """One more keyframe, where the client stands."""
        camera = self._camera()
        if camera is None or len(self.keyframes) == MOST_KEYFRAMES:
            return
        self.keyframes.append(camera)
        frustum = self._handle.scene.add_camera_frustum(
            f"/keyframes/{len(self.keyframes)}",
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
        self._count.content = self._counted()

    def remove(self) -> None:
        """The last keyframe goes."""
        if self.keyframes:
            self.keyframes.pop()
            self._frusta.pop().remove()
            self._count.content = self._counted()

    def play(self, go: Callable[[Camera], None]) -> None:
        """Begins to move the client along the path as the film will, or stops that."""
        if self._is_playing or len(self.keyframes) < 2:
            self._is_playing = False
            return
        self._is_playing = True
        frames = (len(self.keyframes) - 1) * SECONDS_BETWEEN * PLAYED_PER_SECOND + 1
        # A thread of its own: viser has few, and all clients share them.
        threading.Thread(target=self._play, args=(interpolated(self.keyframes, frames), go), daemon=True).start()

    def _play(self, path: list[Camera], go: Callable[[Camera], None]) -> None:
        for camera in path:
            if not self._is_playing:
                return
            go(camera)
            time.sleep(1 / PLAYED_PER_SECOND)
        self._is_playing = False

    def stop(self) -> None:
        """Ends the playing, as when the client leaves."""
        self._is_playing = False

    def _counted(self) -> str:
        count = len(self.keyframes)
        return f"{count} {'keyframe' if count == 1 else 'keyframes'}" + (", a film needs two" if count < 2 else "")
