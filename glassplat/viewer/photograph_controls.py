"""The photographs: standing where one was taken, and the nearest one beside the view."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from glassplat.viewer.callbacks import survived
from glassplat.viewer.shown import Shown

PHOTO_WIDTH = 360
NO_PHOTOGRAPH = np.zeros((2, 3, 3), dtype=np.uint8)


class PhotographControls:
    """A folder of controls: a list of photographs to stand at, and the picture of the nearest one."""

    def __init__(self, gui: Any, shown: Shown, at: int) -> None:
        """Lays them out; they do nothing yet.

        Args:
            gui: of the client.
            shown: what is looked at.
            at: the photograph to begin with.
        """
        self._shown, self._at, self._on_screen = shown, at, -1
        self._names = tuple(name for name, _ in shown.cameras)
        with gui.add_folder("Photographs"):
            self._name = gui.add_dropdown("Stand at", self._names, initial_value=self._names[at])
            self._steps = gui.add_button_group("Step", ("previous", "next"))
            self._photo = None
            if shown.photographs:
                self._photo = gui.add_image(NO_PHOTOGRAPH, label="Nearest photograph")

    def listen(self, stand_at: Callable[[int], None]) -> None:
        """From now on they move the camera to where a photograph was taken, with `stand_at`."""
        names, steps = self._names, self._steps
        self._name.on_update(
            survived(lambda event: stand_at(names.index(self._name.value)) if event.client is not None else None)
        )
        steps.on_click(survived(lambda _: stand_at((self._at + (1 if steps.value == "next" else -1)) % len(names))))

    def stands_at(self, index: int) -> None:
        """The camera is where a photograph was taken."""
        self._at = index
        self._name.value = self._shown.cameras[index][0]

    def show_nearest(self, index: int) -> None:
        """Shows a photograph, unless it is there already; where it is gone or broken, says so in its place."""
        name = self._shown.cameras[index][0]
        if self._photo is None or index == self._on_screen or name not in self._shown.photographs:
            return
        self._at = self._on_screen = index
        try:
            photo = self._shown.photographs[name]()
        except (OSError, ValueError) as error:
            self._photo.image = NO_PHOTOGRAPH
            self._photo.label = f"Nearest photograph: {name} cannot be read ({error})"
            return
        step = max(1, photo.shape[1] // PHOTO_WIDTH)
        self._photo.image = photo[::step, ::step].numpy()
        self._photo.label = f"Nearest photograph: {name}"
