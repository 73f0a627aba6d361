"""What there is to look at, and what may be kept of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from glassplat.render.frame import Renderer
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene

Photograph = Callable[[], Tensor]


class Keeper(Protocol):
    """Writes what was made in the browser, each under a new name, and says where it is.

    Both raise InputError or OSError, with nothing overwritten, where that cannot be.
    """

    def keep_scene(self, scene: Scene, name: str) -> str:
        """Writes an edited scene."""

    def keep_keyframes(self, cameras: Sequence[Camera], name: str) -> str:
        """Writes the cameras of a film."""


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
        keeper: writes what is made in the browser; None where nothing may be written.
    """

    title: str
    scene: Scene
    renderer: Renderer
    layers: Sequence[str]
    cameras: Sequence[tuple[str, Camera]]
    photographs: Mapping[str, Photograph]
    keeper: Keeper | None = None


class Viewpoints:
    """Places and directions of all photographs, to find the one that is nearest to a view."""

    def __init__(self, cameras: Sequence[Camera], extent: float) -> None:
        """Keeps where the cameras are.

        Args:
            cameras: at least one.
            extent: of the scene: that far away counts as much as a radian aside.
        """
        self._centers = np.stack([camera.center.double().cpu().numpy() for camera in cameras])
        self._forwards = np.stack([camera.cam_from_world[2, :3].double().cpu().numpy() for camera in cameras])
        self._extent = extent

    def nearest(self, center: NDArray[np.float64], forward: NDArray[np.float64]) -> int:
        """The camera whose place and direction are nearest to those of a view; both [3]."""
        away = np.linalg.norm(self._centers - center, axis=1) / self._extent
        aside = np.arccos(np.clip(self._forwards @ forward, -1, 1))
        return int(np.argmin(away + aside))
