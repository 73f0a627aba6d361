"""`glassplat info`: what a path holds, whether it is healthy, and what to do next."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console

from glassplat.commands.console.importing import import_held
from glassplat.commands.console.messages import say, warn
from glassplat.commands.inspecting.finding import KINDS, Finder, Finding
from glassplat.commands.inspecting.info_of_capture import capture_finding
from glassplat.commands.inspecting.info_of_photographs import photographs_finding, preparation_finding, video_finding
from glassplat.commands.inspecting.info_of_scene import run_finding, scene_finding, splat_finding
from glassplat.data.errors import InputError, UnknownFormatError
from glassplat.files.folders import SCENE
from glassplat.files.images import IMAGE_SUFFIXES
from glassplat.files.splat_suffixes import SPLAT_SUFFIXES
from glassplat.prepare.video import VIDEO_SUFFIXES
from glassplat.train.run_directory import RunDirectory

CAPTURE_DETAILS = "glassplat.commands.inspecting.capture_details"


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
        """Refuses what is not known."""
        finder_of(self.path)

    def run(self, console: Console) -> None:
        """Looks, and tells what is found as soon as it is."""
        whole = Finding()
        for part in finder_of(self.path)(self.path):
            if not self.json:
                self._tell_facts(part, console)
            whole.add(part)
        if self.page is not None:
            import_held(CAPTURE_DETAILS).write_capture_page(self.path, self.page)
        if self.json:
            say(console, json.dumps({"path": str(self.path), **whole.as_json()}, indent=1))
            return
        for problem in whole.problems:
            warn(console, problem)
        for command in whole.next:
            say(console, f"next: {command}")

    def _tell_facts(self, part: Finding, console: Console) -> None:
        if part.kind:
            say(console, f"{self.path}: {part.kind}")
        for name, fact in part.facts.items():
            say(console, f"  {name}: {fact}")

    def left_behind(self) -> str:
        """What an interrupt leaves: everything."""
        return "nothing was changed"


def finder_of(path: Path) -> Finder:
    """What finds out about a path.

    Raises:
        FileNotFoundError: nothing is there.
        InputError: nothing that is known.
    """
    if not os.path.lexists(path):
        raise FileNotFoundError(f"there is nothing at {path}; expected {KINDS}")
    return _finder_of_folder(path) if path.is_dir() else _finder_of_file(path)


def _finder_of_file(path: Path) -> Finder:
    suffix = path.suffix.lower()
    if suffix in SPLAT_SUFFIXES:
        return splat_finding
    if suffix in VIDEO_SUFFIXES:
        return video_finding
    raise InputError(f"{path} is no file that is known; expected {KINDS}")


def _finder_of_folder(path: Path) -> Finder:
    if (path / "recipe.json").is_file():
        return run_finding
    if RunDirectory(path).is_saved:
        raise InputError(f"{path} holds a scene, but no recipe.json; expected what `glassplat train --output` wrote")
    if path.name.endswith(".partial") and (path / "settings.json").is_file():
        return preparation_finding
    if (path / SCENE).is_file():
        return scene_finding
    if all(one.suffix.lower() in IMAGE_SUFFIXES for one in path.iterdir()):
        return photographs_finding
    return _capture_or_photographs


def _capture_or_photographs(path: Path) -> Iterator[Finding]:
    try:
        yield from capture_finding(path)
    except UnknownFormatError:
        yield from photographs_finding(path)
