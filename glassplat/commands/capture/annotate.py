"""`glassplat annotate`: mark the panes of a capture in the browser."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from glassplat.annotate.server import AnnotationServer
from glassplat.annotate.session import opened_session
from glassplat.commands.console.messages import say, warn
from glassplat.commands.console.work_progress import WorkProgress
from glassplat.data.dataset import Dataset, load_dataset
from glassplat.data.errors import InputError
from glassplat.data.ranges import Range
from glassplat.prepare.messages import Progress
from glassplat.suggest.suggestion import Suggestion, suggested_panes


@dataclass(frozen=True)
class Annotate:
    """Mark the panes of a capture in the browser: corners in a few photographs, and what stands before them.

    Attributes:
        capture: directory of the capture.
        port: to listen on, on this computer only; 0 takes any that is free.
        open_browser: open the page at once; not over SSH.
        suggest: look for panes first: what photographs show both mirrored and directly tells where they are.
        page: serve the page; without it, suggestions are only printed.
    """

    capture: tyro.conf.Positional[Path]
    port: Annotated[int, Range(0, 65535)] = 8765
    open_browser: bool = True
    suggest: bool = False
    page: bool = True

    def run(self, console: Console) -> None:
        """Serves the page until it is closed, or Ctrl-C."""
        if not self.page:
            self._say_suggestions(console)
            return
        session = opened_session(self.capture, lambda dataset: self._suggestions(dataset, console))
        with AnnotationServer(session, self.port) as server:
            port = server.server_address[1]
            say(console, f"{len(session.views)} photographs; the page is at {server.address}")
            say(console, f"over SSH, first: ssh -L {port}:127.0.0.1:{port} HOST; Ctrl-C ends, and nothing is lost")
            if self.open_browser and has_screen():
                webbrowser.open(server.address)
            server.serve_forever(poll_interval=0.2)
        say(console, f"next: glassplat train planar --data {self.capture} --output RUN")

    def _say_suggestions(self, console: Console) -> None:
        if not self.suggest:
            raise InputError("nothing to do: --no-page serves no page, and without --suggest nothing is looked for")
        self._suggestions(load_dataset(self.capture), console)

    def _suggestions(self, dataset: Dataset, console: Console) -> Sequence[Suggestion]:
        """The panes that are proposed, after they were printed; none where none are asked for."""
        if not self.suggest:
            return ()
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

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"what was marked is saved in {self.capture}: repeat the command to go on"


def has_screen() -> bool:
    """Whether a browser that is opened here is seen by whoever typed the command."""
    if "SSH_CONNECTION" in os.environ:
        return False
    return sys.platform in ("darwin", "win32") or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))
