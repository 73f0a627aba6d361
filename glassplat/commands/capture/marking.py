"""What `glassplat annotate` does: looks for panes, and serves the page on which they are marked."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Sequence

from rich.console import Console

from glassplat.annotate.server import AnnotationServer
from glassplat.annotate.session import opened_session
from glassplat.commands.capture.annotate import Annotate
from glassplat.commands.console.messages import say, warn
from glassplat.commands.console.work_progress import WorkProgress
from glassplat.data.dataset import Dataset, load_dataset
from glassplat.prepare.messages import Progress
from glassplat.suggest.suggestion import Suggestion, suggested_panes


def serve(command: Annotate, console: Console) -> None:
    """Serves the page until it is closed, or Ctrl-C."""
    session = opened_session(command.capture, lambda dataset: found_panes(dataset, console) if command.suggest else ())
    with AnnotationServer(session, command.port) as server:
        port = server.server_address[1]
        say(console, f"{len(session.views)} photographs; the page is at {server.address}")
        say(console, f"over SSH, first: ssh -L {port}:127.0.0.1:{port} HOST; Ctrl-C ends, and nothing is lost")
        if command.open_browser and has_screen():
            webbrowser.open(server.address)
        server.serve_forever(poll_interval=0.2)
    say(console, f"next: glassplat train planar --data {command.capture} --output RUN")


def say_suggestions(command: Annotate, console: Console) -> None:
    """Prints the panes that are proposed."""
    found_panes(load_dataset(command.capture), console)


def found_panes(dataset: Dataset, console: Console) -> Sequence[Suggestion]:
    """The panes that are proposed, after they were printed."""
    views = sorted((*dataset.train, *dataset.test), key=lambda view: view.name)
    with WorkProgress(console) as progress:
        found = suggested_panes(
            views, float(dataset.extent), lambda what, done, count: progress.show(Progress(what, done, count))
        )
    for number, one in enumerate(found, start=1):
        say(console, f"suggestion {number}: {one.described()}")
    if not found:
        warn(console, "no pane was found: too little is seen both mirrored and directly; mark the corners by hand")
    return found


def has_screen() -> bool:
    """Whether a browser that is opened here is seen by whoever typed the command."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform in ("darwin", "win32") or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
