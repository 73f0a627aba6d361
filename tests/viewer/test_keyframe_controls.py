"""Keyframes that are set, removed and played concurrently, as by quick clicks; steps from photograph to photograph."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import torch

from glassplat.scene.camera import Camera
from glassplat.viewer.controls import MOST_KEYFRAMES, KeyframeControls, PhotographControls
from glassplat.viewer.drawing import Viewpoints
from tests.training.tiny_capture import tiny_capture

CAMERAS = [view.camera for view in tiny_capture().train]


class Page:
    """The part of viser that the controls use: shows nothing, and maps the names of buttons to their callbacks."""

    def __init__(self) -> None:
        self.buttons: dict[str, Callable[[Any], None]] = {}
        self.gui = self.scene = self

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *unused: object) -> None:
        pass

    def add_folder(self, name: str, expand_by_default: bool) -> Page:
        return self

    def add_markdown(self, content: str) -> SimpleNamespace:
        return SimpleNamespace(content=content)

    def add_button(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(on_click=lambda act: self.buttons.update({name: act}))

    def add_camera_frustum(self, *given: object, **named: object) -> SimpleNamespace:
        return SimpleNamespace(remove=lambda: None)


def test_quick_clicks_at_once_leave_keyframes_that_fit_together() -> None:
    page, went = Page(), list[Camera]()
    controls = KeyframeControls(page, 1.0, lambda: random.choice(CAMERAS), went.append, None)
    failures: list[BaseException] = []

    def click(seed: int) -> None:
        draw = random.Random(seed)
        try:
            for _ in range(300):
                page.buttons[draw.choice(list(page.buttons))](None)
        except BaseException as error:  # noqa: BLE001 - A thread's error is reported by the test.
            failures.append(error)

    threads = [threading.Thread(target=click, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    controls.stop()
    assert not failures
    assert len(controls.keyframes) == len(controls._frusta) <= MOST_KEYFRAMES
    time.sleep(0.3)
    moves = len(went)
    time.sleep(0.5)
    assert moves and len(went) == moves


def test_the_number_of_keyframes_is_limited() -> None:
    page = Page()
    controls = KeyframeControls(page, 1.0, lambda: CAMERAS[0], lambda camera: None, None)
    for _ in range(MOST_KEYFRAMES + 5):
        page.buttons["Add this view"](None)
    assert len(controls.keyframes) == MOST_KEYFRAMES


def test_stopping_playback_stops_the_camera_at_once() -> None:
    page, began, moved = Page(), threading.Event(), list[Camera]()

    def go(camera: Camera) -> None:
        began.set()
        time.sleep(0.1)
        moved.append(camera)

    cameras = iter(CAMERAS)
    controls = KeyframeControls(page, 1.0, lambda: next(cameras), go, None)
    for name in ("Add this view", "Add this view", "Play or stop"):
        page.buttons[name](None)
    assert began.wait(10)
    controls.stop()
    moves = len(moved)
    time.sleep(0.5)
    assert moves and len(moved) == moves


def test_steps_lead_past_photographs_from_one_place() -> None:
    """At the position of one of them, another is equally near."""
    cameras = [(f"{k}.png", camera) for k, camera in enumerate((CAMERAS[0], CAMERAS[0], *CAMERAS[1:3]))]
    photo = torch.zeros(48, 64, 3, dtype=torch.uint8)
    gui, viewpoints = MagicMock(), Viewpoints([camera for _, camera in cameras], 1.0)
    photographs = {name: lambda: photo for name, _ in cameras}
    controls = PhotographControls(gui, SimpleNamespace(cameras=cameras, photographs=photographs), 0)
    stops, labels = [], []

    def stand_at(index: int) -> None:
        controls.mark_current(index)
        controls.show_nearest(index)
        pose = cameras[index][1].cam_from_world.double()
        controls.show_nearest(viewpoints.nearest((-pose[:3, :3].T @ pose[:3, 3]).numpy(), pose[2, :3].numpy()))
        stops.append(index)
        labels.append(gui.add_image.return_value.label)

    controls.listen(stand_at)
    gui.add_button_group.return_value.value = "next"
    for _ in range(5):
        gui.add_button_group.return_value.on_click.call_args[0][0](None)
    assert stops == [1, 2, 3, 0, 1]
    assert labels == [f"Nearest photograph: {index}.png" for index in stops]
