"""`glassplat info`: what a path holds, whether it is healthy, and what to do next."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from glassplat.captures.files import CaptureFiles, read_capture
from glassplat.cli.console import count_noun, import_held, say, shell_word, warn
from glassplat.errors import InputError, UnknownFormatError, first_names, input_checked
from glassplat.files.images import HEIF_SUFFIXES, IMAGE_SUFFIXES, files_below, is_hidden
from glassplat.files.records import Text, check_fields, read_json
from glassplat.files.writing import SCENE, SPLAT_SUFFIXES, check_folder, scene_source
from glassplat.model.run_directory import RunDirectory
from glassplat.prepare.photographs import (
    LEAST_SIDE,
    VIDEO_SUFFIXES,
    NoOpenCVError,
    broken_photographs,
    masks_below,
    video_facts,
)
from glassplat.prepare.preparation import PAGE, RECORD, Preparation

KINDS = f"a capture, photographs, a video, a run, an exported scene, or a splat file ({', '.join(SPLAT_SUFFIXES)})"
"""What there is to be found."""
FEW_VIEWS = 20
"""Photographs, below which more are advised."""
DETAILS = "glassplat.cli.details"
"""Imported when something is read that takes PyTorch."""


@dataclass
class Finding:
    """Kind and state of something, with the commands that fit it.

    What takes long to find out comes in parts: finders yield them, and each adds to those before.

    Attributes:
        kind: what it is, in a few words; the first part says it.
        facts: by name, in the order in which they are told.
        problems: what keeps it from being used, or makes it worse, full sentences.
        next: commands that go on from here, each with what it does.
    """

    kind: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    next: list[str] = field(default_factory=list)

    def add(self, part: Finding) -> None:
        """Takes what was found next."""
        self.kind = self.kind or part.kind
        self.facts |= part.facts
        self.problems += part.problems
        self.next += part.next

    def as_json(self) -> dict[str, Any]:
        """For programs."""
        return {
            "kind": self.kind,
            "healthy": not self.problems,
            "facts": self.facts,
            "problems": self.problems,
            "next": self.next,
        }


Finder = Callable[[Path], Iterator[Finding]]
"""Finds out what a path holds, part by part."""


def capture_finding(path: Path) -> Iterator[Finding]:
    """A capture that can be trained.

    Raises:
        UnknownFormatError: it is none.
        InputError: it cannot be read.
    """
    files = read_capture(path)
    yield _first_part(files)
    yield from import_held(DETAILS).remaining_parts(files)


def _first_part(files: CaptureFiles) -> Finding:
    capture = files.capture
    finding = Finding("a capture", {"format": capture.format_name})
    finding.facts["points"] = "none (random ones are used)" if capture.points is None else len(capture.points)
    _describe_preparation(files.root, finding)
    return finding


def _describe_preparation(path: Path, finding: Finding) -> None:
    """Report of `glassplat prepare` in the capture."""
    try:
        report = read_json(path / RECORD)["report"]
        finding.facts["prepared"] = (
            f"{report['registered']} of {report['photographs']} photographs registered, points "
            f"{report['reprojection_error']:.2f} pixels off"
        )
        finding.problems += report["advice"]
    except (OSError, ValueError, KeyError, TypeError):
        return  # Others make captures too.


def is_photograph(path: Path) -> bool:
    """Return whether a name is that of a photograph."""
    return path.suffix.lower() in (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)


def photographs_finding(path: Path) -> Iterator[Finding]:
    """A folder of photographs without poses."""
    below = [one for one in files_below(path) if not is_hidden(one.relative_to(path))]
    found = sorted(one for one in below if is_photograph(one) and one.is_file())
    if not found:
        names = first_names(sorted(one.name for one in path.iterdir()), 8) or "nothing"
        raise InputError(f"{path} is nothing that is known; expected {KINDS}; it holds {names}")
    masks = masks_below(path, found)
    found = [one for one in found if one not in masks]
    yield Finding("photographs without poses", {"photographs": len(found), **({"masks": len(masks)} if masks else {})})
    finding = Finding()
    sound = len(found) - describe_broken(found, finding, LEAST_SIDE)
    if sound < FEW_VIEWS:
        finding.problems.append(f"only {count_noun(sound, 'photograph')}; 30 and more do better")
    finding.next.append(f"glassplat prepare {shell_word(path)} --output CAPTURE    finds out where they were taken")
    yield finding


def describe_broken(photographs: Sequence[Path], finding: Finding, least_side: int) -> int:
    """Finds photographs that are broken, or have fewer pixels a side, and decodes each. Returns how many there are."""
    if broken := broken_photographs(photographs, least_side):
        finding.problems.append(
            f"{len(broken)} are broken, tiny or of a kind that cannot be read ({first_names(broken)}); replace or "
            "remove them"
        )
    return len(broken)


def video_finding(path: Path) -> Iterator[Finding]:
    """A video, or what only has the name of one."""
    size = path.stat().st_size
    try:
        footage = video_facts(path)
    except NoOpenCVError as error:
        yield Finding("a video, by its name", {"bytes": size}, [str(error)])
        return
    if footage is None:
        problem = "OpenCV can read no picture of it; convert it to an MP4, or give a folder of photographs"
        yield Finding("a file that has the name of a video", {"bytes": size}, [problem])
        return
    finding = Finding(
        "a video", {"bytes": size, "frames": footage.frames, "pictures": f"{footage.width}x{footage.height}"}
    )
    finding.next.append(
        f"glassplat prepare {shell_word(path)} --output CAPTURE    takes photographs from it, and places them"
    )
    yield finding


def preparation_finding(path: Path) -> Iterator[Finding]:
    """The folder of a preparation that was interrupted."""
    settings = path / "settings.json"
    with input_checked():
        given = read_json(settings)
        source = check_fields(given, {"input": Text()}, str(settings))["input"]
    output = str(path).removesuffix(".partial")
    usual = Preparation(Path(source), Path(output)).record()
    others = {name: given[name] for name in usual if given.get(name, usual[name]) != usual[name] and name != "input"}
    options = "".join(f" --{name} {shell_word(str(value))}" for name, value in others.items())
    finding = Finding("an interrupted preparation", {"of": source})
    finding.problems.append("it is not finished")
    finding.next.append(f"glassplat prepare {shell_word(source)} --output {shell_word(output)}{options} --resume")
    yield finding


def splat_finding(path: Path) -> Iterator[Finding]:
    """A file of Gaussians."""
    first = Finding("a splat file", {"bytes": path.stat().st_size})
    if (path.parent / SCENE).is_file():
        first.facts["next to it"] = ", ".join(sorted(one.name for one in path.parent.iterdir() if one != path))
    yield first
    yield import_held(DETAILS).splats_part(path)


def run_finding(path: Path) -> Iterator[Finding]:
    """The directory of a training, or of a scene that was written like one."""
    directory = RunDirectory(path)
    if directory.imported.is_file():
        yield Finding("a scene without a capture")
        yield import_held(DETAILS).imported_part(directory)
        return
    recipe, settings = directory.recipe(), directory.settings()
    finding = Finding(f"a {recipe.method} run")
    finding.facts |= {"capture": settings.data, "iterations": settings.iterations, "downscale": settings.downscale}
    if not os.path.isdir(settings.data):
        finding.problems.append(f"its capture is no longer at {settings.data}; say with --data where it is now")
    yield finding
    yield import_held(DETAILS).trained_part(directory)


def runs_finding(path: Path) -> Iterator[Finding]:
    """A folder with the directories of trainings in it, as `glassplat demo` writes it."""
    runs = sorted(recipe.parent for recipe in path.glob("*/recipe.json"))
    commands = [f"glassplat info {shell_word(run)}" for run in runs]
    yield Finding("a folder of runs", {"runs": ", ".join(run.name for run in runs)}, next=commands)


def scene_finding(path: Path) -> Iterator[Finding]:
    """A folder that a scene was exported to."""
    yield Finding("an exported scene", {"files": ", ".join(sorted(one.name for one in path.iterdir()))})
    yield import_held(DETAILS).scene_part(path)


def export_finding(path: Path) -> Iterator[Finding]:
    """A folder that `glassplat export` wrote."""
    yield Finding("an exported scene", {"files": ", ".join(sorted(one.name for one in path.iterdir()))})
    yield import_held(DETAILS).splats_part(scene_source(path))
    opened = [f"glassplat view {shell_word(path)}    shows it in the browser"]
    if (path / "index.html").is_file():
        opened.append(f"open {path / 'index.html'} in a browser, or share it: it needs no server")
    yield Finding(next=opened)


@dataclass(frozen=True)
class Info:
    """Say what a folder or file is, whether it is healthy, and what to do next.

    Attributes:
        path: anything that glassplat reads or writes.
        json: print it for programs.
        page: write the report of `prepare` again, now with the panes and the points behind them, as this HTML file.
    """

    path: tyro.conf.Positional[Path]
    json: bool = False
    page: Path | None = None

    def ready(self) -> None:
        """Refuses what is not known, and a page of what has no report or in the place of something else."""
        finder_of(self.path)
        if self.page is None:
            return
        if not (self.path / RECORD).is_file():
            raise InputError(f"{self.path} was not made by `glassplat prepare`: there is no {RECORD} to report on")
        if self.page.exists() and self.page.resolve() != (self.path / PAGE).resolve():
            raise InputError(f"{self.page} exists; choose another name for --page")
        check_folder(self.page.parent)

    def run(self, console: Console) -> None:
        """Looks, and tells what is found as soon as it is."""
        whole = Finding()
        for part in finder_of(self.path)(self.path):
            if not self.json:
                self._tell_facts(part, console)
            whole.add(part)
        if self.page is not None:
            import_held(DETAILS).write_capture_page(self.path, self.page)
        if self.json:
            console.file.write(json.dumps({"path": str(self.path), **whole.as_json()}, indent=1) + "\n")
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
        """Text after an interrupt: nothing has changed."""
        return "nothing was changed"


def finder_of(path: Path) -> Finder:
    """Function that examines a path."""
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
    if scene_source(path) != path:
        return export_finding
    if all(map(is_photograph, path.iterdir())):
        return photographs_finding
    return _capture_or_photographs


def _capture_or_photographs(path: Path) -> Iterator[Finding]:
    try:
        yield from capture_finding(path)
    except UnknownFormatError:
        holds_runs = any(path.glob("*/recipe.json")) and not any(is_photograph(one) for one in path.iterdir())
        yield from (runs_finding if holds_runs else photographs_finding)(path)
