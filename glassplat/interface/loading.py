"""Opening whatever holds a scene: a run, an imported scene, or a splat file; the photographs need not be there."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from glassplat.data.backgrounds import BLACK
from glassplat.data.errors import InputError, input_checked
from glassplat.files.cameras_json import read_cameras
from glassplat.interface.imported_scene import imported_scene
from glassplat.interface.model import Model, by_name
from glassplat.kernels.backend.devices import DeviceName, chosen_device
from glassplat.train.background import with_background
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.run_directory import RunDirectory


def load(path: str | os.PathLike[str], *, device: DeviceName = "auto") -> Model:
    """Opens a trained run, an imported scene, or a splat file of any program.

    Beside a splat file, `planes.json`, `glass.ply` and `cameras.json` are read if they are there, as `Model.save` and
    `glassplat export` write them.

    Args:
        path: a run's directory, the folder of `glassplat import`, or a .ply, .spz, .splat or .glb.
        device: where the scene's tensors go; `auto` takes an NVIDIA GPU where one can be used.

    Raises:
        CudaUnavailableError: the GPU was asked for and cannot be used.
        InputError: nothing that can be looked at is there, or it cannot be read.
        FileNotFoundError: nothing is there.
    """
    path = Path(path)
    if path.is_file() or path.suffix:
        return _from_file(path, device) if not path.is_dir() else _from_run(path, device)
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


def _from_file(path: Path, device: DeviceName) -> Model:
    """A scene that was not trained here, over black."""
    with input_checked():
        scene, cameras, _ = imported_scene(path)
    return Model(scene.to(chosen_device(device)), PlanarRecipe(background=BLACK), by_name(cameras), path.stem, path)
