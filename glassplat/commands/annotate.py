"""`glassplat annotate`: mark the panes of a capture in the browser."""

from __future__ import annotations

import os
import sys
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from glassplat.annotate.server import AnnotationServer
from glassplat.annotate.session import opened_session
from glassplat.commands.messages import say
from glassplat.data.ranges import Range


@dataclass(frozen=True)
class Annotate:
    """Mark the panes of a capture in the browser: corners in a few photographs, and what stands before them.

    Attributes:
        capture: directory of the capture.
        port: to listen on, on this computer only; 0 takes any that is free.
        open_browser: open the page at once; not over SSH.
    """

    capture: tyro.conf.Positional[Path]
    port: Annotated[int, Range(0, 65535)] = 8765
    open_browser: bool = True

    def run(self, console: Console) -> None:
        """Serves the page until it is closed, or Ctrl-C."""
        session = opened_session(self.capture)
        with AnnotationServer(session, self.port) as server:
            port = server.server_address[1]
            say(console, f"{len(session.views)} photographs; the page is at {server.address}")
            say(console, f"over SSH, first: ssh -L {port}:127.0.0.1:{port} HOST; Ctrl-C ends, and nothing is lost")
            if self.open_browser and has_screen():
                webbrowser.open(server.address)
            server.serve_forever(poll_interval=0.2)
        say(console, f"next: glassplat train planar --data {self.capture} --output RUN")

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"what was marked is saved in {self.capture}: repeat the command to go on"


def has_screen() -> bool:
    """Whether a browser that is opened here is seen by whoever typed the command."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform in ("darwin", "win32") or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
