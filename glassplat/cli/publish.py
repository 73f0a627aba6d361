"""`glassplat export`, `import` and `dereflect`: scenes in other formats, and photographs without reflections."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from glassplat.cli.console import import_now, say, warn
from glassplat.cli.places import SceneEdits, Split, check_claim, check_file, check_scene, say_scene
from glassplat.errors import InputError, input_checked
from glassplat.files.writing import check_folder
from glassplat.kernels.backend.devices import DeviceName
from glassplat.model.run_directory import RunDirectory
from glassplat.options import Up

Format = Literal["ply", "spz", "glb", "html"]


@dataclass(frozen=True)
class Export:
    """Write a scene as others read it: PLY, SPZ, GLB, a web page with live panes, and the panes beside them.

    Attributes:
        run_directory: the run's directory.
        output: where the files go; a new folder, or one that this command wrote.
        formats: which files; glb is glTF with KHR_gaussian_splatting, html a page that shows the scene in any browser,
            by itself and without a server.
        layer: all is the scene with its panes beside it, as planes.json and glass.ply; transmission is the place
            without its panes and what they reflect.
        title: of the page; the run's name if not given.
        spz_version: 3, which every reader knows, or 4.
        edits: changes to the panes.
        device: where to render what has to be rendered; auto takes an NVIDIA GPU where one can be used.
    """

    run_directory: tyro.conf.Positional[Path]
    output: Path
    formats: tuple[Format, ...] = ("ply", "spz", "html")
    layer: Literal["all", "transmission"] = "all"
    title: str | None = None
    spz_version: Literal[3, 4] = 3
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def ready(self) -> None:
        """Refuses what contradicts itself, what is no scene, and an output that holds something else."""
        if not self.formats:
            raise InputError("nothing to write without --formats; expected ply, spz, glb or html")
        check_scene(self.run_directory)
        check_claim(self.output, "export")
        say_scene(self.run_directory)
        import_now("glassplat.cli.writing")

    def run(self, console: Console) -> None:
        """Writes the files."""
        from glassplat.cli.writing import write_files

        write_files(self, console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"files already written to {self.output} are whole: repeat the command for all of them"


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
        import_now("glassplat.model.model")

    def run(self, console: Console) -> None:
        """Reads and writes."""
        from glassplat.methods.planar_recipe import PlanarRecipe
        from glassplat.model.loading import imported_scene
        from glassplat.model.model import Model, by_name, write_as_run
        from glassplat.options import BLACK

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


@dataclass(frozen=True)
class Dereflect:
    """Take the reflections out of a planar run's photographs; one PNG per photograph, under its name.

    Attributes:
        run_directory: the run's directory.
        output: where the images go; a new folder, or one that this command wrote.
        split: which photographs.
        source: photo keeps the photograph, and takes the rendered reflection off it where a pane is; render shows
            the rendered scene without its panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
        data: where the capture is now, if it has moved since training.
    """

    run_directory: tyro.conf.Positional[Path]
    output: Path
    split: Split = "all"
    source: Literal["photo", "render"] = "photo"
    device: DeviceName = "auto"
    data: Path | None = None

    def ready(self) -> None:
        """Refuses what is no run, and an output that holds something else; imports what renders."""
        RunDirectory(self.run_directory).check_begun()
        check_claim(self.output, "dereflect")
        say_scene(self.run_directory)
        import_now("glassplat.cli.writing")

    def run(self, console: Console) -> None:
        """Writes the images."""
        from glassplat.cli.writing import write_dereflected

        write_dereflected(self, console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"images already written to {self.output} are whole: repeat the command for all of them"
