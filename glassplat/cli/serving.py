"""Servers for the browser: the viewer and the annotation page."""

from __future__ import annotations

import os
import sys
import time
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import mkstemp
from typing import TYPE_CHECKING

from rich.console import Console
from torch import Tensor

from glassplat.access import is_local
from glassplat.annotate.server import AnnotationServer
from glassplat.annotate.session import open_session
from glassplat.cli.console import print_line, shell_word
from glassplat.cli.runs import load_run_dataset, print_address
from glassplat.errors import InputError
from glassplat.model.model import Model, viewer_state
from glassplat.model.run_directory import RunDirectory
from glassplat.model.watching import FolderWriter
from glassplat.viewer.server import Viewer

if TYPE_CHECKING:
    from glassplat.cli.capture import Annotate
    from glassplat.cli.scene import View


def serve_viewer(command: View, console: Console) -> None:
    """Serves until interrupted."""
    model = command.file.open(command.scene, command.device)
    model = model.with_scene(command.edits.apply(model.scene))
    viewer = Viewer(
        viewer_state(model, photograph_readers(command.scene), make_writer(command, model)), command.host, command.port
    )
    viewer.start()
    try:
        print_address(viewer, console)
        print_line(console, "Ctrl-C ends it")
        while True:
            time.sleep(3600)
    finally:
        viewer.stop()


def make_writer(command: View, model: Model) -> FolderWriter | None:
    """Writer of edited scenes; with remote clients, writing must be requested explicitly."""
    if command.output is None and not is_local(command.host):
        return None
    return FolderWriter(model, command.output or Path(os.path.abspath(command.scene)).parent)


def photograph_readers(run: Path) -> dict[str, Callable[[], Tensor]]:
    """Existing photographs of a run, by name."""
    directory = RunDirectory(run)
    if not run.is_dir() or directory.import_record.is_file():
        return {}
    try:
        dataset = load_run_dataset(directory, directory.recipe())
    except (InputError, FileNotFoundError):
        return {}
    views = [view for view in (*dataset.train, *dataset.test) if view.image_path.is_file()]
    return {view.name: view.read_photo for view in views}


def serve_annotation(command: Annotate, console: Console) -> None:
    """Serves the page until it is closed or interrupted."""
    session = open_session(command.capture)
    with AnnotationServer(session, command.port) as server, ExitStack() as stack:
        port = server.server_address[1]
        print_line(console, f"{len(session.views)} photographs; the page is at {server.address}")
        print_line(console, f"over SSH, first: ssh -L {port}:127.0.0.1:{port} HOST; Ctrl-C ends, and nothing is lost")
        if command.open_browser and has_screen():
            stack.enter_context(open_in_browser(server.address, session.root))
        server.serve_forever(poll_interval=0.2)
    warning = session.unwritten_warning
    print_line(console, warning or f"next: glassplat train planar --data {shell_word(command.capture)} --output RUN")


@contextmanager
def open_in_browser(address: str, folder: Path) -> Iterator[None]:
    """Open an address through a redirecting file that only this user can read.

    All users of a computer can see a browser's command line, and the address contains the key.
    """
    descriptor, name = mkstemp(dir=folder, prefix="marking-", suffix=".html")
    page = Path(name).absolute()
    try:
        with open(descriptor, "w", encoding="utf-8") as text:
            print(f'<meta http-equiv="refresh" content="0; url={address}">', file=text)
        webbrowser.open(page.as_uri())
        yield
    finally:
        page.unlink(missing_ok=True)


def has_screen() -> bool:
    """Return whether a browser opened here is visible to the user of the command."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform in ("darwin", "win32") or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
