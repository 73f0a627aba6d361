"""`glassplat export`: a scene in the formats that others read."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.commands.runs.output_folder import check_claim
from glassplat.commands.runs.scene_edits import SceneEdits
from glassplat.commands.runs.scene_place import check_scene, say_scene
from glassplat.data.errors import InputError
from glassplat.kernels.backend.devices import DeviceName

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
        import_now("glassplat.commands.publishing.exporting")

    def run(self, console: Console) -> None:
        """Writes the files."""
        from glassplat.commands.publishing.exporting import write_files

        write_files(self, console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"files already written to {self.output} are whole: repeat the command for all of them"
