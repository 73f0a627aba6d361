"""`glassplat import`: a splat file of another program as a scene of this one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.commands.console.messages import say, warn
from glassplat.commands.runs.scene_place import check_file
from glassplat.data.errors import InputError, input_checked
from glassplat.data.ranges import Up
from glassplat.files.folders import check_folder


@dataclass(frozen=True)
class Import:
    """Read a splat file (PLY, SPZ, GLB, .splat) of any program as a scene to look at, film and export.

    Attributes:
        file: a .ply as 3DGS and gsplat write it or as SuperSplat compresses it, a .spz of versions
            1 to 4, a .glb with KHR_gaussian_splatting, or a .splat.
        output: where the scene goes; a new folder. It can be used like a run, but for what needs photographs.
        planes: planes.json of the panes, written by hand or by `export`; the one beside the file if not given.
        up: which way is up, for the cameras that look at it; y points down in most files. A cameras.json beside the
            file, as `export` writes it, is taken instead.
    """

    file: tyro.conf.Positional[Path]
    output: Path
    planes: Path | None = None
    up: Up = "-y"

    def ready(self) -> None:
        """Refuses files that cannot be read, and an output that is not empty; imports what reads and writes."""
        check_folder(self.output)
        if self.output.exists() and any(self.output.iterdir()):
            raise InputError(f"{self.output} is not empty; nothing was written. Choose a new folder for --output")
        for file in (self.file, *([] if self.planes is None else [self.planes])):
            check_file(file)
        import_now("glassplat.interface.saving")

    def run(self, console: Console) -> None:
        """Reads and writes."""
        from glassplat.data.backgrounds import BLACK
        from glassplat.interface.imported_scene import imported_scene
        from glassplat.interface.model import Model, by_name
        from glassplat.interface.saving import write_as_run
        from glassplat.train.planar_recipe import PlanarRecipe

        with input_checked():
            scene, cameras, lost = imported_scene(self.file, self.planes, self.up)
        if lost:
            warn(console, f"{lost} Gaussians were left out: values that are no numbers or too large to draw")
        model = Model(scene, PlanarRecipe(background=BLACK), by_name(cameras))
        write_as_run(self.output, model, self.file)
        panes = f", {len(scene.planes)} panes" if len(scene.planes) else ""
        say(console, f"{len(scene.primary)} Gaussians of degree {scene.primary.max_sh_degree}{panes} -> {self.output}")
        say(console, f"next: glassplat view {self.output}")

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"{self.output} may hold a part of the scene: delete it and repeat the command"
