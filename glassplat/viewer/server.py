"""The viewer in the browser: viser shows the controls and moves the camera, this package renders.

viser's own splats know nothing of panes, so that what it shows is a picture behind an empty scene.
"""

from __future__ import annotations

import errno
import logging
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.data.errors import InputError
from glassplat.publish.surveyed import best_view, surveyed
from glassplat.render.frame import Renderer
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene
from glassplat.viewer.drawing import LEAST_GAIN, MOST_GAIN, Wish, drawn
from glassplat.viewer.render_loop import RenderLoop, RenderThread

LOCAL = "127.0.0.1"
FIRST_PORT, MOST_PORTS = 8080, 100
LARGEST_HEIGHT = 1080
SHARP_QUALITY, COARSE_QUALITY = 90, 60
PHOTO_WIDTH = 360
Photograph = Callable[[], Tensor]


@dataclass(frozen=True)
class Shown:
    """What there is to look at.

    Attributes:
        title: of the page.
        scene: on the renderer's device.
        renderer: of its frames.
        layers: names of the layers, the first one first shown.
        cameras: of the photographs, by name; at least one.
        photographs: [H, W, 3] uint8 by name, read when asked for; may be empty.
    """

    title: str
    scene: Scene
    renderer: Renderer
    layers: Sequence[str]
    cameras: Sequence[tuple[str, Camera]]
    photographs: Mapping[str, Photograph]


class Viewer:
    """Serves a scene to any number of browsers until it is stopped; who made it draws, or `start` does."""

    def __init__(
        self, shown: Shown, host: str, port: int, buttons: Mapping[str, Callable[[], None]] | None = None
    ) -> None:
        """Begins to serve.

        Args:
            shown: what there is to look at.
            host: who may look; 127.0.0.1 is this machine alone.
            port: where the browser finds it.
            buttons: further ones by what is written on them, and what they do; called from other threads.

        Raises:
            InputError: viser is not installed, or the port cannot be used.
        """
        check_port(host, port)
        try:
            import viser
        except ImportError as error:
            raise InputError(
                f"the viewer needs viser, which is not installed ({error}); pip install 'glassplat[view]', or look at "
                "the page of `glassplat export`, which needs nothing"
            ) from error
        self.shown, self.host, self.buttons = shown, host, buttons or {}
        self.loop: RenderLoop[Wish] = RenderLoop(self._draw, self._show)
        self._thread: RenderThread | None = None
        self._clients: dict[int, Client] = {}
        logging.getLogger("websockets").setLevel(logging.CRITICAL)
        self._server = viser.ViserServer(host=host, port=port, label=shown.title, verbose=False)
        survey = surveyed([camera for _, camera in shown.cameras], shown.scene.extent)
        self._server.scene.set_up_direction(tuple(survey.up.tolist()))
        self.focus = survey.focus.numpy()
        self.first = best_view(shown.scene.planes, [camera for _, camera in shown.cameras])
        self._server.gui.configure_theme(dark_mode=True, show_logo=False)
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(self._gone)

    @property
    def port(self) -> int:
        """Where it is served; another one than was asked for if that was taken."""
        return int(self._server.get_port())

    @property
    def address(self) -> str:
        """What to open in the browser."""
        return f"http://{'localhost' if self.host == LOCAL else self.host}:{self.port}"

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
        self._server.stop()

    def change(self, scene: Scene, renderer: Renderer) -> None:
        """Shows another scene from now on; to be called by the thread that draws. `refresh` draws it anew."""
        had = self.shown.scene.planes.labels
        self.shown = replace(self.shown, scene=scene, renderer=renderer)
        if scene.planes.labels != had:
            for client in list(self._clients.values()):
                client.lay_out()

    def refresh(self, status: str = "") -> None:
        """Asks for everybody's picture again, and tells them something."""
        for client in list(self._clients.values()):
            client.tell(status)
            client.ask()

    def _connected(self, handle: Any) -> None:
        self._clients[handle.client_id] = Client(handle, self)

    def _gone(self, handle: Any) -> None:
        self.loop.forget(handle.client_id)
        self._clients.pop(handle.client_id, None)

    def _draw(self, wish: Wish, height: int) -> NDArray[np.uint8]:
        return drawn(self.shown.scene, self.shown.renderer, wish, height)

    def _show(self, client: int, picture: NDArray[np.uint8], is_sharp: bool) -> None:
        found = self._clients.get(client)
        if found is not None:
            found.show(picture, is_sharp)


