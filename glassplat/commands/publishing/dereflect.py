"""`glassplat dereflect`: the photographs without what the panes reflect."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.commands.runs.output_folder import check_claim
from glassplat.commands.runs.scene_place import say_scene
from glassplat.commands.runs.splits import Split
from glassplat.kernels.backend.devices import DeviceName
from glassplat.train.run_directory import RunDirectory


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
        import_now("glassplat.commands.publishing.reflections_off")

    def run(self, console: Console) -> None:
        """Writes the images."""
        from glassplat.commands.publishing.reflections_off import write_dereflected

        write_dereflected(self, console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"images already written to {self.output} are whole: repeat the command for all of them"
