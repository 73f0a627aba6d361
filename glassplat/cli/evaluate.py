"""`glassplat eval`: metrics and pictures of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console

from glassplat.cli.console import import_now, say
from glassplat.cli.places import say_scene
from glassplat.kernels.backend.devices import DeviceName
from glassplat.model.run_directory import RunDirectory

PaneSource = Literal["auto", "truth", "masks", "rendered"]
Align = Literal["auto", "always", "never"]
"""Whether test cameras are moved before they are scored."""


@dataclass(frozen=True)
class Evaluate:
    """Measure a run on its test views and write comparison sheets.

    Attributes:
        run_directory: the run's directory.
        device: where to render; auto takes an NVIDIA GPU where one can be used.
        data: where the capture is now, if it has moved since training.
        panes: where views show panes, for the metric over them: what the ground truth says, the masks and the planes
            that are fitted to them, or the mask that the run renders; auto takes the first of these that there is.
            Runs of different methods compare over the same pixels with the first two.
        align: move the camera of each test view to where its photograph agrees best with the scene, before it is
            scored; auto does so for runs that refined the cameras of training views.
    """

    run_directory: tyro.conf.Positional[Path]
    device: DeviceName = "auto"
    data: Path | None = None
    panes: PaneSource = "auto"
    align: Align = "auto"

    def ready(self) -> None:
        """Refuses what is no run, and imports what renders."""
        RunDirectory(self.run_directory).check_begun()
        say_scene(self.run_directory)
        import_now("glassplat.cli.evaluation")

    def run(self, console: Console) -> None:
        """Evaluates and reports."""
        from glassplat.cli.evaluation import evaluate_run, print_results
        from glassplat.cli.runs import open_run

        stored = open_run(self.run_directory, self.device, self.data)
        with console.status(f"rendering {len(stored.dataset.test)} test views"):
            results = evaluate_run(stored, self.panes, align=self.align)
        print_results(console, results)
        say(console, f"pictures: {stored.directory.path / 'index.html'}")

    def left_behind(self) -> str:
        """Text after an interrupt: the state on disk, and how to go on."""
        return f"{self.run_directory} itself is as it was: repeat the command to evaluate it"
