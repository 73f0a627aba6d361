"""`glassplat prepare` and `glassplat annotate`: making a capture of photographs, and marking its panes."""

from __future__ import annotations

import threading
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from glassplat.captures.colmap_library import quiet_pycolmap
from glassplat.cli.console import Command, print_line, shell_word
from glassplat.cli.progress import WorkProgress
from glassplat.files.writing import check_capture_folder, real_path
from glassplat.options import Range, Share
from glassplat.prepare.colmap import LensName, Mapper
from glassplat.prepare.preparation import PAGE, Preparation, WorkFolder, check_paths, prepare


@dataclass(frozen=True)
class Prepare:
    """Estimate the camera poses of photographs and write them as a capture.

    Attributes:
        input: folder of photographs, or a video.
        output: the capture; a new folder.
        max_size: reduce photographs to this many pixels along the longer side.
        frames: maximum number of photographs to take from a video.
        lens: COLMAP's lens model; opencv and opencv_fisheye are for wide lenses.
        mapper: register photographs one by one, or all at once.
        least_registered: minimum share of registered photographs; below it, slower settings are tried, and at last the
            command stops.
        resume: continue an interrupted preparation.
        force: replace a capture that was prepared before, or restart an interrupted preparation.
    """

    input: tyro.conf.Positional[Path]
    output: Path
    max_size: Annotated[int, Range(320, 16384)] = 1600
    frames: Annotated[int, Range(8, 2000)] = 150
    lens: LensName = "simple_radial"
    mapper: Mapper = "incremental"
    least_registered: Share = 0.8
    resume: bool = False
    force: bool = False

    def set_up(self) -> None:
        """Checks input and output, and that pycolmap is installed."""
        check_paths(self._task())
        quiet_pycolmap()

    def _task(self) -> Preparation:
        return Preparation(
            self.input, self._output, self.max_size, self.frames, self.least_registered, self.lens, self.mapper
        )

    @cached_property
    def _output(self) -> Path:
        """The output folder; absolute if the current folder is inside, because a finished capture replaces it."""
        output = real_path(self.output)
        return output if Path.cwd().is_relative_to(output) else self.output

    @cached_property
    def _has_finished(self) -> threading.Event:
        """Set once this command has written the capture; an existing one may be from an earlier command."""
        return threading.Event()

    def run(self, console: Console) -> None:
        """Prepares the capture with progress, and prints a report."""
        with WorkProgress(console) as progress:
            report = prepare(self._task(), progress.show, resume=self.resume, force=self.force)
            self._has_finished.set()
        for line in report.lines():
            label = "advice" if line.startswith("advice: ") else ""
            print_line(console, line.removeprefix("advice: "), label=label, style="yellow")
        from glassplat.prepare.report_page import write_page  # Imports PyTorch, which is not needed before.

        write_page(self._output, self._output / PAGE)
        print_line(console, f"capture: {self._output}, report: {self._output / PAGE}")
        print_line(console, f"next: glassplat annotate {shell_word(self._output)}")

    def interrupt_message(self) -> str:
        """Message after an interrupt: the state on disk, and how to continue."""
        if self._has_finished.is_set():
            page = f"glassplat info {shell_word(self._output)} --page {shell_word(self._output / PAGE)}"
            return f"the capture in {self._output} is complete; `{page}` writes its report"
        if (partial := WorkFolder(self._output).folder).exists():
            return f"repeat the command with --resume to continue; finished work is in {partial}"
        return "nothing was written: repeat the command to start again"


@dataclass(frozen=True)
class Annotate(Command):
    """Mark the panes of a capture in the browser: their corners in a few photographs, and what occludes them.

    Attributes:
        capture: directory of the capture.
        port: local port of the page; 0 picks a free one.
        open_browser: open the page in the browser (not over SSH).
    """

    entry_point = "serving:serve_annotation"

    capture: tyro.conf.Positional[Path]
    port: Annotated[int, Range(0, 65535)] = 8765
    open_browser: bool = True

    def check(self) -> None:
        """Checks that the capture is a folder."""
        check_capture_folder(self.capture)

    def interrupt_message(self) -> str:
        """Message after an interrupt: whether there are marks, and how to continue."""
        from glassplat.annotate.document import ANNOTATIONS, read_document  # Imported by `set_up`.

        with suppress(OSError, ValueError):  # A damaged file is reported when the command starts.
            if not read_document(self.capture)["panes"]:
                return f"no pane of {self.capture} is marked yet: repeat the command to start again"
        return f"the marks are saved in {self.capture / ANNOTATIONS}: repeat the command to continue"
