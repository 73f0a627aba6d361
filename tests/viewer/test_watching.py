"""A training with a viewer: drawn between steps, paused, saved, and not slowed down while no client is connected."""

from __future__ import annotations

import asyncio
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from glassplat import Training
from glassplat.access import Access
from glassplat.cli import runs
from glassplat.cli.main import main
from glassplat.methods.glossy_recipes import DeferredRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model import watching
from glassplat.model.watching import WatchedTraining, current_renderer
from glassplat.render.splat import Splat
from glassplat.scene.panes import Planes
from glassplat.training.messages import Message
from glassplat.viewer import gate, server
from glassplat.viewer.render_loop import vacant_port
from glassplat.viewer.server import Viewer
from tests.browser_needed import needs_browser
from tests.model.test_model import model
from tests.training.tiny_capture import tiny_capture, write_tiny_capture
from tests.viewer.free_port import free_port
from tests.viewer.test_server import STATE, VIEWS, eventually
from tools.browser import Browser
from tools.viewer_client import ViewerClient


class EnoughError(Exception):
    """Ends a training from inside."""


class Watch:
    """A training in a separate thread, with its viewer."""

    def __init__(self, output: Path) -> None:
        recipe = SplatRecipe(sh_degree=1)
        self.training = Training(tiny_capture(), recipe, iterations=100_000, output=output, device="cpu")
        self.viewers: list[Viewer] = []
        self.is_enough = False
        self.watched = WatchedTraining(
            self.training, tiny_capture(), host="127.0.0.1", port=free_port(), announce=self.viewers.append
        )
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        try:
            self.training.run(self._listen)
        except EnoughError:
            self.watched.stop()

    def _listen(self, message: Message) -> None:
        if self.is_enough:
            raise EnoughError
        self.watched.handle_message(message)


@contextmanager
def watch(output: Path) -> Iterator[Watch]:
    found = Watch(output)
    try:
        yield found
    finally:
        found.is_enough, found.watched._is_paused = True, False
        found.thread.join()


def stands_still(training: Training) -> bool:
    at = training.step
    time.sleep(0.5)
    return training.step == at


@needs_browser
def test_a_running_training_is_drawn_paused_and_saved(tmp_path: Path) -> None:
    with watch(tmp_path / "run") as found:
        eventually(lambda: bool(found.viewers) and found.training.step > 20)
        (viewer,) = found.viewers
        drawn: list[int] = []
        draw = viewer.loop._draw
        viewer.loop._draw = lambda request, rows: (drawn.append(found.training.step), draw(request, rows))[1]
        before = found.training.step
        eventually(lambda: found.training.step > before + 20)
        assert not drawn
        with Browser(viewer.address, 400, 300) as browser:
            eventually(lambda: len(set(drawn)) > 1)
            eventually(lambda: "step" in browser.evaluate("document.body.innerText"))
            viewer.buttons["pause"]()
            eventually(lambda: "paused" in browser.evaluate("document.body.innerText"))
            eventually(lambda: stands_still(found.training))
            at = found.training.step
            viewer.buttons["save"]()
            eventually((tmp_path / "run" / "point_cloud" / f"iteration_{at}" / "scene.json").is_file)
            assert found.training.step == at and (tmp_path / "run" / "checkpoint.safetensors").is_file()
            viewer.buttons["pause"]()
            eventually(lambda: found.training.step > at)


