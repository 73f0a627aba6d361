"""A splat file of another program as a scene, with panes and cameras from beside it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch

from glassplat.data.errors import InputError
from glassplat.data.ranges import Up
from glassplat.files.cameras_json import read_cameras
from glassplat.files.folders import real_path
from glassplat.files.planes_json import read_planes
from glassplat.files.ply import read_gaussians
from glassplat.files.splat_files import drawable, read_splats
from glassplat.init.glass import OPAQUE_SHEET, glass_gaussians, with_intensity
from glassplat.publish.look_around import bounding_ball, cameras_around
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.scene import Scene

NamedCameras = tuple[tuple[str, Camera], ...]
AXES: dict[str, tuple[int, int, int]] = {
    "x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1),
}  # fmt: skip
EXTENT_MARGIN = 1.1


class ImportedScene(NamedTuple):
    """A scene without photographs, the cameras to look at it from, and how many Gaussians could not be drawn."""

    scene: Scene
    cameras: NamedCameras
    lost: int


def imported_scene(file: Path, planes_file: Path | None = None, up: Up = "-y") -> ImportedScene:
    """Reads a splat file, and beside it planes.json, glass.ply and cameras.json, as `export` writes them.

    Args:
        file: the splats.
        planes_file: the panes, in place of those beside the file; glass is then spread evenly over each. The one
            beside the file is no other.
        up: which way is up, for cameras that nobody gives.

    Raises:
        FileNotFoundError, ValueError: a file is missing, damaged or foreign, or holds nothing to draw.
    """
    gaussians, lost = drawable(read_splats(file), file)
    if not len(gaussians):
        raise InputError(f"{file} holds no Gaussians; expected a trained splat")
    planes = _planes(file, planes_file)
    glass = _glass(
        file, planes, own=planes_file is None or real_path(planes_file) == real_path(file.with_name("planes.json"))
    )
    cameras = _cameras(file, gaussians, up)
    scene = Scene(with_intensity(gaussians), extent_of(gaussians, cameras), glass=glass, planes=planes)
    return ImportedScene(scene, cameras, lost)


def extent_of(gaussians: Gaussians, cameras: NamedCameras) -> float:
    """What training would call the scene's extent; of a single camera that of the scene."""
    centers = torch.stack([camera.center for _, camera in cameras])
    radius = float((centers - centers.mean(0)).norm(dim=1).max())
    return EXTENT_MARGIN * (radius or bounding_ball(gaussians)[1])


def _planes(file: Path, planes_file: Path | None) -> Planes:
    beside = file.with_name("planes.json")
    if planes_file is None and not beside.is_file():
        return Planes.empty()
    return read_planes(planes_file or beside)


def _glass(file: Path, planes: Planes, *, own: bool) -> Gaussians:
    """The glass that lies beside the file, or else an even sheet on each pane."""
    beside = file.with_name("glass.ply")
    if not len(planes) or not own or not beside.is_file():
        return glass_gaussians(planes, opacity=OPAQUE_SHEET)
    glass, _ = drawable(read_gaussians(beside), beside)
    if "logit_mark" not in glass.channels:
        raise InputError(f"{beside} has no property logit_mark; expected glass as `glassplat export` writes it")
    return glass


def _cameras(file: Path, gaussians: Gaussians, up: Up) -> NamedCameras:
    beside = file.with_name("cameras.json")
    cameras = read_cameras(beside) if beside.is_file() else []
    return tuple(cameras or cameras_around(gaussians, torch.tensor(AXES[up], dtype=torch.float64)))
