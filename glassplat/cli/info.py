"""`glassplat info`: description and check of a path, and the next step."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console

from glassplat.captures.files import read_capture
from glassplat.cli.console import import_uninterrupted, print_line, print_warning, shell_word
from glassplat.errors import InputError, UnknownFormatError, convert_to_input_error, count_noun, join_names
from glassplat.files.images import HEIF_SUFFIXES, IMAGE_SUFFIXES, files_below, is_hidden
from glassplat.files.records import Text, check_fields, read_json
from glassplat.files.writing import SCENE_FILE, SPLAT_SUFFIXES, check_folder, scene_source
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
"""Kinds of paths."""
FEW_VIEWS = 20
"""Recommended minimum number of photographs."""
DETAILS_MODULE = "glassplat.cli.details"
"""Imported only for paths that need PyTorch."""


@dataclass
class Finding:
    """Kind and state of a path, with suitable commands.

    Slow checks are reported in parts: finders yield them, and each adds to the previous ones.

    Attributes:
        kind: short description, in the first part.
        facts: by name, in order of display.
        problems: obstacles and deficiencies, in full sentences.
        next: commands for the next step, each with its purpose.
    """

    kind: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    next: list[str] = field(default_factory=list)

    def add(self, part: Finding) -> None:
        """Adds the next part."""
        self.kind = self.kind or part.kind
        self.facts |= part.facts
        self.problems += part.problems
        self.next += part.next


Finder = Callable[[Path], Iterator[Finding]]
"""Examines a path, and yields findings part by part."""


def capture_finding(path: Path) -> Iterator[Finding]:
    """A capture that can be trained.

    Raises:
        UnknownFormatError: it is not a capture.
        InputError: it cannot be read.
    """
    files = read_capture(path)
    capture, points = files.capture, files.capture.points
    finding = Finding("a capture", {"format": capture.format_name})
    finding.facts["points"] = "none (random ones are used)" if points is None else len(points)
    _describe_preparation(files.root, finding)
    yield finding
    yield from import_uninterrupted(DETAILS_MODULE).remaining_parts(files)


def _describe_preparation(path: Path, finding: Finding) -> None:
    """Facts from the report of `glassplat prepare` in the capture."""
    try:
        report = read_json(path / RECORD)["report"]
        finding.facts["prepared"] = (
            f"{report['registered']} of {report['photographs']} photographs registered, "
            f"mean reprojection error {report['reprojection_error']:.2f} pixels"
        )
        finding.problems += report["advice"]
    except (OSError, ValueError, KeyError, TypeError):
        return  # Not all captures are made by `prepare`.


def is_photograph(path: Path) -> bool:
    """Return whether a name is that of a photograph."""
    return path.suffix.lower() in (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)


def photographs_finding(path: Path) -> Iterator[Finding]:
    """A folder of photographs without poses."""
    below = [one for one in files_below(path) if not is_hidden(one.relative_to(path))]
    found = sorted(one for one in below if is_photograph(one) and one.is_file())
    if not found:
        names = join_names(sorted(one.name for one in path.iterdir()), 8) or "nothing"
        raise InputError(f"{path} is not a known kind of folder; expected {KINDS}; it holds {names}")
    masks = masks_below(path, found)
    found = [one for one in found if one not in masks]
    yield Finding("photographs without poses", {"photographs": len(found), **({"masks": len(masks)} if masks else {})})
    finding = Finding()
    sound = len(found) - describe_broken(found, finding, LEAST_SIDE)
    if sound < FEW_VIEWS:
        finding.problems.append(f"only {count_noun(sound, 'photograph')}; 30 or more work better")
    finding.next.append(f"glassplat prepare {shell_word(path)} --output CAPTURE    estimates their camera poses")
    yield finding


def describe_broken(photographs: Sequence[Path], finding: Finding, least_side: int) -> int:
    """Decodes photographs to find broken and small ones; returns their number."""
    if broken := broken_photographs(photographs, least_side):
        finding.problems.append(
            f"{len(broken)} are broken, tiny or of a kind that cannot be read ({join_names(broken)}); replace or "
            "remove them"
        )
    return len(broken)


def video_finding(path: Path) -> Iterator[Finding]:
    """A video, or a file with a video's suffix."""
    size = path.stat().st_size
    try:
        facts = video_facts(path)
    except NoOpenCVError as error:
        yield Finding("a video, by its name", {"bytes": size}, [str(error)])
        return
    if facts is None:
        problem = "OpenCV cannot read a frame of it; convert it to an MP4, or give a folder of photographs"
        yield Finding("a file with a video's suffix", {"bytes": size}, [problem])
        return
    finding = Finding("a video", {"bytes": size, **facts})
    finding.next.append(
        f"glassplat prepare {shell_word(path)} --output CAPTURE    extracts frames and estimates their camera poses"
    )
    yield finding


def preparation_finding(path: Path) -> Iterator[Finding]:
    """The folder of an interrupted preparation."""
    settings = path / "settings.json"
    with convert_to_input_error():
        given = read_json(settings)
        source = check_fields(given, {"input": Text()}, str(settings))["input"]
    output = str(path).removesuffix(".partial")
    defaults = Preparation(Path(source), Path(output)).record()
    changed = {key: given[key] for key in defaults if given.get(key, defaults[key]) != defaults[key] and key != "input"}
    options = "".join(f" --{name} {shell_word(str(value))}" for name, value in changed.items())
    finding = Finding("an interrupted preparation", {"of": source})
    finding.problems.append("it is not finished")
    finding.next.append(f"glassplat prepare {shell_word(source)} --output {shell_word(output)}{options} --resume")
    yield finding


