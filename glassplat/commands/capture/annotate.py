"""`glassplat annotate`: mark the panes of a capture in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.data.errors import InputError
from glassplat.data.ranges import Range
from glassplat.files.folders import check_capture_folder


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

    def ready(self) -> None:
        """Refuses what is no folder, and imports what reads it."""
        if not (self.page or self.suggest):
            raise InputError("nothing to do: --no-page serves no page, and without --suggest nothing is looked for")
        check_capture_folder(self.capture)
        import_now("glassplat.commands.capture.marking")

    def run(self, console: Console) -> None:
        """Serves the page until it is closed, or Ctrl-C."""
        from glassplat.commands.capture.marking import say_suggestions, serve

        (serve if self.page else say_suggestions)(self, console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"what was marked is saved in {self.capture}: repeat the command to go on"
