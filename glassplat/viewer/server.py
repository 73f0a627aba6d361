"""The viewer in the browser: viser shows the controls and moves the camera, this package renders.

viser's own splats do not support panes, so the rendered image is the background of an empty scene.
"""

from __future__ import annotations

import io
import logging
import re
import socket
import threading
import warnings
from collections.abc import Callable, Mapping
from contextlib import redirect_stdout
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from glassplat.access import Access, is_local
from glassplat.errors import InputError
from glassplat.publish.web_page import best_view, survey_capture
from glassplat.render.frame import Renderer
from glassplat.scene.camera import Camera, rigid_transform
from glassplat.scene.scene import Scene
from glassplat.viewer import controls, drawing
from glassplat.viewer.render_loop import RenderLoop, RenderThread, check_port

LARGEST_HEIGHT, MOST_PIXELS = 1080, 4_000_000
SHARP_QUALITY, COARSE_QUALITY = 90, 60
LEAST_AHEAD = 0.1
"""Minimum distance from the camera to the point it orbits, as a share of the extent."""
CLIPPING_PLANES = (0.01, 1000.0)
"""Distances between which the browser draws handles and keyframes, in extents; viser's own are in world units."""
WAITING_NOTIFICATION = ("Rendering", "The first image may take a minute or two: kernels are compiled once per machine.")
"""Title and text of the notification shown until the first image."""


