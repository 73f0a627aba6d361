"""`glassplat view`: a scene in the browser, rendered here."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.commands.runs.scene_edits import SceneEdits
from glassplat.commands.runs.scene_place import check_scene, say_scene
from glassplat.data.ranges import Range
from glassplat.files.folders import check_folder
from glassplat.kernels.backend.devices import DeviceName
from glassplat.viewer.ports import LOCAL, check_port


@dataclass(frozen=True)
class View:
    """Look at a scene in the browser, layer by layer, with its panes as they are or edited.

    Attributes:
        scene: a run's directory, an imported scene, or a splat file.
        port: where the browser finds it.
        host: who may look with the link; 127.0.0.1 is this machine alone, 0.0.0.0 everybody who can reach it.
        output: folder for edited scenes and keyframes that are saved in the browser; the one that holds the scene if
            not given. Where others may look, too, nothing can be saved unless it is given.
        edits: changes to the panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
    """

    scene: tyro.conf.Positional[Path]
    port: Annotated[int, Range(1, 65535)] = 8080
    host: str = LOCAL
    output: Path | None = None
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def ready(self) -> None:
        """Refuses what is no scene, an output that cannot be written, and a port that is taken; imports the viewer."""
        check_scene(self.scene)
        if self.output is not None:
            check_folder(self.output)
        check_port(self.host, self.port)
        say_scene(self.scene)
        import_now("glassplat.commands.looking.viewing")

    def run(self, console: Console) -> None:
        """Serves until it is interrupted."""
        from glassplat.commands.looking.viewing import serve

        serve(self, console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return "what was saved in the browser stays"
