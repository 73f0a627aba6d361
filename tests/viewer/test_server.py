"""The viewer serves a browser."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import urlsplit

import numpy as np
import pytest

from glassplat.cli.main import main, parse_arguments
from glassplat.render.planar import Planar
from glassplat.viewer.drawing import ViewerState
from glassplat.viewer.server import WAITING_NOTIFICATION, Client, Viewer
from tests.browser_needed import needs_browser
from tests.cli.tiny_run import write_run
from tests.training.tiny_capture import tiny_capture, true_scene
from tests.viewer.free_port import free_port
from tools.browser import Browser

pytestmark = pytest.mark.usefixtures("one_chromium")
VIEWS = tiny_capture().train
STATE = ViewerState(
    "tiny",
    true_scene(),
    Planar(),
    [(view.name, view.camera) for view in VIEWS],
    {view.name: lambda: VIEWS[0].photo for view in VIEWS},
)


def eventually(happens: Callable[[], bool], seconds: float = 120) -> None:
    """Waits for an asynchronous action of a browser."""
    deadline = time.monotonic() + seconds
    while not happens():
        assert time.monotonic() < deadline, "it did not happen"
        time.sleep(0.05)


@pytest.mark.parametrize(
    ("host", "shown"),
    [("2001:db8::5", "[2001:db8::5]"), ("192.0.2.1", "192.0.2.1"), ("gpu.lan", "gpu.lan"), ("::1", "localhost")],
)
def test_the_address_is_one_that_browsers_understand(host: str, shown: str) -> None:
    viewer = SimpleNamespace(host=host, port=8080, access=SimpleNamespace(key="k"))
    address = Viewer.address.fget(viewer)
    assert address == f"http://{shown}:8080/?key=k"
    assert urlsplit(address).port == 8080 and urlsplit(address).hostname == shown.strip("[]")


@pytest.mark.parametrize("extent", [1e-3, 1e4])
def test_handles_are_drawn_in_any_unit(extent: float) -> None:
    handle = SimpleNamespace(camera=SimpleNamespace(near=0.01, far=1000.0), atomic=nullcontext)
    viewer = SimpleNamespace(state=SimpleNamespace(scene=SimpleNamespace(extent=extent)), focus=np.zeros(3))
    Client.move_camera(SimpleNamespace(_handle=handle, _viewer=viewer), VIEWS[0].camera)
    assert handle.camera.near < 0.1 * extent < 10 * extent < handle.camera.far


def test_a_photograph_that_is_not_there_is_named() -> None:
    viewer = SimpleNamespace(state=replace(STATE, photographs={}))
    with pytest.raises(ValueError, match=r"there is no photograph 0\.png to compare with"):
        Viewer._read_photograph(viewer, 0)


@needs_browser
def test_a_browser_shows_sharp_images_and_may_disconnect() -> None:
    viewer = Viewer(STATE, "127.0.0.1", free_port())
    viewer.start()
    shown: list[bool] = []
    show = viewer._show
    viewer.loop._show = lambda client, picture, is_sharp: (shown.append(is_sharp), show(client, picture, is_sharp))
    try:
        with Browser(viewer.address, 400, 300) as browser:
            eventually(lambda: any(shown))
            eventually(lambda: WAITING_NOTIFICATION[1] not in browser.evaluate("document.body.innerText"))
            (client,) = viewer._clients.values()
            shown.clear()
            client.go_to_photograph(2)
            client._panes._glass.value = "mirror"
            eventually(lambda: any(shown))
            eventually(lambda: "Layer" in browser.evaluate("document.body.innerText"))
            client.save_scene("mine")
            client.save_keyframes("mine")
            assert "Edited scene" not in browser.evaluate("document.body.innerText")  # No output folder was given.
        eventually(lambda: not viewer._clients)
    finally:
        viewer.stop()


def test_a_port_in_use_gets_a_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert main(["view", str(run), "--port", str(taken.getsockname()[1])]) == 2
    assert "choose another --port" in " ".join(capsys.readouterr().err.split())


@needs_browser
def test_a_message_is_shown_until_the_first_image() -> None:
    viewer = Viewer(STATE, "127.0.0.1", free_port())  # No thread draws before it starts.
    try:
        with Browser(viewer.address, 400, 300) as browser:
            eventually(lambda: WAITING_NOTIFICATION[1] in browser.evaluate("document.body.innerText"))
    finally:
        viewer.stop()


@needs_browser
def test_names_in_the_line_above_the_controls_are_text() -> None:
    # viser executes expressions in braces in its Markdown; a failed save shows a path there.
    status = "not saved: {globalThis.ran = 1} <b>name</b> *a* _b_ `c` [d](e) \\f"
    viewer = Viewer(STATE, "127.0.0.1", free_port(), buttons={"Pause": lambda: None})
    viewer.start()
    try:
        with Browser(viewer.address, 400, 300) as browser:
            eventually(lambda: bool(viewer._clients) and "Pause" in browser.evaluate("document.body.innerText"))
            viewer.refresh(status)
            eventually(lambda: "not saved" in browser.evaluate("document.body.innerText"), 20)
            assert status in browser.evaluate("document.body.innerText")
            assert browser.evaluate("typeof globalThis.ran") == "undefined"
    finally:
        viewer.stop()


def test_port_0_is_one_that_is_free_and_the_link_has_it() -> None:
    assert parse_arguments(["view", "run", "--port", "0"]).port == 0
    viewer = Viewer(STATE, "127.0.0.1", 0)
    try:
        assert viewer.port > 0 and f"http://localhost:{viewer.port}/" in viewer.address
        with socket.create_connection(("127.0.0.1", viewer.port)):
            pass
    finally:
        viewer.stop()