class Client:
    """One browser."""

    def __init__(self, handle: Any, viewer: Viewer) -> None:
        """Lays out the controls and moves to the first view; the caller then calls `request_render`."""
        self._handle, self._viewer = handle, viewer
        self._nearest, self._failure = viewer.first, ""
        self._waiting: Any = handle.add_notification(*WAITING_NOTIFICATION, loading=True, with_close_button=False)
        gui, state = handle.gui, viewer.state
        self._status_line = gui.add_markdown("") if viewer.buttons else None
        for name, act in viewer.buttons.items():
            gui.add_button(name).on_click(controls.log_errors(lambda _, act=act: act()))
        self._layer = gui.add_dropdown("Layer", state.layers)
        self._panes: controls.PaneControls | None = None
        # A scene in training changes at every step.
        self._clean = None if viewer.buttons else controls.CleanControls(gui, state)
        self._measure = controls.MeasureControls(handle, self.measure)
        self._photographs = controls.PhotographControls(gui, state, viewer.first)
        save = None if state.writer is None else self.save_keyframes
        self.keyframes = controls.KeyframeControls(handle, state.scene.extent, self.camera, self.move_camera, save)
        if state.writer is not None:
            self._add_save_controls(f"{state.title}-edited")
        # After all are created, because a control may fire as soon as it listens.
        self.lay_out_panes()
        self._layer.on_update(controls.log_errors(lambda _: self.request_render()))
        if self._clean is not None:
            self._clean.listen(self.request_render)
        self._photographs.listen(self.go_to_photograph)
        self.go_to_photograph(viewer.first)
        handle.camera.on_update(controls.log_errors(lambda _: self.request_render()))

    def show(self, image: NDArray[np.uint8], is_sharp: bool) -> None:
        """Displays an image; at full resolution also the nearest photograph."""
        quality = SHARP_QUALITY if is_sharp else COARSE_QUALITY
        self._handle.scene.set_background_image(image, format="jpeg", jpeg_quality=quality)
        self._stop_waiting()
        self._failure = ""
        if is_sharp:
            self._photographs.show_nearest(self._nearest)

    def show_failure(self, reason: str) -> None:
        """Notifies of the reason why rendering failed, once for repeated failures."""
        self._stop_waiting()
        if reason != self._failure:
            self._failure = reason
            self._notify("No image", reason, "red")

    def show_status(self, status: str) -> None:
        """Shows a line above the controls."""
        if self._status_line is not None:
            self._status_line.content = escape_markdown(status)

    def request_render(self) -> None:
        """Requests the view given by the controls and the camera."""
        request = self.request()
        if request is None:
            return
        most = min(LARGEST_HEIGHT, int((MOST_PIXELS / request.aspect) ** 0.5))
        rows = max(1, min(int(self._handle.camera.image_height), most))
        self._viewer.loop.submit(self._handle.client_id, request, (max(1, round(request.aspect * rows)), rows))

    def request(self) -> drawing.ViewRequest | None:
        """Request of the controls and the camera; None before the browser has reported its camera."""
        camera = self._handle.camera
        try:
            wxyz, position = np.asarray(camera.wxyz), np.asarray(camera.position)
            fov_rad, aspect = float(camera.fov), float(camera.aspect)
        except AssertionError:  # The browser has not sent its camera yet.
            return None
        world_from_cam = drawing.matrix_of(wxyz)  # With the axes of OpenCV.
        self._nearest = self._viewer.viewpoints.nearest(position, world_from_cam[:, 2])
        compared_photograph = self._nearest if self._layer.value == drawing.ERROR_LAYER else None
        pose = rigid_transform(world_from_cam.T, position)
        request = drawing.ViewRequest(pose, fov_rad, aspect, self._layer.value, compared_photograph=compared_photograph)
        request = request if self._clean is None else self._clean.apply(request)
        return request if self._panes is None else self._panes.apply(request)

    def camera(self) -> Camera | None:
        """Camera of the browser, with the rows of its window."""
        request = self.request()
        return None if request is None else request.camera(max(1, int(self._handle.camera.image_height)))

    def go_to_photograph(self, index: int) -> None:
        """Moves the camera to the pose of a photograph and shows it; playback of keyframes stops."""
        self.keyframes.stop()
        self._photographs.mark_current(index)
        self._photographs.show_nearest(index)
        self.move_camera(self._viewer.state.cameras[index][1])

    def move_camera(self, camera: Camera) -> None:
        """Moves the camera."""
        rotation = camera.cam_from_world[:3, :3].double().cpu().numpy()
        position = camera.center.double().cpu().numpy()
        extent = self._viewer.state.scene.extent
        ahead = max(float((self._viewer.focus - position) @ rotation[2]), LEAST_AHEAD * extent)
        with self._handle.atomic():
            self._handle.camera.up_direction = tuple(-rotation[1])
            self._handle.camera.position = tuple(position)
            self._handle.camera.look_at = tuple(position + ahead * rotation[2])
            self._handle.camera.near, self._handle.camera.far = (share * extent for share in CLIPPING_PLANES)
            self._handle.camera.fov = 2 * float(np.arctan(camera.height / 2 / camera.fy))

    def lay_out_panes(self) -> None:
        """Lays out the controls of the scene's panes and the list of layers, replacing existing ones.

        The other controls stay, because a page that is slow gets to updates of a control only after its removal, and
        reports errors.
        """
        state = self._viewer.state
        self._layer.options = state.layers
        if self._panes is not None:
            self._panes.remove()
        self._panes = None
        if len(state.scene.planes):
            self._panes = controls.PaneControls(self._handle, state.scene.planes, self._layer.order + 0.5)
            self._panes.listen(self.request_render)

    def measure(self, direction: NDArray[np.float64]) -> None:
        """Adds the surface point visible in a direction [3] (world axes) to the measurement.

        The current camera is used, because the rendering thread may run this much later.
        """
        request = self.request()
        if request is None:
            return

        def work() -> None:
            try:
                state = self._viewer.state
                self._measure.add_point(drawing.surface_point(state.scene, state.renderer, request, direction))
            except ValueError as error:
                self._notify("No point", str(error), "red")

        self._viewer.loop.schedule(controls.log_errors(work))

    def save_scene(self, name: str) -> None:
        """Saves the edited scene under a new name; a notification reports the result."""
        writer, request = self._viewer.state.writer, self.request()
        if writer is not None and request is not None:
            self._save(lambda: writer.write_scene(drawing.edit_scene(self._viewer.state.scene, request), name))

    def save_keyframes(self, name: str) -> None:
        """Saves the keyframes under a new name; a notification reports the result."""
        writer, keyframes = self._viewer.state.writer, self.keyframes.keyframes
        if writer is not None:
            self._save(lambda: writer.write_keyframes(keyframes, name))

    def _add_save_controls(self, name: str) -> None:
        gui = self._handle.gui
        with gui.add_folder("Edited scene", expand_by_default=False):
            text = gui.add_text("Name", name)
            gui.add_button("Save as a run").on_click(controls.log_errors(lambda _: self.save_scene(text.value)))

    def _save(self, write: Callable[[], str]) -> None:
        """Writes in the rendering thread, because writing may run kernels."""

        def work() -> None:
            try:
                self._notify("Saved", write(), "green")
            except (InputError, ValueError, OSError, RuntimeError) as error:
                self._notify("Not saved", str(error), "red")

        self._viewer.loop.schedule(work)

    def _stop_waiting(self) -> None:
        if self._waiting is not None:
            self._waiting.remove()
            self._waiting = None

    def _notify(self, title: str, body: str, color: str) -> None:
        self._handle.add_notification(title, body, color=color)


def escape_markdown(text: str) -> str:
    """Text escaped for Markdown, so that the page shows it verbatim: names may look like HTML."""
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


