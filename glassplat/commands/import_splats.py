"""`glassplat import`: a splat file of another program as a scene of this one."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from glassplat.commands.imported_scene import NamedCameras, Up, imported_scene
from glassplat.commands.messages import say, warn
from glassplat.data.errors import InputError, input_checked
from glassplat.files.cameras_json import write_cameras
from glassplat.files.folders import check_folder, make_folder
from glassplat.scene.scene import Scene
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.recipe import recipe_to_json
from glassplat.train.run_directory import RunDirectory, write_text


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
    up: Up = "-y"

    def run(self, console: Console) -> None:
        """Reads and writes."""
        check_folder(self.output)
        if self.output.exists() and any(self.output.iterdir()):
            raise InputError(f"{self.output} is not empty; nothing was written. Choose a new folder for --output")
        with input_checked():
            scene, cameras, lost = imported_scene(self.file, self.planes, self.up)
        if lost:
            warn(console, f"{lost} Gaussians were left out: values that are no numbers or too large to draw")
        write_imported(self.output, scene, cameras, self.file)
        panes = f", {len(scene.planes)} panes" if len(scene.planes) else ""
        say(console, f"{len(scene.primary)} Gaussians of degree {scene.primary.max_sh_degree}{panes} -> {self.output}")
        say(console, f"next: glassplat view {self.output}")

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"{self.output} may hold a part of the scene: delete it and repeat the command"


def write_imported(folder: Path, scene: Scene, cameras: NamedCameras, source: Path) -> None:
    """Writes a scene without photographs as a run; the record comes last, so that a part of one is none."""
    make_folder(folder)
    directory = RunDirectory(folder)
    directory.export(scene, step=0)
    write_cameras(folder / "cameras.json", cameras)
    write_text(directory.imported, json.dumps({"file": str(source.resolve())}))
    write_text(folder / "recipe.json", recipe_to_json(PlanarRecipe(background=(0.0, 0.0, 0.0))))
