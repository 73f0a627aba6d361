"""A model as files: of other programs, with the panes beside them, as a page, or as a folder."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Protocol

from glassplat.data.errors import InputError, first_names, input_checked
from glassplat.files.atomic import atomic_write
from glassplat.files.cameras_json import write_cameras
from glassplat.files.environment_image import write_equirect
from glassplat.files.folders import make_folder
from glassplat.files.glb import write_glb
from glassplat.files.planes_json import write_planes
from glassplat.files.ply import write_gaussians
from glassplat.files.reading import read_text
from glassplat.files.spz import write_spz
from glassplat.publish.web_page import can_show, write_page
from glassplat.render.environment import equirect_from_environment
from glassplat.render.frame import Renderer
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.scene import Scene
from glassplat.train.recipe import recipe_to_json
from glassplat.train.run_directory import RunDirectory, write_text

WRITERS: dict[str, Callable[[Path, Gaussians], None]] = {".ply": write_gaussians, ".spz": write_spz, ".glb": write_glb}
PLANES, GLASS, CAMERAS = "planes.json", "glass.ply", "cameras.json"
SETTINGS = "settings.json"
PANORAMA, ENVIRONMENT = "environment.png", "environment.json"


class Savable(Protocol):
    """What of a model is written."""

    @property
    def scene(self) -> Scene:
        """Gaussians and panes."""

    @property
    def recipe(self) -> Any:
        """How it is rendered."""

    @property
    def renderer(self) -> Renderer:
        """The renderer of the recipe."""

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """By name."""

    @property
    def name(self) -> str:
        """What to call it."""


def save_model(model: Savable, path: Path, *, overwrite: bool) -> Path:
    """Writes a model in the format that the path's suffix names, see `Model.save`; returns the path.

    Raises:
        FileExistsError: something is there; nothing was written.
        InputError: the format is not known, or cannot hold this model.
    """
    kind = path.suffix.lower()
    if not kind:
        return save_folder(model, path)
    if kind not in (*WRITERS, ".html"):
        raise InputError(f"{path}: expected a name that ends in {', '.join((*WRITERS, '.html'))}, or a folder's")
    beside = [] if kind == ".html" else [path.with_name(name) for name in (PLANES, GLASS, CAMERAS)]
    found = [str(target) for target in (path, *beside) if target.exists()]
    if found and not overwrite:
        raise FileExistsError(
            f"{first_names(found)} is already there; nothing was written. Choose another folder, or overwrite=True"
        )
    make_folder(path.parent)
    if kind == ".html":
        save_page(model, path, model.name or path.stem)
        return path
    with input_checked():
        WRITERS[kind](path, model.scene.primary)
    write_beside(path.parent, model.scene)
    if not len(model.scene.planes) and (path.parent / PLANES).exists():
        write_planes(path.parent / PLANES, model.scene.planes)  # Panes of what was there must not be taken for its own.
    write_cameras(path.parent / CAMERAS, model.cameras.items())
    return path


def save_page(model: Savable, path: Path, title: str) -> None:
    """Writes the page that shows a model with live panes in any browser.

    Raises:
        InputError: it shows only what `planar` and `splat` render of ellipsoids.
    """
    if not can_show(model.renderer):
        raise InputError(f"the page shows planar and splat scenes, not {model.recipe.method} ones of this kind")
    with input_checked():
        write_page(path, model.scene, model.renderer, tuple(model.cameras.items()), title)


def write_beside(folder: Path, scene: Scene) -> list[Path]:
    """Writes planes, glass and environment, where there are any, and returns what was written."""
    written = []
    if len(scene.planes):
        write_planes(folder / PLANES, scene.planes)
        write_gaussians(folder / GLASS, scene.glass)
        written += [folder / PLANES, folder / GLASS]
    if not scene.environment.is_empty:
        write_environment_files(folder, scene)
        written += [folder / ENVIRONMENT, folder / PANORAMA]
    return written


def write_environment_files(folder: Path, scene: Scene) -> None:
    """The surroundings as a panorama, and a description that says how to read it."""
    environment = scene.environment
    write_equirect(folder / PANORAMA, equirect_from_environment(environment, 2 * environment.size))
    description = {
        "image": PANORAMA,
        "projection": "equirectangular",
        "color": "sRGB",
        "up": "+z in the top row",
        "forward": "+x in the middle column, +y left of it",
        "region": environment.region,
    }
    with atomic_write(folder / ENVIRONMENT) as temporary:
        temporary.write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")


def write_as_run(folder: Path, model: Savable, source: Path | None) -> None:
    """Writes a scene as a run that was not trained; the record comes last, so that a part of one is none.

    What comes of a run knows its capture, as far as the run does.

    Args:
        folder: new or empty.
        model: what to write.
        source: where the scene was read from, for the record.
    """
    make_folder(folder)
    directory = RunDirectory(folder)
    directory.export(model.scene, step=0)
    write_cameras(folder / CAMERAS, model.cameras.items())
    if source is not None and (source / SETTINGS).is_file():
        write_text(folder / SETTINGS, read_text(source / SETTINGS).rstrip("\n"))
    else:
        write_text(directory.imported, json.dumps({"file": None if source is None else str(source.resolve())}))
    write_text(folder / "recipe.json", recipe_to_json(model.recipe))


def save_folder(model: Savable, folder: Path) -> Path:
    """Writes a model as a run of its own, which `load` reads bit for bit; returns the folder.

    Raises:
        FileExistsError: something is there; nothing was written.
    """
    if os.path.lexists(folder) and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} is already there and not empty; nothing was written. Choose a new folder")
    write_as_run(folder, model, getattr(model, "path", None))
    return folder
