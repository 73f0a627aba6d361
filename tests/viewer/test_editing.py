"""Panes are moved with the mouse, keyframes set, and both saved, by the steps of a user in the browser."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np
import torch

import glassplat
from glassplat.files.sidecars import read_cameras
from glassplat.model.watching import FolderWriter, viewer_state
from glassplat.scene.camera import Camera
from glassplat.viewer.controls import HANDLE_SHARE, PaneControls
from glassplat.viewer.server import Client, Viewer
from tests.browser_needed import needs_browser
from tests.model.test_model import model
from tests.training.tiny_capture import tiny_capture, true_scene
from tests.viewer.free_port import free_port
from tests.viewer.test_server import eventually
from tools.browser import Browser

WINDOW = (1200, 700)
"""Wide enough that the controls do not cover a pane."""
FIND = """
    const all = [...document.querySelectorAll('body *')].filter(one => one.textContent.trim() === arguments[0]);
    const one = all.length && all[all.length - 1].getBoundingClientRect().height ? all[all.length - 1] : null;
"""
"""The smallest element with exactly this text, if it has been laid out."""
PHOTOGRAPHS = {view.name: (lambda view=view: view.photo) for view in tiny_capture().train}


@contextmanager
def watched(folder: Path) -> Iterator[tuple[Viewer, Client, Browser]]:
    """A viewer of the tiny scene with one browser, which writes into a folder."""
    state = viewer_state(model(), PHOTOGRAPHS, FolderWriter(model(), folder))
    viewer = Viewer(state, "127.0.0.1", free_port())
    viewer.start()
    try:
        with Browser(viewer.address, *WINDOW) as browser:
            eventually(lambda: bool(viewer._clients))
            (client,) = viewer._clients.values()
            eventually(lambda: "Edited scene" in browser.evaluate("document.body.innerText"))
            yield viewer, client, browser
    finally:
        viewer.stop()


def click(browser: Browser, text: str) -> None:
    """Clicks the element with exactly this text, wherever it is on the page, as soon as it exists."""
    eventually(lambda: browser.run(f"{FIND} if (one) one.click(); return one !== null", text))


def press(browser: Browser, text: str, happens: Callable[[], bool]) -> None:
    """Clicks, again if necessary, until it happens: a click just after another message to the server may be lost."""
    for _ in range(6):
        click(browser, text)
        with contextlib.suppress(AssertionError):
            return eventually(happens, 10)
    raise AssertionError(f"pressing {text!r} did nothing")


def says(browser: Browser, text: str) -> bool:
    return text in browser.evaluate("document.body.innerText")


def on_screen(client: Client, point: torch.Tensor) -> tuple[float, float]:
    """Projects a point to pixels of the window."""
    camera = client.camera()
    assert camera is not None
    x, y, z = (camera.cam_from_world[:3, :3] @ point + camera.cam_from_world[:3, 3]).tolist()
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def unfold(browser: Browser, title: str, content: str) -> None:
    """Opens a folder of controls; a page whose layout is not finished may miss a click."""

    def is_open() -> bool:
        found = browser.run(f"{FIND} return one !== null", content)
        if not found:
            click(browser, title)
            time.sleep(1)
        return bool(found)

    eventually(is_open)


@needs_browser
def test_panes_and_keyframes_are_edited_and_saved_in_the_browser(tmp_path: Path) -> None:
    with watched(tmp_path) as (viewer, client, browser):
        step = pane_is_dragged(client, browser)
        unfold(browser, "Edited scene", "Save as a run")
        click(browser, "Save as a run")
        eventually(lambda: says(browser, "view it with"))
        click(browser, "Save as a run")
        eventually(lambda: says(browser, "already exists and is not empty"))
        click(browser, "Reset panes")
        eventually(lambda: not client.request().moves)
        stood = keyframes_are_set_and_played(client, browser)
        error_is_shown(viewer, client, browser)
    saved = glassplat.load(tmp_path / "tiny-edited", device="cpu").scene
    torch.testing.assert_close(saved.planes.centers[0], true_scene().planes.centers[0] + step)
    assert torch.equal(saved.primary.means, true_scene().primary.means)
    keyframes = [camera for _, camera in read_cameras(tmp_path / "keyframes.json")]
    assert len(keyframes) == 2
    for camera, expected in zip(keyframes, stood[:2], strict=True):
        torch.testing.assert_close(camera.cam_from_world, expected.cam_from_world, atol=1e-5, rtol=0)
        # A browser reports the size of its image late; the angle is the same for all sizes.
        assert abs(camera.fy / camera.height - expected.fy / expected.height) < 1e-3


def pane_is_dragged(client: Client, browser: Browser) -> torch.Tensor:
    """Drags the pane along one of its sides, by an arrow of its gizmo; returns the translation [3]."""
    planes = true_scene().planes
    center, side = planes.centers[0], planes.axes()[1][0]
    arrow = HANDLE_SHARE * float(planes.half_sizes[0].mean())
    client._panes._chosen.value = "1"

    def is_dragged() -> bool:
        client.go_to_photograph(2)
        eventually(lambda: client._nearest == 2)
        time.sleep(0.5)  # The gizmo is drawn after the camera has moved.
        browser.drag([on_screen(client, center + arrow * length * side) for length in (0.85, 1.3)])
        time.sleep(0.5)
        return bool(client.request().moves)

    eventually(is_dragged)
    ((label, turn, step),) = client.request().moves
    assert (label, turn) == (1, (1.0, 0.0, 0.0, 0.0))
    found = torch.tensor(step, dtype=torch.float32)
    assert float(found @ side) > 0.2 * arrow
    torch.testing.assert_close(found, (found @ side) * side, atol=1e-4, rtol=0)
    return found


def keyframes_are_set_and_played(client: Client, browser: Browser) -> list[Camera]:
    """Sets three keyframes, removes one, plays and saves; returns the cameras of the browser."""
    unfold(browser, "Keyframes", "Add this view")
    stood: list[Camera] = []
    for index in (1, 4, 0):
        client.go_to_photograph(index)
        eventually(lambda index=index: client._nearest == index)
        press(browser, "Add this view", lambda: len(client.keyframes.keyframes) == len(stood) + 1)
        stood.append(client.camera())
    press(browser, "Remove last", lambda: len(client.keyframes.keyframes) == 2)
    eventually(lambda: says(browser, "2 keyframes"))
    press(browser, "Play or stop", lambda: client._nearest in (2, 3))
    eventually(lambda: client._nearest == 4)
    press(browser, "Save keyframes", lambda: says(browser, "render them with"))
    return stood


def error_is_shown(viewer: Viewer, client: Client, browser: Browser) -> None:
    """The error layer compares with the photograph shown next to it, and follows edits."""
    client.go_to_photograph(3)
    eventually(lambda: says(browser, "Nearest photograph: 3.png"))
    pictures: list[np.ndarray] = []
    show = viewer._show
    viewer.loop._show = lambda to, picture, is_sharp: (pictures.append(picture), show(to, picture, is_sharp))
    client._layer.value = "error"
    # The browser may report its previous pose once more before it follows.
    eventually(lambda: client.request().compared_photograph == 3)
    eventually(lambda: bool(pictures) and pictures[-1][..., 0].max() <= 5)
    client._panes._glass.value = "mirror"
    eventually(lambda: pictures[-1][..., 0].max() > 100)


def test_controls_may_be_used_as_soon_as_they_are_there() -> None:
    handle, control = mock.MagicMock(), mock.MagicMock()
    control.on_update.side_effect = control.on_click.side_effect = lambda act: act(None)
    handle.gui.add_dropdown.return_value = handle.gui.add_slider.return_value = control
    handle.gui.add_button.return_value = control
    asked: list[None] = []
    planes = true_scene().planes
    controls = PaneControls(handle, planes)
    assert not control.on_update.called and not control.on_click.called
    controls.listen(lambda: asked.append(None))
    assert len(asked) == 3 + len(planes)
