"""The viewer in the browser: viser shows the controls and moves the camera, this package renders.

viser's own splats know nothing of panes, so that what it shows is a picture behind an empty scene.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.publish.surveyed import best_view, surveyed
from glassplat.render.frame import Renderer
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene
from glassplat.viewer.drawing import LEAST_GAIN, MOST_GAIN, Wish, drawn
from glassplat.viewer.render_loop import RenderLoop

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
    """Serves a scene to any number of browsers until it is stopped."""

    def __init__(self, shown: Shown, host: str, port: int) -> None:
        """Begins to serve.

        Raises:
            ImportError: viser is not installed.
            OSError: the port is taken.
        """
        import viser

        self._shown = shown
        self._clients: dict[int, Client] = {}
        self._loop: RenderLoop[Wish] = RenderLoop(self._draw, self._show)
        logging.getLogger("websockets").setLevel(logging.CRITICAL)
        # A browser may leave while its picture is drawn; viser drops what is sent to it, which is what is wanted.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
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

    def stop(self) -> None:
        """Ends the rendering, then the server."""
        self._loop.stop()
        self._server.stop()

    def _connected(self, handle: Any) -> None:
        self._clients[handle.client_id] = Client(handle, self._shown, self._loop, self.focus, self.first)

    def _gone(self, handle: Any) -> None:
        self._loop.forget(handle.client_id)
        self._clients.pop(handle.client_id, None)

    def _draw(self, wish: Wish, height: int) -> NDArray[np.uint8]:
        return drawn(self._shown.scene, self._shown.renderer, wish, height)

    def _show(self, client: int, picture: NDArray[np.uint8], is_sharp: bool) -> None:
        found = self._clients.get(client)
        if found is not None:
            found.show(picture, is_sharp)


class Client:
    """One browser: its controls, its camera, and what it wishes to see."""

    def __init__(
        self, handle: Any, shown: Shown, loop: RenderLoop[Wish], focus: NDArray[np.float64], first: int
    ) -> None:
        """Lays out the controls and goes to the first view."""
        self._handle, self._shown, self._loop, self._focus = handle, shown, loop, focus
        self._at = first
        self._layout()
        self.stand_at(first)
        handle.camera.on_update(lambda _: self.ask())
        self.ask()

    def show(self, picture: NDArray[np.uint8], is_sharp: bool) -> None:
        """Puts a picture on the screen."""
        quality = SHARP_QUALITY if is_sharp else COARSE_QUALITY
        self._handle.scene.set_background_image(picture, format="jpeg", jpeg_quality=quality)

    def ask(self) -> None:
        """Asks for what the controls and the camera say."""
        camera = self._handle.camera
        try:
            rows = min(int(camera.image_height), LARGEST_HEIGHT)
            pose = cam_from_world(np.asarray(camera.wxyz), np.asarray(camera.position))
            wish = self._wish(pose, float(camera.fov), float(camera.aspect))
        except AssertionError:  # viser has not heard of this camera yet; it will say so.
            return
        self._loop.ask(self._handle.client_id, wish, (max(1, round(wish.aspect * rows)), max(1, rows)))

    def stand_at(self, index: int) -> None:
        """Moves the camera to where a photograph was taken, and shows that."""
        self._at = index % len(self._shown.cameras)
        name, camera = self._shown.cameras[self._at]
        rotation = camera.cam_from_world[:3, :3].double().cpu().numpy()
        position = camera.center.double().cpu().numpy()
        ahead = max(float((self._focus - position) @ rotation[2]), 0.1 * self._shown.scene.extent)
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

    def _layout(self) -> None:
        gui, planes = self._handle.gui, self._shown.scene.planes
        self._layer = self._asks(gui.add_dropdown("Layer", tuple(self._shown.layers)))
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
            names = tuple(name for name, _ in self._shown.cameras)
            self._name = gui.add_dropdown("Stand at", names, initial_value=names[self._at])
            self._name.on_update(lambda event: self._chosen(names) if event.client is not None else None)
            steps = gui.add_button_group("Step", ("previous", "next"))
            steps.on_click(lambda _: self.stand_at(self._at + (1 if steps.value == "next" else -1)))
            self._photo = None
            if self._shown.photographs:
                self._photo = gui.add_image(np.zeros((2, 3, 3), dtype=np.uint8), label="Photograph")

    def _chosen(self, names: tuple[str, ...]) -> None:
        self.stand_at(names.index(self._name.value))

    def _asks(self, control: Any) -> Any:
        """A control whose change asks for another picture."""
        control.on_update(lambda _: self.ask())
        return control

    def _show_photograph(self, name: str) -> None:
        if self._photo is None or name not in self._shown.photographs:
            return
        photo = self._shown.photographs[name]()
        step = max(1, photo.shape[1] // PHOTO_WIDTH)
        self._photo.image = photo[::step, ::step].numpy()


def cam_from_world(wxyz: NDArray[np.float64], position: NDArray[np.float64]) -> Tensor:
    """[4, 4] float32 from viser's camera, which has the axes of OpenCV."""
    from scipy.spatial.transform import Rotation

    w, x, y, z = wxyz
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position
    return torch.from_numpy(pose).float()
