"""What `glassplat annotate` does: serves the page on which panes are marked."""

from __future__ import annotations

import os
import sys
import webbrowser

from rich.console import Console

from glassplat.annotate.server import AnnotationServer
from glassplat.annotate.session import opened_session
from glassplat.commands.capture.annotate import Annotate
from glassplat.commands.console.messages import say


def serve(command: Annotate, console: Console) -> None:
    """Serves the page until it is closed, or Ctrl-C."""
    session = opened_session(command.capture)
    with AnnotationServer(session, command.port) as server:
        port = server.server_address[1]
        say(console, f"{len(session.views)} photographs; the page is at {server.address}")
        say(console, f"over SSH, first: ssh -L {port}:127.0.0.1:{port} HOST; Ctrl-C ends, and nothing is lost")
        if command.open_browser and has_screen():
            webbrowser.open(server.address)
        server.serve_forever(poll_interval=0.2)
    say(console, f"next: glassplat train planar --data {command.capture} --output RUN")


def has_screen() -> bool:
    """Whether a browser that is opened here is seen by whoever typed the command."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform in ("darwin", "win32") or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
