"""`glassplat view`: a scene in the browser, rendered here."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from torch import Tensor

from glassplat.commands.console.messages import say
from glassplat.commands.runs.scene_edits import SceneEdits
from glassplat.commands.runs.stored_run import capture_of
from glassplat.data.errors import InputError
from glassplat.data.ranges import Range
from glassplat.files.folders import check_folder
from glassplat.interface.keeping import KeptBeside
from glassplat.interface.loading import load
from glassplat.interface.model import Model
from glassplat.interface.watching import shown_of
from glassplat.kernels.devices import DeviceName
from glassplat.train.run_directory import RunDirectory
from glassplat.viewer.ports import LOCAL
from glassplat.viewer.server import Viewer


@dataclass(frozen=True)
class View:
    """Look at a scene in the browser, layer by layer, with its panes as they are or edited.

    Attributes:
        scene: a run's directory, an imported scene, or a splat file.
        port: where the browser finds it.
        host: who may look; 127.0.0.1 is this machine alone, 0.0.0.0 everybody who can reach it.
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

    def run(self, console: Console) -> None:
        """Serves until it is interrupted."""
        model = load(self.scene, device=self.device)
        model = model.with_scene(self.edits.applied(model.scene))
        viewer = Viewer(shown_of(model, photographs_of(self.scene), self._keeper(model)), self.host, self.port)
        viewer.start()
        try:
            announce(viewer, console)
            say(console, "Ctrl-C ends it")
            while True:
                time.sleep(3600)
        finally:
            viewer.stop()

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return "what was saved in the browser stays"

    def _keeper(self, model: Model) -> KeptBeside | None:
        """Who may look from elsewhere must not write here unless that was asked for."""
        if self.output is None and self.host != LOCAL:
            return None
        if self.output is not None:
            check_folder(self.output)
        return KeptBeside(model, self.output or Path(os.path.abspath(self.scene)).parent)


def announce(viewer: Viewer, console: Console) -> None:
    """Says where to look."""
    say(console, f"look at {viewer.address}")
    if viewer.host == LOCAL:
        say(console, f"from elsewhere: ssh -L {viewer.port}:localhost:{viewer.port} <this machine>, then the same")


def photographs_of(run: Path) -> dict[str, Callable[[], Tensor]]:
    """The photographs of a run by name, where they still are."""
    directory = RunDirectory(run)
    if not run.is_dir() or directory.imported.is_file():
        return {}
    try:
        dataset = capture_of(directory, directory.recipe())
    except (InputError, FileNotFoundError):
        return {}
    views = [view for view in (*dataset.train, *dataset.test) if view.image_path.is_file()]
    return {view.name: view.read_photo for view in views}
