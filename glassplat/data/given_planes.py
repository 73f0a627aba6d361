"""Panes that a capture gives as rectangles, in `planes.json`, in place of masks or beside them."""

from __future__ import annotations

from collections.abc import Sequence
from os.path import lexists
from pathlib import Path

import torch

from glassplat.data.errors import InputError, input_checked
from glassplat.files.planes_json import read_planes
from glassplat.scene.camera import Camera
from glassplat.scene.plane import Planes

PLANES = "planes.json"
SAMPLES = 9
"""Points along each side of a rectangle that are looked for in the photographs."""


def given_planes(root: Path, cameras: Sequence[Camera]) -> Planes | None:
    """The rectangles in a capture's own frame; None where it gives none.

    Args:
        root: the capture's folder.
        cameras: its training cameras, each pane in the sight of one at least.

    Raises:
        InputError: the file is damaged, or a pane lies where no camera looks, as in another capture's frame.
    """
    path = root / PLANES
    if not lexists(path):
        return None
    with input_checked():
        planes = read_planes(path)
    for row, label in enumerate(planes.labels):
        places = rectangle_points(planes.select([row]))
        if not any(_shows(camera, places) for camera in cameras):
            raise InputError(
                f"no photograph shows pane {label} of {path}; expected a rectangle in the capture's own frame: mark it "
                "again, or remove it from the file"
            )
    return planes if len(planes) else None


def rectangle_points(plane: Planes) -> torch.Tensor:
    """[P, 3] points spread evenly over the rectangle of one plane, its corners among them."""
    (tangent,), (bitangent,) = plane.axes()
    steps = torch.linspace(-1, 1, SAMPLES)
    u, v = torch.meshgrid(steps, steps, indexing="ij")
    half_u, half_v = plane.half_sizes[0]
    return plane.centers[0] + u.reshape(-1, 1) * half_u * tangent + v.reshape(-1, 1) * half_v * bitangent


def _shows(camera: Camera, places: torch.Tensor) -> bool:
    pixels, depth = camera.project(places)
    size = pixels.new_tensor([camera.width, camera.height])
    return bool(((pixels >= 0).all(dim=1) & (pixels < size).all(dim=1) & (depth > 0)).any())
