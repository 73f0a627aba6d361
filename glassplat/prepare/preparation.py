"""From photographs or a video to a capture on disk."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from glassplat import __version__
from glassplat.captures.colmap_library import quiet_pycolmap
from glassplat.errors import InputError
from glassplat.files.writing import missing_folders, real_path, remove_empty
from glassplat.prepare.photographs import Listener, Photograph, photographs_in
from glassplat.prepare.reconstruction import Settings, best_solution, write_capture
from glassplat.prepare.report import Report, report_of
from glassplat.prepare.video import VIDEO_SUFFIXES, frames_of
from glassplat.prepare.workplace import Workplace


@dataclass(frozen=True)
class Preparation:
    """Options of a preparation, and its photographs.

    Attributes:
        source: folder of photographs, or a video.
        output: the capture.
        max_size: pixels of the longer side to which photographs are reduced.
        frames: photographs taken from a video, at most.
        least_registered: share of the photographs that have to be placed.
        settings: how they are placed.
    """

    source: Path
    output: Path
    max_size: int = 1600
    frames: int = 150
    least_registered: float = 0.8
    settings: Settings = field(default_factory=Settings)

    def record(self) -> dict[str, Any]:
        """Inputs on which the work depends: an interrupted one goes on with the same only."""
        placing = {"lens": self.settings.lens, "mapper": self.settings.mapper}
        return {
            "input": str(real_path(self.source)),
            "max-size": self.max_size,
            "frames": self.frames,
            **placing,
        }


def prepare(task: Preparation, listen: Listener, *, resume: bool = False, force: bool = False) -> Report:
    """Makes the capture; returns what became of the photographs.

    Args:
        task: what to make of what.
        listen: is told how far it is.
        resume: go on where an earlier call was interrupted.
        force: replace a capture that was prepared before, or begin an interrupted one again.

    Raises:
        InputError: photographs that cannot be used, or too few of them could be placed; the message says what to do.
        OSError: the capture cannot be written.
    """
    check_places(task)
    quiet_pycolmap()
    workplace = Workplace(task.output)
    missing = missing_folders(workplace.folder.parent)
    workplace.begin(task.record(), resume=resume, force=force)
    try:
        photographs = _photographs(task, workplace, listen)
    except InputError:
        remove_empty(missing)
        raise
    solution = best_solution(photographs, workplace.folder, task.settings, listen)
    report = report_of(solution)
    _check_enough(report, task)
    write_capture(solution, workplace.capture, listen)
    made = {"command": "prepare", "version": __version__, **task.record()}
    workplace.finish({**made, "report": asdict(report)})
    return report


def is_video(source: Path) -> bool:
    """Return whether an input is read as a video."""
    return source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES


def check_places(task: Preparation) -> None:
    """Refuse an input that is no photographs, and an output among them.

    Raises:
        InputError: says what to choose instead.
    """
    source, output = real_path(task.source), real_path(task.output)
    if source.is_file() and not is_video(source):
        known = ", ".join(VIDEO_SUFFIXES)
        raise InputError(f"{task.source} is a file; expected a folder of photographs, or a video ({known})")
    if output == source or source in output.parents:
        raise InputError(
            f"the output {task.output} lies inside of the photographs' folder {task.source}; choose a folder beside it"
        )


def _photographs(task: Preparation, workplace: Workplace, listen: Listener) -> list[Photograph]:
    """Those of the folder or the video.

    Raises:
        InputError: they cannot be used; nothing is left behind, as nothing can go on from there.
    """
    try:
        if not is_video(task.source):
            return photographs_in(task.source, task.max_size, listen)
        frames = workplace.folder / "frames"
        frames_of(task.source, frames, task.frames, listen)
        return photographs_in(frames, task.max_size, listen)
    except InputError:
        workplace.discard()
        raise


def _check_enough(report: Report, task: Preparation) -> None:
    """Refuse a capture of which too much is missing, or that no photograph was placed in."""
    if report.registered >= 3 and report.share >= task.least_registered:
        return
    lines = "\n".join(report.lines())
    remedy = (
        f"if that is enough, repeat with --resume --least-registered {int(100 * report.share) / 100:g}"
        if report.registered >= 3
        else "nothing was written"
    )
    raise InputError(
        f"{report.registered} of {report.photographs} photographs could be placed, expected at least "
        f"{task.least_registered:.0%}\n{lines}\n{remedy}"
    )
