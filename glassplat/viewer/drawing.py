"""What somebody wants to see, and the picture of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.evaluate.colormap import depth_colors, normal_colors
from glassplat.render.frame import Renderer
from glassplat.scene.camera import Camera
from glassplat.scene.plane_edits import as_mirrors, with_reflectance, without_glass
from glassplat.scene.scene import Scene

Glass = Literal["as it is", "mirror", "none"]
LEAST_GAIN, MOST_GAIN = 0.1, 10.0


@dataclass(frozen=True)
class Wish:
    """A view that a client asks for.

    Attributes:
        cam_from_world: [4, 4] rigid.
        fov_rad: vertical field of view.
        aspect: width over height.
        layer: `rgb` or a layer of the renderer's frames.
        glass: what becomes of the panes.
        reflectances: R0 of each pane by label, where it is not the scene's own.
        gain: factor on what the panes mirror.
    """

    cam_from_world: Tensor
    fov_rad: float
    aspect: float
    layer: str = "rgb"
    glass: Glass = "as it is"
    reflectances: tuple[tuple[int, float], ...] = ()
    gain: float = 1.0

    def camera(self, height: int) -> Camera:
        """The camera of a picture with that many rows."""
        focal = height / 2 / float(np.tan(self.fov_rad / 2))
        width = max(1, round(self.aspect * height))
        return Camera(self.cam_from_world, focal, focal, width / 2, height / 2, width, height)


def edited(scene: Scene, wish: Wish) -> Scene:
    """The scene with the panes as they are wished for."""
    if not len(scene.planes) or wish.glass == "none":
        return without_glass(scene) if len(scene.planes) else scene
    for label, reflectance in wish.reflectances:
        scene = with_reflectance(scene, label, reflectance)
    if wish.glass == "mirror":
        scene = as_mirrors(scene, scene.planes.labels)
    logs = scene.primary.channels.get("log_intensity")
    if wish.gain == 1 or logs is None:
        return scene
    shift = float(np.log(np.clip(wish.gain, LEAST_GAIN, MOST_GAIN)))
    return replace(scene, primary=scene.primary.with_tensors({"log_intensity": logs + shift}))


@torch.no_grad()
def drawn(scene: Scene, renderer: Renderer, wish: Wish, height: int) -> NDArray[np.uint8]:
    """The picture [H, W, 3] of a wish; a layer that the scene does not have shows as the image itself."""
    frame = renderer(edited(scene, wish), wish.camera(height))
    image = frame.layers.get(wish.layer, frame.rgb)
    if wish.layer == "depth":
        image = depth_colors(image, frame.layers["alpha"])
    elif wish.layer == "normal":
        image = normal_colors(image)
    if image.dim() == 2:
        image = image[..., None].expand(-1, -1, 3)
    pixels: NDArray[np.uint8] = torch.round(image.clamp(0, 1) * 255).to("cpu", torch.uint8).contiguous().numpy()
    return pixels
