"""`glassplat info`: what a path holds, whether it is healthy, and what to do next."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from glassplat.commands.console.messages import say, warn
from glassplat.commands.inspecting.finding import Finding
from glassplat.commands.inspecting.info_of_capture import (
    capture_finding,
    photographs_finding,
    preparation_finding,
    video_finding,
    write_capture_page,
)
from glassplat.commands.inspecting.info_of_scene import SPLAT_READERS, run_finding, scene_finding, splat_finding
from glassplat.data.errors import InputError, UnknownFormatError, first_names
from glassplat.files.scene_folder import SCENE
from glassplat.prepare.video import VIDEO_SUFFIXES
from glassplat.train.run_directory import RunDirectory

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

    def run(self, console: Console) -> None:
        """Looks and tells."""
        finding = find_out(self.path)
        if self.page is not None:
            write_capture_page(self.path, self.page)
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


def find_out(path: Path) -> Finding:
    """What a path holds.

    Raises:
        FileNotFoundError: nothing is there.
        InputError: nothing that is known, or it is damaged.
    """
    if not os.path.lexists(path):
        raise FileNotFoundError(f"there is nothing at {path}; expected {KINDS}")
    return _of_folder(path) if path.is_dir() else _of_file(path)


def _of_file(path: Path) -> Finding:
    suffix = path.suffix.lower()
    if suffix in SPLAT_READERS:
        return splat_finding(path)
    if suffix in VIDEO_SUFFIXES:
        return video_finding(path)
    raise InputError(f"{path} is no file that is known; expected {KINDS}")


def _of_folder(path: Path) -> Finding:
    if (path / "recipe.json").is_file():
        return run_finding(path)
    if RunDirectory(path).is_saved:
        raise InputError(f"{path} holds a scene, but no recipe.json; expected what `glassplat train --output` wrote")
    if path.name.endswith(".partial") and (path / "settings.json").is_file():
        return preparation_finding(path)
    if (path / SCENE).is_file():
        return scene_finding(path)
    try:
        return capture_finding(path)
    except UnknownFormatError:
        found = photographs_finding(path)
    if found is None:
        names = first_names(sorted(one.name for one in path.iterdir()), 8) or "nothing"
        raise InputError(f"{path} is nothing that is known; expected {KINDS}; it holds {names}")
    return found
