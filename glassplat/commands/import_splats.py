"""`glassplat import`: a splat file of another program as a scene of this one."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import tyro
from rich.console import Console

from glassplat.commands.messages import say, warn
from glassplat.commands.opened_scene import NamedCameras
from glassplat.data.errors import InputError, input_checked
from glassplat.files.cameras_json import read_cameras, write_cameras
from glassplat.files.folders import check_folder, make_folder
from glassplat.files.planes_json import read_planes
from glassplat.files.ply import read_gaussians
from glassplat.files.splat_files import drawable, read_splats, with_intensity
from glassplat.init.glass import glass_gaussians
from glassplat.publish.look_around import bounding_ball, cameras_around
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.scene import Scene
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.recipe import recipe_to_json
from glassplat.train.run_directory import RunDirectory, write_text

UP = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
EXTENT_MARGIN = 1.1


@dataclass(frozen=True)
class Import:
    """Read a splat file (PLY, compressed PLY, SPZ, .splat) of any program as a scene to look at, film and export.

    Attributes:
        file: a .ply as 3DGS and gsplat write it or as SuperSplat compresses it, a .spz of versions 1 to 4, or a .splat.
        output: where the scene goes; a new folder. It can be used like a run, but for what needs photographs.
        planes: planes.json of the panes, written by hand or by `export`; the one beside the file if not given.
        up: which way is up, for the cameras that look at it; y points down in most files. A cameras.json beside the
            file, as `export` writes it, is taken instead.
    """

    file: tyro.conf.Positional[Path]
    output: Path
    planes: Path | None = None
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "-y"

    def run(self, console: Console) -> None:
        """Reads and writes."""
        check_folder(self.output)
        if self.output.exists() and any(self.output.iterdir()):
            raise InputError(f"{self.output} is not empty; nothing was written. Choose a new folder for --output")
        with input_checked():
            gaussians, lost = drawable(read_splats(self.file), self.file)
            if not len(gaussians):
                raise InputError(f"{self.file} holds no Gaussians; expected a trained splat")
            planes = self._planes()
            glass = self._glass(planes)
            cameras = self._cameras(gaussians)
        if lost:
            warn(console, f"{lost} Gaussians were left out: values that are no numbers or too large to draw")
        scene = Scene(with_intensity(gaussians), extent_of(gaussians, cameras), glass=glass, planes=planes)
        write_imported(self.output, scene, cameras, self.file)
        panes = f", {len(planes)} panes" if len(planes) else ""
        say(console, f"{len(gaussians)} Gaussians of degree {gaussians.max_sh_degree}{panes} -> {self.output}")
        say(console, f"next: glassplat view {self.output}")

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"{self.output} may hold a part of the scene: delete it and repeat the command"

    def _planes(self) -> Planes:
        beside = self.file.with_name("planes.json")
        if self.planes is None and not beside.is_file():
            return Planes.empty()
        return read_planes(self.planes or beside)

    def _glass(self, planes: Planes) -> Gaussians:
        """The glass that `export` wrote beside the file, or else an even sheet on each pane."""
        beside = self.file.with_name("glass.ply")
        if not len(planes) or self.planes is not None or not beside.is_file():
            return glass_gaussians(planes, opacity=0.9)
        glass, _ = drawable(read_gaussians(beside), beside)
        if "logit_mark" not in glass.channels:
            raise InputError(f"{beside} has no property logit_mark; expected glass as `glassplat export` writes it")
        return glass

    def _cameras(self, gaussians: Gaussians) -> NamedCameras:
        beside = self.file.with_name("cameras.json")
        if beside.is_file():
            cameras = read_cameras(beside)
            if cameras:
                return tuple(cameras)
        return tuple(cameras_around(gaussians, torch.tensor(UP[self.up], dtype=torch.float64)))


def extent_of(gaussians: Gaussians, cameras: NamedCameras) -> float:
    """What training would call the scene's extent; no smaller than the scene is."""
    centers = torch.stack([camera.center for _, camera in cameras])
    radius = float((centers - centers.mean(0)).norm(dim=1).max())
    return EXTENT_MARGIN * (radius or bounding_ball(gaussians)[1])


def write_imported(folder: Path, scene: Scene, cameras: NamedCameras, source: Path) -> None:
    """Writes a scene without photographs as a run; the record comes last, so that a part of one is none."""
    make_folder(folder)
    directory = RunDirectory(folder)
    directory.export(scene, step=0)
    write_cameras(folder / "cameras.json", cameras)
    write_text(directory.imported, json.dumps({"file": str(source.resolve())}))
    write_text(folder / "recipe.json", recipe_to_json(PlanarRecipe(background=(0.0, 0.0, 0.0))))