class Client:
    """One browser: its controls, its camera, and what it wishes to see."""

    def __init__(self, handle: Any, viewer: Viewer) -> None:
        """Lays out the controls and goes to the first view."""
        self._handle, self._viewer = handle, viewer
        self._at, self._status = viewer.first, ""
        self._layer: Any = None
        self.lay_out()
        self.stand_at(self._at)
        handle.camera.on_update(lambda _: self.ask())
        self.ask()

    def show(self, picture: NDArray[np.uint8], is_sharp: bool) -> None:
        """Puts a picture on the screen."""
        quality = SHARP_QUALITY if is_sharp else COARSE_QUALITY
        self._handle.scene.set_background_image(picture, format="jpeg", jpeg_quality=quality)

    def tell(self, status: str) -> None:
        """Shows a line above the controls."""
        self._status = status
        if self._told is not None:
            self._told.content = status

    def ask(self) -> None:
        """Asks for what the controls and the camera say."""
        camera = self._handle.camera
        try:
            rows = min(int(camera.image_height), LARGEST_HEIGHT)
            pose = cam_from_world(np.asarray(camera.wxyz), np.asarray(camera.position))
            wish = self._wish(pose, float(camera.fov), float(camera.aspect))
        except AssertionError:  # viser has not heard of this camera yet; it will say so.
            return
        self._viewer.loop.ask(self._handle.client_id, wish, (max(1, round(wish.aspect * rows)), max(1, rows)))

    def stand_at(self, index: int) -> None:
        """Moves the camera to where a photograph was taken, and shows that."""
        self._at = index % len(self._viewer.shown.cameras)
        name, camera = self._viewer.shown.cameras[self._at]
        rotation = camera.cam_from_world[:3, :3].double().cpu().numpy()
        position = camera.center.double().cpu().numpy()
        ahead = max(float((self._viewer.focus - position) @ rotation[2]), 0.1 * self._viewer.shown.scene.extent)
        with self._handle.atomic():
            self._handle.camera.up_direction = tuple(-rotation[1])
            self._handle.camera.position = tuple(position)
            self._handle.camera.look_at = tuple(position + ahead * rotation[2])
            self._handle.camera.fov = 2 * float(np.arctan(camera.height / 2 / camera.fy))
        self._name.value = name
        self._show_photograph(name)

    def _wish(self, pose: Tensor, fov_rad: float, aspect: float) -> Wish:
        return Wish(
            pose,
            fov_rad,
            aspect,
            layer=self._layer.value,
            glass=self._glass.value if self._glass else "as it is",
            reflectances=tuple((label, slider.value) for label, slider in self._reflectances.items()),
            gain=self._gain.value if self._gain else 1.0,
        )

    def lay_out(self) -> None:
        """Puts the controls there, anew where there were some."""
        gui, planes = self._handle.gui, self._viewer.shown.scene.planes
        layers = tuple(self._viewer.shown.layers)
        chosen = layers[0] if self._layer is None else self._layer.value
        gui.reset()
        self._told = gui.add_markdown(self._status) if self._viewer.buttons else None
        for name, act in self._viewer.buttons.items():
            gui.add_button(name).on_click(lambda _, act=act: act())
        self._layer = self._asks(gui.add_dropdown("Layer", layers, initial_value=chosen))
        self._glass = self._gain = None
        self._reflectances: dict[int, Any] = {}
        if len(planes):
            with gui.add_folder("Glass"):
                self._glass = self._asks(gui.add_dropdown("Panes", ("as it is", "mirror", "none")))
                for label, value in zip(planes.labels, planes.base_reflectances.tolist(), strict=True):
                    slider = gui.add_slider(f"R0 of pane {label}", 0.0, 1.0, 0.005, round(value, 3))
                    self._reflectances[label] = self._asks(slider)
                self._gain = self._asks(gui.add_slider("Gain", LEAST_GAIN, MOST_GAIN, 0.05, 1.0))
        with gui.add_folder("Photographs"):
            names = tuple(name for name, _ in self._viewer.shown.cameras)
            self._name = gui.add_dropdown("Stand at", names, initial_value=names[self._at])
            self._name.on_update(lambda event: self._chosen(names) if event.client is not None else None)
            steps = gui.add_button_group("Step", ("previous", "next"))
            steps.on_click(lambda _: self.stand_at(self._at + (1 if steps.value == "next" else -1)))
            self._photo = None
            if self._viewer.shown.photographs:
                self._photo = gui.add_image(np.zeros((2, 3, 3), dtype=np.uint8), label="Photograph")

    def _chosen(self, names: tuple[str, ...]) -> None:
        self.stand_at(names.index(self._name.value))

    def _asks(self, control: Any) -> Any:
        """A control whose change asks for another picture."""
        control.on_update(lambda _: self.ask())
        return control

    def _show_photograph(self, name: str) -> None:
        if self._photo is None or name not in self._viewer.shown.photographs:
            return
        photo = self._viewer.shown.photographs[name]()
        step = max(1, photo.shape[1] // PHOTO_WIDTH)
        self._photo.image = photo[::step, ::step].numpy()


def vacant_port(host: str) -> int:
    """The first port from 8080 on that can be used.

    Raises:
        InputError: none of a hundred can.
    """
    for port in range(FIRST_PORT, FIRST_PORT + MOST_PORTS):
        try:
            check_port(host, port)
        except InputError:
            continue
        return port
    raise InputError(f"no port from {FIRST_PORT} on can be used; end what serves there")


def check_port(host: str, port: int) -> None:
    """Refuses a port that is taken, or an address that is not this machine's, before anything is served.

    Raises:
        InputError: nothing can listen there.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            reason = "in use by another program" if error.errno == errno.EADDRINUSE else (error.strerror or str(error))
            raise InputError(f"port {port} of {host} cannot be used ({reason}); choose another --port") from error


def cam_from_world(wxyz: NDArray[np.float64], position: NDArray[np.float64]) -> Tensor:
    """[4, 4] float32 from viser's camera, which has the axes of OpenCV."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = wxyz
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    return torch.from_numpy(pose).float()
