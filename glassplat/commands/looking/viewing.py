"""What `glassplat view` does: serves a scene to a browser, and says where it is to be looked at."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from torch import Tensor

from glassplat.commands.console.messages import say
from glassplat.commands.looking.view import View
from glassplat.commands.runs.stored_run import capture_of
from glassplat.data.errors import InputError
from glassplat.interface.keeping import KeptBeside
from glassplat.interface.loading import load
from glassplat.interface.model import Model
from glassplat.interface.watching import shown_of
from glassplat.serving.access import is_local
from glassplat.train.run_directory import RunDirectory
from glassplat.viewer.server import Viewer


def serve(command: View, console: Console) -> None:
    """Serves until it is interrupted."""
    model = load(command.scene, device=command.device)
    model = model.with_scene(command.edits.applied(model.scene))
    viewer = Viewer(shown_of(model, photographs_of(command.scene), keeper(command, model)), command.host, command.port)
    viewer.start()
    try:
        announce(viewer, console)
        say(console, "Ctrl-C ends it")
        while True:
            time.sleep(3600)
    finally:
        viewer.stop()


def keeper(command: View, model: Model) -> KeptBeside | None:
    """Who may look from elsewhere must not write here unless that was asked for."""
    if command.output is None and not is_local(command.host):
        return None
    return KeptBeside(model, command.output or Path(os.path.abspath(command.scene)).parent)


def announce(viewer: Viewer, console: Console) -> None:
    """Says where to look."""
    say(console, f"look at {viewer.address}")
    if is_local(viewer.host):
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
