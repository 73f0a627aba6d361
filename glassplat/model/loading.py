"""Opening whatever holds a scene: a run, a scene folder, or a splat file; photographs need not be there."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch

from glassplat.errors import InputError, input_checked
from glassplat.files.ply import read_gaussians
from glassplat.files.scene_folder import drawable, read_splats
from glassplat.files.sidecars import read_cameras, read_planes
from glassplat.files.writing import SPLAT_SUFFIXES, real_path, scene_source
from glassplat.kernels.backend.devices import DeviceName, chosen_device
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.recipe import with_background
from glassplat.model.model import Model, by_name
from glassplat.model.run_directory import RunDirectory
from glassplat.options import BLACK, Up
from glassplat.panes.material import OPAQUE_SHEET, glass_gaussians, with_intensity
from glassplat.publish.web_page import bounding_ball, cameras_around
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene

NamedCameras = tuple[tuple[str, Camera], ...]
AXES: dict[str, tuple[int, int, int]] = {
    "x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1),
}  # fmt: skip
EXTENT_MARGIN = 1.1
LOADED = f"a run, a folder of an export, or a splat file ({', '.join(SPLAT_SUFFIXES)})"
"""What can be opened."""
log = logging.getLogger(__name__)


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
    """Extent of the scene as training defines it; of a single camera that of the scene."""
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


def load(
    path: str | os.PathLike[str],
    *,
    device: DeviceName = "auto",
    planes: str | os.PathLike[str] | None = None,
    up: Up = "-y",
) -> Model:
    """Opens a trained run, a model that was saved as one, or a splat file of any program.

    Beside a splat file, `planes.json`, `glass.ply` and `cameras.json` are read if they are there, as `Model.save` and
    `glassplat export` write them.

    Args:
        path: a run's directory, a folder of `Model.save` or `glassplat export`, or a .ply, .spz, .splat or .glb.
        device: where the scene's tensors go; `auto` takes an NVIDIA GPU where one can be used.
        planes: panes of a splat file, a planes.json written by hand or by `export`; the one beside it if not given.
        up: which way is up in a splat file, for the cameras that look at it, if no cameras.json is beside it.

    Raises:
        CudaUnavailableError: the GPU was asked for and cannot be used.
        InputError: nothing that can be looked at is there, it cannot be read, or panes are given to a run.
        FileNotFoundError: nothing is there.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"there is nothing at {path}; expected {LOADED}")
    source = scene_source(path)
    if not source.is_dir():
        model = _from_file(source, device, None if planes is None else Path(planes), up)
        return model if source == path else replace(model, name=path.resolve().name)
    if planes is not None:
        raise InputError(f"{path} is no splat file, and has panes of its own or none; {planes} is for splat files")
    return _from_run(path, device)


def _from_run(path: Path, device: DeviceName) -> Model:
    directory = RunDirectory(path)
    recipe: Any = with_background(directory.recipe(), BLACK)  # Runs record theirs, but for those of earlier versions.
    scene, _ = directory.latest_scene()
    with input_checked():
        recipe.renderer().check(scene)
        cameras = read_cameras(path / "cameras.json")
    if not cameras:
        raise InputError(f"{path / 'cameras.json'} lists no camera; expected those of the photographs")
    return Model(scene.to(chosen_device(device)), recipe, by_name(cameras), path.resolve().name, path)


def _from_file(path: Path, device: DeviceName, planes: Path | None, up: Up) -> Model:
    """A scene that was not trained here, over black."""
    with input_checked():
        scene, cameras, lost = imported_scene(path, planes, up)
    if lost:
        log.warning("%d Gaussians of %s are left out: values that are no numbers or too large to draw", lost, path)
    return Model(scene.to(chosen_device(device)), PlanarRecipe(background=BLACK), by_name(cameras), path.stem, path)