class Viewer:
    """Serves a scene to any number of browsers until it is stopped; the caller renders, or `start` does."""

    def __init__(
        self, state: drawing.ViewerState, host: str, port: int, buttons: Mapping[str, Callable[[], None]] | None = None
    ) -> None:
        """Starts the server.

        Args:
            state: the scene, its cameras and its photographs.
            host: address to listen on; 127.0.0.1 serves this machine only. Clients need the key in the address.
            port: to listen on; 0 picks a free one.
            buttons: additional buttons, by label, with their callbacks; called from other threads.
        """
        port = check_port(host, port)
        try:
            from glassplat.viewer.gate import guarded_server
        except ImportError as error:
            raise InputError(
                f"the viewer needs viser, which is not installed ({error}); pip install 'glassplat[view]', or "
                "use the page of `glassplat export`, which needs no server"
            ) from error
        self.state, self.host, self.buttons = state, host, buttons or {}
        self.loop: RenderLoop[drawing.ViewRequest] = RenderLoop(self._draw, self._show, self._fail)
        self._thread: RenderThread | None = None
        self._clients: dict[int, Client] = {}
        # Held while a client is laid out, so that each one has the controls of the current scene.
        self._layout_lock = threading.Lock()
        logging.getLogger("websockets").setLevel(logging.CRITICAL)
        # A browser may disconnect at any time; users need no warning.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        self.access = Access(host)
        self._server = guarded_server(self.access, host=host, port=port, title=state.title)
        cameras = [camera for _, camera in state.cameras]
        survey = survey_capture(cameras, state.scene.extent)
        self._server.scene.set_up_direction(tuple(survey.up.tolist()))
        self.focus = survey.focus.numpy()
        self.first = best_view(state.scene.planes, cameras)
        self.viewpoints = drawing.Viewpoints(cameras, state.scene.extent)
        # The error layer reads the same photograph for every edit.
        self._photograph = lru_cache(maxsize=2)(self._read_photograph)
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.on_client_connect(controls.log_errors(self._on_connect))
        self._server.on_client_disconnect(controls.log_errors(self._on_disconnect))

    def __repr__(self) -> str:
        return f"viewer: {self.address}"

    @property
    def port(self) -> int:
        """Port of the server, which may differ from the requested one."""
        return int(self._server.get_port())

    @property
    def address(self) -> str:
        """Address to open in the browser, including the key; requests without it are rejected."""
        everywhere = self.host in ("0.0.0.0", "::")
        name = "localhost" if is_local(self.host) else socket.gethostname() if everywhere else self.host
        name = f"[{name}]" if ":" in name else name  # Separates an IPv6 address from the port.
        return f"http://{name}:{self.port}/?key={self.access.key}"

    @property
    def is_watched(self) -> bool:
        """Return whether a browser is connected."""
        return bool(self._clients)

    def start(self) -> None:
        """Starts rendering in a separate thread."""
        self._thread = RenderThread(self.loop)

    def stop(self) -> None:
        """Stops rendering, then the server."""
        if self._thread is not None:
            self._thread.stop()
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    def replace_scene(self, scene: Scene, renderer: Renderer) -> None:
        """Replaces the displayed scene; to be called by the rendering thread. `refresh` renders it."""
        with self._layout_lock:
            previous = self.state
            self.state = replace(previous, scene=scene, renderer=renderer)
            if (scene.planes.labels, self.state.layers) != (previous.scene.planes.labels, previous.layers):
                for client in list(self._clients.values()):
                    controls.log_errors(client.lay_out_panes)()

    def refresh(self, status: str = "") -> None:
        """Requests the views of all clients again, and shows them a status line."""
        for client in list(self._clients.values()):
            controls.log_errors(client.show_status)(status)
            controls.log_errors(client.request_render)()

    def _on_connect(self, handle: Any) -> None:
        with self._layout_lock:
            client = self._clients[handle.client_id] = Client(handle, self)
        client.request_render()
        if handle.client_id not in self._server.get_clients():  # It disconnected before it was registered here.
            self._on_disconnect(handle)

    def _on_disconnect(self, handle: Any) -> None:
        self.loop.forget(handle.client_id)
        gone = self._clients.pop(handle.client_id, None)
        if gone is not None:
            gone.keyframes.stop()

    def _draw(self, request: drawing.ViewRequest, height: int) -> NDArray[np.uint8]:
        scene, renderer = self.state.scene, self.state.renderer
        if request.compared_photograph is None:
            return drawing.draw_image(scene, renderer, request, height)
        name, camera = self.state.cameras[request.compared_photograph]
        photo = self._photograph(request.compared_photograph)
        return drawing.draw_error_map(scene, renderer, request, height, camera, photo, name=name)

    def _read_photograph(self, index: int) -> Tensor:
        """[H, W, 3] uint8.

        Raises:
            ValueError, OSError: the photograph does not exist, or cannot be read.
        """
        name = self.state.cameras[index][0]
        if name not in self.state.photographs:
            raise ValueError(f"there is no photograph {name} to compare with")
        return self.state.photographs[name]()

    def _fail(self, client: int, reason: str) -> None:
        found = self._clients.get(client)
        if found is not None:
            found.show_failure(reason)

    def _show(self, client: int, image: NDArray[np.uint8], is_sharp: bool) -> None:
        found = self._clients.get(client)
        if found is not None:
            found.show(image, is_sharp)
