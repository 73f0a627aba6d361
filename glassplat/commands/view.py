"""`glassplat view`: a scene in the browser, rendered here."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console
from torch import Tensor

from glassplat.commands.messages import say
from glassplat.commands.scene_edits import SceneEdits
from glassplat.commands.stored_run import open_run
from glassplat.data.errors import InputError
from glassplat.data.ranges import Range
from glassplat.interface.loading import load
from glassplat.interface.model import Model
from glassplat.kernels.devices import DeviceName
from glassplat.viewer.server import Shown, Viewer

LOCAL = "127.0.0.1"
HIDDEN_LAYERS = ("alpha",)


@dataclass(frozen=True)
class View:
    """Look at a scene in the browser, layer by layer, with its panes as they are or edited.

    Attributes:
        scene: a run's directory, an imported scene, or a splat file.
        port: where the browser finds it.
        host: who may look; 127.0.0.1 is this machine alone, 0.0.0.0 everybody who can reach it.
        edits: changes to the panes.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
    """

    scene: tyro.conf.Positional[Path]
    port: Annotated[int, Range(1, 65535)] = 8080
    host: str = LOCAL
    edits: Annotated[SceneEdits, tyro.conf.arg(name="")] = field(default_factory=SceneEdits)
    device: DeviceName = "auto"

    def run(self, console: Console) -> None:
        """Serves until it is interrupted."""
        model = load(self.scene, device=self.device)
        check_port(self.host, self.port)
        viewer = self._viewer(model.with_scene(self.edits.applied(model.scene)))
        try:
            say(console, f"look at http://{'localhost' if self.host == LOCAL else self.host}:{viewer.port}")
            if self.host == LOCAL:
                say(
                    console,
                    f"from elsewhere: ssh -L {viewer.port}:localhost:{viewer.port} <this machine>, then the same",
                )
            say(console, "Ctrl-C ends it")
            while True:
                time.sleep(3600)
        finally:
            viewer.stop()

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return "nothing was changed"

    def _viewer(self, model: Model) -> Viewer:
        try:
            layers = [layer for layer in model.layers if layer not in HIDDEN_LAYERS]
            cameras = tuple(model.cameras.items())
            shown = Shown(model.name, model.scene, model.renderer, layers, cameras, photographs_of(self.scene))
            return Viewer(shown, self.host, self.port)
        except ImportError as error:
            raise InputError(
                f"the viewer needs viser, which is not installed ({error}); pip install 'glassplat[view]', or look at "
                "the page of `glassplat export`, which needs nothing"
            ) from error


def photographs_of(run: Path) -> dict[str, Callable[[], Tensor]]:
    """The photographs of a run by name, where they still are."""
    if not run.is_dir():
        return {}
    try:
        dataset = open_run(run, "cpu").dataset
    except (InputError, FileNotFoundError):
        return {}
    views = [view for view in (*dataset.train, *dataset.test) if view.image_path.is_file()]
    return {view.name: view.read_photo for view in views}


def check_port(host: str, port: int) -> None:
    """Refuses a port that is taken, or an address that is not this machine's, before anything is served.

    Raises:
        InputError: nothing can listen there.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            reason = "in use by another program" if error.errno == errno.EADDRINUSE else (error.strerror or str(error))
            raise InputError(f"port {port} of {host} cannot be used ({reason}); choose another --port") from error
