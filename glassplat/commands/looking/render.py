"""`glassplat render`: layers of a run as images."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.commands.runs.output_folder import check_claim
from glassplat.commands.runs.scene_edits import SceneEdits
from glassplat.commands.runs.scene_place import say_scene
from glassplat.commands.runs.splits import Split
from glassplat.interface.layers import Layer
from glassplat.kernels.backend.devices import DeviceName
from glassplat.train.run_directory import RunDirectory


@dataclass(frozen=True)
class Render:
    """Render the layers of a run from its cameras, with its panes as they are or edited.

    Attributes:
        run_directory: the run's directory.
        output: where the images go, one folder per layer; a new folder, or one that this command wrote.
        layers: which layers.
        split: which cameras.
        edits: changes to the panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
        data: where the capture is now, if it has moved since training.
    """

    run_directory: tyro.conf.Positional[Path]
    output: Path
    layers: tuple[Layer, ...] = ("rgb",)
    split: Split = "test"
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"
    data: Path | None = None

    def ready(self) -> None:
        """Refuses what is no run, and an output that holds something else; imports what renders."""
        RunDirectory(self.run_directory).check_begun()
        check_claim(self.output, "render")
        say_scene(self.run_directory)
        import_now("glassplat.commands.looking.rendering")

    def run(self, console: Console) -> None:
        """Renders."""
        from glassplat.commands.looking.rendering import write_layers

        write_layers(self, console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"images already written to {self.output} are whole: repeat the command for all of them"