@pytest.mark.parametrize("is_guarded", [True, False])
def test_a_camera_without_a_field_of_view_ends_no_training(
    is_guarded: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its message is ignored; if the gate let it through, only its own image would fail."""
    if not is_guarded:
        monkeypatch.setattr(gate, "parse_message", lambda data: data)

    async def look(viewer: Viewer) -> None:
        async with ViewerClient(viewer.address) as client:
            await client.picture()
            await client.look(fov=0.0)
            await asyncio.sleep(0.5)
            await client.picture()

    with watch(tmp_path / "run") as found:
        eventually(lambda: bool(found.viewers))
        asyncio.run(look(found.viewers[0]))
        at = found.training.step
        eventually(lambda: found.training.step > at + 5 or not found.thread.is_alive())
        assert found.thread.is_alive()


def test_a_save_that_fails_ends_no_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def save() -> None:
        raise RuntimeError("no memory")

    told: list[str] = []
    with watch(tmp_path / "run") as found:
        eventually(lambda: bool(found.viewers))
        monkeypatch.setattr(found.training, "save", save)
        monkeypatch.setattr(found.viewers[0], "refresh", told.append)
        found.viewers[0].buttons["save"]()
        eventually(lambda: bool(told) or not found.thread.is_alive())
        at = found.training.step
        eventually(lambda: found.training.step > at or not found.thread.is_alive())
        assert found.thread.is_alive() and "not saved: no memory" in told[0]


@contextmanager
def port_in_use() -> Iterator[int]:
    """Occupies the port that a server would take, retrying if a test running at the same time takes it first."""
    with socket.socket() as taken:
        while taken.getsockname()[1] == 0:
            with suppress(OSError):
                taken.bind(("127.0.0.1", vacant_port("127.0.0.1")))
        taken.listen()
        yield taken.getsockname()[1]


def test_a_training_without_clients_prints_the_address_of_its_viewer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    serve, hosts = gate.guarded_server, list[str]()

    def served(access: Access, *, host: str, port: int, title: str) -> Any:
        hosts.append(host)
        return serve(access, host=host, port=port, title=title)

    monkeypatch.setattr(gate, "guarded_server", served)
    data = write_tiny_capture(tmp_path / "data")
    options = ["--data", str(data), "--output", str(tmp_path / "run"), "--iterations", "5", "--device", "cpu"]
    with port_in_use() as first:
        assert main(["train", "splat", *options, "--view"]) == 0
    found = re.search(r"viewer: http://localhost:(\d+)", capsys.readouterr().out)
    assert found is not None and int(found[1]) > first
    assert hosts == ["127.0.0.1"]


@pytest.mark.parametrize("rank", [0, 1])
def test_the_viewer_shows_the_first_rank(rank: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("TORCHELASTIC_RUN_ID", "test"), ("WORLD_SIZE", "2"), ("RANK", str(rank))):
        monkeypatch.setenv(name, value)
    begun: list[bool] = []
    watched = SimpleNamespace(handle_message=print, stop=lambda: begun.append(False))
    monkeypatch.setattr(watching, "WatchedTraining", lambda *given, **options: begun.append(True) or watched)
    asked: Any = SimpleNamespace(view=True)
    nothing: Any = None
    with runs._viewer_listener(asked, nothing, nothing, Console()):
        pass
    assert begun == ([True, False] if rank == 0 else [])


def test_a_scene_that_lacks_what_its_method_mirrors_is_drawn_plainly() -> None:
    early = replace(model(), recipe=DeferredRecipe(background=(0.0, 0.0, 0.0)))
    assert isinstance(current_renderer(early.recipe, early.scene), Splat)
    assert current_renderer(model().recipe, model().scene) == model().renderer


def test_only_the_controls_of_panes_are_replaced_when_panes_change() -> None:
    viewer = Viewer(STATE, "127.0.0.1", free_port())  # Without a thread, nothing is drawn afterwards.

    async def look() -> None:
        async with ViewerClient(viewer.address) as browser:
            await browser.look()
            while not viewer._clients:
                await asyncio.sleep(0.02)
            (client,) = viewer._clients.values()
            client._layer.value = "strength"
            viewer.replace_scene(replace(STATE.scene, planes=Planes.empty()), Splat())
            assert client._photographs._photo.label == f"Nearest photograph: {VIEWS[viewer.first].name}"
            assert (client._layer.options, client._layer.value) == (("rgb", "normal", "depth", "error"), "rgb")
            assert client._panes is None
            viewer.replace_scene(STATE.scene, STATE.renderer)
            assert client._layer.order < client._panes._folder.order < client._photographs._name.order
            while not browser.removed:
                await asyncio.sleep(0.02)
            assert not {browser.labels()[label] for label in ("Layer", "Go to")} & {*browser.removed}

    try:
        asyncio.run(look())
    finally:
        viewer.stop()


def test_a_client_that_connects_while_panes_change_has_the_controls_of_the_new_scene(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class InterruptedClient(server.Client):
        """Laid out while another thread replaces the scene."""

        def __init__(self, handle: Any, viewer: Viewer) -> None:
            super().__init__(handle, viewer)
            bare = replace(STATE.scene, planes=Planes.empty())
            self.replacing = threading.Thread(target=viewer.replace_scene, args=(bare, Splat()))
            self.replacing.start()
            self.replacing.join(0.1)

    monkeypatch.setattr(server, "Client", InterruptedClient)
    viewer = Viewer(STATE, "127.0.0.1", free_port())

    async def look() -> None:
        async with ViewerClient(viewer.address) as browser:
            await browser.look()
            while not viewer._clients:
                await asyncio.sleep(0.02)
            (client,) = viewer._clients.values()
            client.replacing.join()
            assert client._panes is None

    try:
        asyncio.run(look())
    finally:
        viewer.stop()
