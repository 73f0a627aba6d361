"""`glassplat annotate`: mark the panes of a capture in the browser."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.data.ranges import Range
from glassplat.files.folders import check_capture_folder


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

    def ready(self) -> None:
        """Refuses what is no folder, and imports what reads it."""
        check_capture_folder(self.capture)
        import_now("glassplat.commands.capture.marking")

    def run(self, console: Console) -> None:
        """Serves the page until it is closed, or Ctrl-C."""
        from glassplat.commands.capture.marking import serve

        serve(self, console)

    def left_behind(self) -> str:
        """What an interrupt leaves, and how to go on."""
        return f"what was marked is saved in {self.capture}: repeat the command to go on"
