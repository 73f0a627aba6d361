"""`glassplat info`: what a path holds, whether it is healthy, and what to do next."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_now
from glassplat.commands.console.messages import say, warn
from glassplat.commands.inspecting.finding import Finding
from glassplat.commands.inspecting.info_of_photographs import photographs_finding, preparation_finding, video_finding
from glassplat.data.errors import InputError, UnknownFormatError, first_names
from glassplat.files.folders import SCENE
from glassplat.files.images import IMAGE_SUFFIXES
from glassplat.prepare.video import VIDEO_SUFFIXES
from glassplat.train.run_directory import RunDirectory

CAPTURES, SCENES = (f"glassplat.commands.inspecting.info_of_{what}" for what in ("capture", "scene"))
"""What needs PyTorch to find out, and is imported only for a path that needs it."""
SPLATS = (".ply", ".spz", ".glb")
KINDS = "a capture, photographs, a video, a run, an exported scene, or a splat file (.ply, .spz, .glb)"


@dataclass(frozen=True)
class Info:
    """Say what a folder or file is, whether it is healthy, and what to do next.

    Attributes:
        path: anything that glassplat reads or writes.
        json: print it for programs.
        page: of a capture from `prepare`, its report anew, with the panes and the points behind them, as an HTML file.
    """

    path: tyro.conf.Positional[Path]
    json: bool = False
    page: Path | None = None

    def ready(self) -> None:
        """Refuses what is not known, and imports what reads the rest."""
        finder_of(self.path)

    def run(self, console: Console) -> None:
        """Looks and tells."""
        finding = finder_of(self.path)(self.path)
        if self.page is not None:
            import_now(CAPTURES).write_capture_page(self.path, self.page)
        if self.json:
            say(console, json.dumps({"path": str(self.path), **finding.as_json()}, indent=1))
            return
        say(console, f"{self.path}: {finding.kind}")
        for name, fact in finding.facts.items():
            say(console, f"  {name}: {fact}")
        for problem in finding.problems:
            warn(console, problem)
        for command in finding.next:
            say(console, f"next: {command}")

    def left_behind(self) -> str:
        """What an interrupt leaves: everything."""
        return "nothing was changed"


def finder_of(path: Path) -> Callable[[Path], Finding]:
    """What finds out about a path; imported now, with PyTorch where it needs that.

    Raises:
        FileNotFoundError: nothing is there.
        InputError: nothing that is known.
    """
    if not os.path.lexists(path):
        raise FileNotFoundError(f"there is nothing at {path}; expected {KINDS}")
    return _finder_of_folder(path) if path.is_dir() else _finder_of_file(path)


def _finder_of_file(path: Path) -> Callable[[Path], Finding]:
    suffix = path.suffix.lower()
    if suffix in SPLATS:
        return import_now(SCENES).splat_finding
    if suffix in VIDEO_SUFFIXES:
        return video_finding
    raise InputError(f"{path} is no file that is known; expected {KINDS}")


def _finder_of_folder(path: Path) -> Callable[[Path], Finding]:
    if (path / "recipe.json").is_file():
        return import_now(SCENES).run_finding
    if RunDirectory(path).is_saved:
        raise InputError(f"{path} holds a scene, but no recipe.json; expected what `glassplat train --output` wrote")
    if path.name.endswith(".partial") and (path / "settings.json").is_file():
        return preparation_finding
    if (path / SCENE).is_file():
        return import_now(SCENES).scene_finding
    if all(one.suffix.lower() in IMAGE_SUFFIXES for one in path.iterdir()):
        return _photographs_or_nothing
    import_now(CAPTURES)
    return _capture_or_photographs


def _capture_or_photographs(path: Path) -> Finding:
    try:
        return import_now(CAPTURES).capture_finding(path)
    except UnknownFormatError:
        return _photographs_or_nothing(path)


def _photographs_or_nothing(path: Path) -> Finding:
    found = photographs_finding(path)
    if found is None:
        names = first_names(sorted(one.name for one in path.iterdir()), 8) or "nothing"
        raise InputError(f"{path} is nothing that is known; expected {KINDS}; it holds {names}")
    return found
