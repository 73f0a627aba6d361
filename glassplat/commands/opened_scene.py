"""Opening whatever holds a scene: a run, an imported scene, or a splat file; the photographs need not be there."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from glassplat.commands.imported_scene import NamedCameras, imported_scene
from glassplat.commands.stored_run import Split
from glassplat.data.dataset import TEST_EVERY
from glassplat.data.errors import InputError, input_checked
from glassplat.files.cameras_json import read_cameras
from glassplat.kernels.devices import DeviceName, chosen_device
from glassplat.render.frame import Renderer
from glassplat.scene.scene import Scene
from glassplat.train.background import BLACK, with_background
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.run_directory import RunDirectory


class OpenedScene(NamedTuple):
    """A scene that can be looked at.

    Attributes:
        path: what was opened.
        name: what to call it.
        recipe: of the run; of an imported scene one that renders it as it is.
        scene: on the device that was asked for.
        renderer: as the run renders it.
        cameras: of the photographs, by name; for an imported scene some that look at it.
    """

    path: Path
    name: str
    recipe: Any
    scene: Scene
    renderer: Renderer
    cameras: NamedCameras


def open_scene(path: Path, device: DeviceName = "auto") -> OpenedScene:
    """Opens the scene of a run, or of a splat file as it is.

    Raises:
        CudaUnavailableError: the GPU was asked for and cannot be used.
        InputError: nothing that can be looked at is there, or it cannot be read.
    """
    if path.is_file():
        return _opened_file(path, device)
    directory = RunDirectory(path)
    recipe: Any = with_background_of(directory.recipe())
    scene, _ = directory.latest_scene()
    renderer = recipe.renderer()
    with input_checked():
        renderer.check(scene)
        cameras = tuple(read_cameras(path / "cameras.json"))
    if not cameras:
        raise InputError(f"{path / 'cameras.json'} lists no camera; expected those of the photographs")
    return OpenedScene(path, path.resolve().name, recipe, scene.to(chosen_device(device)), renderer, cameras)


def _opened_file(path: Path, device: DeviceName) -> OpenedScene:
    """A scene that was not trained here, over black."""
    with input_checked():
        scene, cameras, _ = imported_scene(path)
    recipe = PlanarRecipe(background=BLACK)
    return OpenedScene(path, path.stem, recipe, scene.to(chosen_device(device)), recipe.renderer(), cameras)


def with_background_of(recipe: Any) -> Any:
    """The recipe with a background; runs record theirs, but for those of earlier versions."""
    return with_background(recipe, BLACK)


def cameras_of(opened: OpenedScene, split: Split) -> NamedCameras:
    """The cameras of a split, by name: every eighth is of the test views."""
    by_name = tuple(sorted(opened.cameras, key=lambda named: named[0]))
    if split == "all" or len(by_name) < TEST_EVERY:
        return by_name
    is_test = split == "test"
    return tuple(named for index, named in enumerate(by_name) if (index % TEST_EVERY == 0) == is_test)