def splat_finding(path: Path) -> Iterator[Finding]:
    """A file of Gaussians."""
    first = Finding("a splat file", {"bytes": path.stat().st_size})
    if (path.parent / SCENE_FILE).is_file():
        first.facts["next to it"] = ", ".join(sorted(one.name for one in path.parent.iterdir() if one != path))
    yield first
    yield import_uninterrupted(DETAILS_MODULE).splats_part(path)


def run_finding(path: Path) -> Iterator[Finding]:
    """The directory of a training run, or of a scene in that layout."""
    directory = RunDirectory(path)
    if directory.import_record.is_file():
        yield Finding("a scene without a capture")
        yield import_uninterrupted(DETAILS_MODULE).imported_part(directory)
        return
    recipe, settings = directory.recipe(), directory.settings()
    finding = Finding(f"a {recipe.method} run")
    finding.facts |= {"capture": settings.data, "iterations": settings.iterations, "downscale": settings.downscale}
    if not os.path.isdir(settings.data):
        finding.problems.append(f"its capture is no longer at {settings.data}; give its new location with --data")
    yield finding
    yield import_uninterrupted(DETAILS_MODULE).trained_part(directory)


def runs_finding(path: Path) -> Iterator[Finding]:
    """A folder of training runs, as `glassplat demo` writes it."""
    runs = sorted(recipe.parent for recipe in path.glob("*/recipe.json"))
    commands = [f"glassplat info {shell_word(run)}" for run in runs]
    yield Finding("a folder of runs", {"runs": ", ".join(run.name for run in runs)}, next=commands)


def scene_finding(path: Path) -> Iterator[Finding]:
    """A folder that a scene was exported to."""
    yield Finding("an exported scene", {"files": ", ".join(sorted(one.name for one in path.iterdir()))})
    yield import_uninterrupted(DETAILS_MODULE).scene_part(path)


def export_finding(path: Path) -> Iterator[Finding]:
    """A folder that `glassplat export` wrote."""
    yield Finding("an exported scene", {"files": ", ".join(sorted(one.name for one in path.iterdir()))})
    yield import_uninterrupted(DETAILS_MODULE).splats_part(scene_source(path))
    opened = [f"glassplat view {shell_word(path)}    shows it in the browser"]
    if (path / "index.html").is_file():
        opened.append(f"open {path / 'index.html'} in a browser, or share it: it needs no server")
    yield Finding(next=opened)


@dataclass(frozen=True)
class Info:
    """Describe a folder or file, check it, and suggest the next step.

    Attributes:
        path: any folder or file that glassplat reads or writes.
        json: print JSON.
        page: HTML file for the report of `prepare`, updated with the panes and the points behind them.
    """

    path: tyro.conf.Positional[Path]
    json: bool = False
    page: Path | None = None

    def set_up(self) -> None:
        """Checks that the path is known, and that its report can be written."""
        finder_of(self.path)
        if self.page is None:
            return
        if not (self.path / RECORD).is_file():
            raise InputError(f"{self.path} was not made by `glassplat prepare`: there is no {RECORD} to report on")
        if self.page.exists() and self.page.resolve() != (self.path / PAGE).resolve():
            raise InputError(f"{self.page} exists; choose another name for --page")
        check_folder(self.page.parent)

    def run(self, console: Console) -> None:
        """Examines the path, and prints findings as they come."""
        whole = Finding()
        for part in finder_of(self.path)(self.path):
            if not self.json:
                self._print_facts(part, console)
            whole.add(part)
        if self.page is not None:
            import_uninterrupted(DETAILS_MODULE).write_capture_page(self.path, self.page)
        if self.json:
            healthy = not whole.problems
            found = {"path": str(self.path), "kind": whole.kind, "healthy": healthy, **vars(whole)}
            console.file.write(json.dumps(found, indent=1) + "\n")
            return
        for problem in whole.problems:
            print_warning(console, problem)
        for command in whole.next:
            print_line(console, f"next: {command}")

    def _print_facts(self, part: Finding, console: Console) -> None:
        if part.kind:
            print_line(console, f"{self.path}: {part.kind}")
        for name, fact in part.facts.items():
            print_line(console, f"  {name}: {fact}")

    def interrupt_message(self) -> str:
        """Message after an interrupt: nothing has changed."""
        return "nothing was changed"


def finder_of(path: Path) -> Finder:
    """Function that examines a path."""
    if not os.path.lexists(path):
        raise FileNotFoundError(f"{path} does not exist; expected {KINDS}")
    return _finder_of_folder(path) if path.is_dir() else _finder_of_file(path)


def _finder_of_file(path: Path) -> Finder:
    suffix = path.suffix.lower()
    if suffix in SPLAT_SUFFIXES:
        return splat_finding
    if suffix in VIDEO_SUFFIXES:
        return video_finding
    raise InputError(f"{path} is not a known kind of file; expected {KINDS}")


def _finder_of_folder(path: Path) -> Finder:
    if (path / "recipe.json").is_file():
        return run_finding
    if RunDirectory(path).is_saved:
        raise InputError(f"{path} holds a scene, but no recipe.json; expected what `glassplat train --output` wrote")
    if path.name.endswith(".partial") and (path / "settings.json").is_file():
        return preparation_finding
    if (path / SCENE_FILE).is_file():
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
