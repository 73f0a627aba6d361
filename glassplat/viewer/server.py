"""The viewer in the browser: viser shows the controls and moves the camera, this package renders.

viser's own splats know nothing of panes, so that what it shows is a picture behind an empty scene.
"""

from __future__ import annotations

import io
import logging
import socket
import warnings
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from glassplat.data.errors import InputError
from glassplat.publish.surveyed import best_view, surveyed
from glassplat.render.frame import Renderer
from glassplat.scene.scene import Scene
from glassplat.serving.access import Access, is_local
from glassplat.viewer.callbacks import survived
from glassplat.viewer.client import Client
from glassplat.viewer.drawing import Wish, drawn, error_drawn
from glassplat.viewer.ports import check_port
from glassplat.viewer.render_loop import RenderLoop, RenderThread
from glassplat.viewer.shown import Shown, Viewpoints


class Viewer:
    """Serves a scene to any number of browsers until it is stopped; who made it draws, or `start` does."""

    def __init__(
        self, shown: Shown, host: str, port: int, buttons: Mapping[str, Callable[[], None]] | None = None
    ) -> None:
        """Begins to serve.

        Args:
            shown: what there is to look at.
            host: who may look, with the key of the address; 127.0.0.1 is this machine alone.
            port: where the browser finds it.
            buttons: further ones by what is written on them, and what they do; called from other threads.

        Raises:
            InputError: viser is not installed or cannot be guarded, or the port cannot be used.
        """
        check_port(host, port)
        try:
            from glassplat.viewer.gate import guarded_server
        except ImportError as error:
            raise InputError(
                f"the viewer needs viser, which is not installed ({error}); pip install 'glassplat[view]', or look at "
                "the page of `glassplat export`, which needs nothing"
            ) from error
        self.shown, self.host, self.buttons = shown, host, buttons or {}
        self.loop: RenderLoop[Wish] = RenderLoop(self._draw, self._show, self._fail)
        self._thread: RenderThread | None = None
        self._clients: dict[int, Client] = {}
        logging.getLogger("websockets").setLevel(logging.CRITICAL)
        # A browser that leaves in the middle of something is nothing that anybody needs to know.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        self.access = Access(host)
        self._server = guarded_server(self.access, host=host, port=port, title=shown.title)
        cameras = [camera for _, camera in shown.cameras]
        survey = surveyed(cameras, shown.scene.extent)
        self._server.scene.set_up_direction(tuple(survey.up.tolist()))
        self.focus = survey.focus.numpy()
        self.first = best_view(shown.scene.planes, cameras)
        self.viewpoints = Viewpoints(cameras, shown.scene.extent)
        # The error layer asks for the same one with every edit.
        self._photograph = lru_cache(maxsize=2)(self._read_photograph)
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.on_client_connect(survived(self._connected))
        self._server.on_client_disconnect(survived(self._gone))

    @property
    def port(self) -> int:
        """Where it is served; another one than was asked for if that was taken."""
        return int(self._server.get_port())

    @property
    def address(self) -> str:
        """What to open in the browser: with the key, without which there is no answer."""
        everywhere = self.host in ("0.0.0.0", "::")
        name = "localhost" if is_local(self.host) else socket.gethostname() if everywhere else self.host
        return f"http://{name}:{self.port}/?key={self.access.key}"

    @property
    def is_watched(self) -> bool:
        """Whether a browser is connected."""
        return bool(self._clients)

    def start(self) -> None:
        """Begins to draw, in a thread of its own."""
        self._thread = RenderThread(self.loop)

    def stop(self) -> None:
        """Ends the drawing, then the server."""
        if self._thread is not None:
            self._thread.stop()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def change(self, scene: Scene, renderer: Renderer) -> None:
        """Shows another scene from now on; to be called by the thread that draws. `refresh` draws it anew."""
        had = self.shown.scene.planes.labels
        self.shown = replace(self.shown, scene=scene, renderer=renderer)
        if scene.planes.labels != had:
            for client in list(self._clients.values()):
                survived(client.lay_out)()

    def refresh(self, status: str = "") -> None:
        """Asks for everybody's picture again, and tells them something."""
        for client in list(self._clients.values()):
            survived(client.tell)(status)
            survived(client.ask)()

    def _connected(self, handle: Any) -> None:
        client = self._clients[handle.client_id] = Client(handle, self)
        client.ask()
        if handle.client_id not in self._server.get_clients():  # It left before it was known here.
            self._gone(handle)

    def _gone(self, handle: Any) -> None:
        self.loop.forget(handle.client_id)
        gone = self._clients.pop(handle.client_id, None)
        if gone is not None:
            gone.leave()

    def _draw(self, wish: Wish, height: int) -> NDArray[np.uint8]:
        scene, renderer = self.shown.scene, self.shown.renderer
        if wish.against is None:
            return drawn(scene, renderer, wish, height)
        camera = self.shown.cameras[wish.against][1]
        return error_drawn(scene, renderer, wish, height, camera, self._photograph(wish.against))

    def _read_photograph(self, index: int) -> Tensor:
        """[H, W, 3] uint8.

        Raises:
            ValueError, OSError: the photograph is not there, or cannot be read.
        """
        name = self.shown.cameras[index][0]
        if name not in self.shown.photographs:
            raise ValueError(f"there is no photograph {name} to compare with")
        return self.shown.photographs[name]()

    def _fail(self, client: int, reason: str) -> None:
        found = self._clients.get(client)
        if found is not None:
            found.say_failed(reason)

    def _show(self, client: int, picture: NDArray[np.uint8], is_sharp: bool) -> None:
        found = self._clients.get(client)
        if found is not None:
            found.show(picture, is_sharp)
