"""Render requests of viewers, and the images rendered for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.render.frame import Renderer
from glassplat.render.layers import error_colors, layer_image
from glassplat.render.planar import PHOTOGRAPHED
from glassplat.scene.camera import Camera, quat_from_rotation, rotation_from_quat
from glassplat.scene.scene import PaneMove, Scene, as_mirrors, move_panes, with_reflectance, without_glass


def matrix_of(wxyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] of a quaternion [4] of any length."""
    matrix: NDArray[np.float64] = rotation_from_quat(torch.from_numpy(np.asarray(wxyz, dtype=np.float64))).numpy()
    return matrix


def wxyz_of(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """[4] of a rotation [3, 3], with w >= 0."""
    quat: NDArray[np.float64] = quat_from_rotation(torch.from_numpy(matrix)).numpy()
    return quat if quat[0] >= 0 else -quat


Photograph = Callable[[], Tensor]


class Writer(Protocol):
    """Writes edits made in the browser, each under a new name, and returns a message with the location.

    Both raise InputError or OSError on failure; nothing is overwritten.
    """

    def write_scene(self, scene: Scene, name: str) -> str:
        """Writes an edited scene."""

    def write_keyframes(self, cameras: Sequence[Camera], name: str) -> str:
        """Writes the keyframes of a video."""


@dataclass(frozen=True)
class ViewerState:
    """Displayed scene, with its cameras.

    Attributes:
        title: of the page.
        scene: on the renderer's device.
        renderer: of its frames.
        cameras: of the photographs, by name; at least one.
        photographs: [H, W, 3] uint8 by name, read on demand; may be empty.
        writer: writes edits made in the browser; None if writing is not allowed.
    """

    title: str
    scene: Scene
    renderer: Renderer
    cameras: Sequence[tuple[str, Camera]]
    photographs: Mapping[str, Photograph]
    writer: Writer | None = None

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers; the first one is shown initially."""
        shown = (layer for layer in self.renderer.layers(self.scene) if layer not in HIDDEN_LAYERS)
        return (*shown, *((ERROR_LAYER,) if self.photographs else ()))


class Viewpoints:
    """Positions and directions of all photographs, to find the one nearest to a view."""

    def __init__(self, cameras: Sequence[Camera], extent: float) -> None:
        """Stores the poses.

        Args:
            cameras: at least one.
            extent: of the scene; this distance counts as much as an angle of one radian.
        """
        self._centers = np.stack([camera.center.double().cpu().numpy() for camera in cameras])
        self._forwards = np.stack([camera.cam_from_world[2, :3].double().cpu().numpy() for camera in cameras])
        self._extent = extent

    def nearest(self, center: NDArray[np.float64], forward: NDArray[np.float64]) -> int:
        """Index of the camera whose position and direction are nearest to those of a view; both [3]."""
        distances = np.linalg.norm(self._centers - center, axis=1) / self._extent
        angles = np.arccos(np.clip(self._forwards @ forward, -1, 1))
        return int(np.argmin(distances + angles))


Glass = Literal["as it is", "mirror", "none"]
LEAST_GAIN, MOST_GAIN = 0.1, 10.0
ERROR_LAYER = "error"
"""The layer that compares with a photograph."""
HIDDEN_LAYERS = ("alpha",)
MEASURED_ROWS, SURFACE_COVERAGE = 480, 0.5
"""Rows of the image in which points are measured, and the alpha below which a pixel shows no surface."""


@dataclass(frozen=True)
class ViewRequest:
    """A view requested by a client.

    Attributes:
        cam_from_world: [4, 4] rigid.
        fov_rad: vertical field of view.
        aspect: width over height.
        layer: `rgb`, a layer of the renderer's frames, or `error`.
        glass: panes as in the scene, as mirrors, or removed.
        reflectances: R0 by label of the panes for which it differs from the scene.
        gain: factor on the light reflected by panes.
        moves: movements of panes, relative to the scene.
        compared_photograph: index of the photograph that the layer `error` compares with; None for the other layers.
        kept: [N] bool, the primary Gaussians to keep; None keeps all.
    """

    cam_from_world: Tensor
    fov_rad: float
    aspect: float
    layer: str = "rgb"
    glass: Glass = "as it is"
    reflectances: tuple[tuple[int, float], ...] = ()
    gain: float = 1.0
    moves: tuple[PaneMove, ...] = ()
    compared_photograph: int | None = None
    kept: Tensor | None = None

    def camera(self, height: int) -> Camera:
        """The camera of an image with the given number of rows."""
        focal = height / 2 / float(np.tan(self.fov_rad / 2))
        width = max(1, round(self.aspect * height))
        return Camera(self.cam_from_world, focal, focal, width / 2, height / 2, width, height)


def edit_scene(scene: Scene, request: ViewRequest) -> Scene:
    """The scene with the requested edits of panes and cleaning; everything else keeps every bit."""
    if request.kept is not None and len(request.kept) == len(scene.primary):
        scene = replace(scene, primary=scene.primary.select(request.kept.to(scene.primary.means.device)))
    if not len(scene.planes) or request.glass == "none":
        return without_glass(scene) if len(scene.planes) else scene
    scene = move_panes(scene, request.moves)
    for label, reflectance in request.reflectances:
        scene = with_reflectance(scene, label, reflectance)
    if request.glass == "mirror":
        scene = as_mirrors(scene, scene.planes.labels)
    logs = scene.primary.channels.get("log_intensity")
    if request.gain == 1 or logs is None:
        return scene
    shift = float(np.log(np.clip(request.gain, LEAST_GAIN, MOST_GAIN)))
    return replace(scene, primary=scene.primary.with_tensors({"log_intensity": logs + shift}))


@torch.no_grad()
def draw_image(scene: Scene, renderer: Renderer, request: ViewRequest, height: int) -> NDArray[np.uint8]:
    """The image [H, W, 3] of a request; `rgb` replaces a layer that the frame does not have."""
    frame = renderer.with_layers([request.layer])(edit_scene(scene, request), request.camera(height))
    return _to_uint8(layer_image(frame, request.layer if request.layer in (*frame.layers, PHOTOGRAPHED) else "rgb"))


@torch.no_grad()
def draw_error_map(
    scene: Scene, renderer: Renderer, request: ViewRequest, height: int, camera: Camera, photo: Tensor, *, name: str
) -> NDArray[np.uint8]:
    """Error map [H, W, 3] of the edited scene against a photograph, with its exposure and camera; W follows the aspect.

    The photograph fills the height; it is padded with black, or cropped if the image is narrower. The comparison is per
    pixel, so that the image has at most as many rows as the photograph.

    Args:
        scene: the displayed scene.
        renderer: of its frames.
        request: its edits and aspect are used, its camera is not.
        height: maximum number of rows of the image.
        camera: of the photograph.
        photo: [H, W, 3] uint8.
        name: of the photograph.
    """
    rows = min(height, photo.shape[0])
    columns = max(1, round(rows * camera.width / camera.height))
    frame = renderer.with_layers([PHOTOGRAPHED])(edit_scene(scene, request), camera.resize(columns, rows))
    small = torch.nn.functional.interpolate(
        photo.to(frame.rgb).movedim(-1, 0)[None], (rows, columns), mode="bilinear", antialias=True
    )[0].movedim(0, -1)
    colors = error_colors(frame.exposed(scene.exposures.interpolate(name), name), small)
    missing = max(1, round(request.aspect * rows)) - columns
    left = missing // 2
    return _to_uint8(torch.nn.functional.pad(colors, (0, 0, left, missing - left)))


@torch.no_grad()
def surface_point(
    scene: Scene, renderer: Renderer, request: ViewRequest, direction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """[3] the surface point visible in a direction [3] (world axes) from the camera of a request."""
    camera = request.camera(MEASURED_ROWS)
    x, y, z = (camera.cam_from_world[:3, :3].double().numpy() @ direction).tolist()
    if z <= 0:
        raise ValueError("the direction is behind the camera")
    column, row = int(camera.fx * x / z + camera.cx), int(camera.fy * y / z + camera.cy)
    frame = renderer.with_layers(["depth"])(edit_scene(scene, request), camera)
    is_inside = 0 <= row < camera.height and 0 <= column < camera.width
    if not is_inside or float(frame.layers["alpha"][row, column]) < SURFACE_COVERAGE:
        raise ValueError("there is no surface")
    depth = float(frame.layers["depth"][row, column])
    point: NDArray[np.float64] = camera.center.double().numpy() + depth / z * direction
    return point


def _to_uint8(image: Tensor) -> NDArray[np.uint8]:
    """An image [H, W] or [H, W, 3] in [0, 1] as bytes."""
    if image.dim() == 2:
        image = image[..., None].expand(-1, -1, 3)
    pixels: NDArray[np.uint8] = torch.round(image.clamp(0, 1) * 255).to("cpu", torch.uint8).contiguous().numpy()
    return pixels
