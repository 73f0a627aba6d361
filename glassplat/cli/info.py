"""`glassplat info`: description and check of a path, and the next step."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
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
class Report:
    """Kind and state of a path, with suitable commands. Facts are printed as they are found, because checks are slow.

    Attributes:
        path: the examined path.
        console: receives kind and facts; None for JSON.
        kind: short description.
        facts: by name, in order of display.
        problems: obstacles and deficiencies, in full sentences.
        next: commands for the next step, each with its purpose.
    """

    path: Path
    console: Console | None
    kind: str = ""
    facts: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    next: list[str] = field(default_factory=list)

    def begin(self, kind: str, **facts: Any) -> None:
        """Adds the kind and the first facts."""
        self.kind = kind
        if self.console is not None:
            print_line(self.console, f"{self.path}: {kind}")
        for name, fact in facts.items():
            self.add(name, fact)

    def add(self, name: str, fact: Any) -> None:
        """Adds a fact."""
        self.facts[name] = fact
        if self.console is not None:
            print_line(self.console, f"  {name}: {fact}")


Examiner = Callable[[Path, Report], None]
"""Examines a path and adds to its report."""


def examine_capture(path: Path, report: Report) -> None:
    """A capture that can be trained.

    Raises:
        UnknownFormatError: it is not a capture.
        InputError: it cannot be read.
    """
    files = read_capture(path)
    points = files.capture.points
    report.begin("a capture", format=files.capture.format_name)
    report.add("points", "none (random ones are used)" if points is None else len(points))
    _describe_preparation(files.root, report)
    import_uninterrupted(DETAILS_MODULE).describe_capture(files, report)


def _describe_preparation(path: Path, report: Report) -> None:
    """Facts from the report of `glassplat prepare` in the capture."""
    try:
        prepared = read_json(path / RECORD)["report"]
        registered = (
            f"{prepared['registered']} of {prepared['photographs']} photographs registered, "
            f"mean reprojection error {prepared['reprojection_error']:.2f} pixels"
        )
        advice = list(prepared["advice"])
    except (OSError, ValueError, KeyError, TypeError):
        return  # Not all captures are made by `prepare`.
    report.add("prepared", registered)
    report.problems += advice


def is_photograph(path: Path) -> bool:
    """Return whether a name is that of a photograph."""
    return path.suffix.lower() in (*IMAGE_SUFFIXES, *HEIF_SUFFIXES)


def examine_photographs(path: Path, report: Report) -> None:
    """A folder of photographs without poses."""
    below = [one for one in files_below(path) if not is_hidden(one.relative_to(path))]
    found = sorted(one for one in below if is_photograph(one) and one.is_file())
    if not found:
        names = join_names(sorted(one.name for one in path.iterdir()), 8) or "nothing"
        raise InputError(f"{path} is not a known kind of folder; expected {KINDS}; it holds {names}")
    masks = masks_below(path, found)
    found = [one for one in found if one not in masks]
    report.begin("photographs without poses", photographs=len(found))
    if masks:
        report.add("masks", len(masks))
    sound = len(found) - describe_broken(found, report, LEAST_SIDE)
    if sound < FEW_VIEWS:
        report.problems.append(f"only {count_noun(sound, 'photograph')}; 30 or more work better")
    report.next.append(f"glassplat prepare {shell_word(path)} --output CAPTURE    estimates their camera poses")


def describe_broken(photographs: Sequence[Path], report: Report, least_side: int) -> int:
    """Decodes photographs to find broken and small ones; returns their number."""
    if broken := broken_photographs(photographs, least_side):
        report.problems.append(
            f"{len(broken)} are broken, tiny or of a kind that cannot be read ({join_names(broken)}); replace or "
            "remove them"
        )
    return len(broken)


def examine_video(path: Path, report: Report) -> None:
    """A video, or a file with a video's suffix."""
    size = path.stat().st_size
    try:
        facts = video_facts(path)
    except NoOpenCVError as error:
        report.begin("a video, by its name", bytes=size)
        report.problems.append(str(error))
        return
    if facts is None:
        report.begin("a file with a video's suffix", bytes=size)
        report.problems.append(
            "OpenCV cannot read a frame of it; convert it to an MP4, or give a folder of photographs"
        )
        return
    report.begin("a video", bytes=size, **facts)
    report.next.append(
        f"glassplat prepare {shell_word(path)} --output CAPTURE    extracts frames and estimates their camera poses"
    )


def examine_preparation(path: Path, report: Report) -> None:
    """The folder of an interrupted preparation."""
    settings = path / "settings.json"
    with convert_to_input_error():
        given = read_json(settings)
        source = check_fields(given, {"input": Text()}, str(settings))["input"]
    output = str(path).removesuffix(".partial")
    defaults = Preparation(Path(source), Path(output)).record()
    changed = {key: given[key] for key in defaults if given.get(key, defaults[key]) != defaults[key] and key != "input"}
    options = "".join(f" --{name} {shell_word(str(value))}" for name, value in changed.items())
    report.begin("an interrupted preparation", of=source)
    report.problems.append("it is not finished")
    report.next.append(f"glassplat prepare {shell_word(source)} --output {shell_word(output)}{options} --resume")


def examine_splats(path: Path, report: Report) -> None:
    """A file of Gaussians."""
    report.begin("a splat file", bytes=path.stat().st_size)
    if (path.parent / SCENE_FILE).is_file():
        report.add("next to it", ", ".join(sorted(one.name for one in path.parent.iterdir() if one != path)))
    import_uninterrupted(DETAILS_MODULE).describe_splats(path, report)


def examine_run(path: Path, report: Report) -> None:
    """The directory of a training run, or of a scene in that layout."""
    directory = RunDirectory(path)
    if directory.import_record.is_file():
        report.begin("a scene without a capture")
        import_uninterrupted(DETAILS_MODULE).describe_imported(directory, report)
        return
    recipe, settings = directory.recipe(), directory.settings()
    report.begin(
        f"a {recipe.method} run", capture=settings.data, iterations=settings.iterations, downscale=settings.downscale
    )
    if not os.path.isdir(settings.data):
        report.problems.append(f"its capture is no longer at {settings.data}; give its new location with --data")
    import_uninterrupted(DETAILS_MODULE).describe_trained(directory, report)


def examine_runs(path: Path, report: Report) -> None:
    """A folder of training runs, as `glassplat demo` writes it."""
    runs = sorted(recipe.parent for recipe in path.glob("*/recipe.json"))
    report.begin("a folder of runs", runs=", ".join(run.name for run in runs))
    report.next += [f"glassplat info {shell_word(run)}" for run in runs]


def examine_scene(path: Path, report: Report) -> None:
    """A folder with the scene of a run."""
    report.begin("an exported scene", files=", ".join(sorted(one.name for one in path.iterdir())))
    import_uninterrupted(DETAILS_MODULE).describe_folder(path, report)


def examine_export(path: Path, report: Report) -> None:
    """A folder that `glassplat export` wrote."""
    report.begin("an exported scene", files=", ".join(sorted(one.name for one in path.iterdir())))
    import_uninterrupted(DETAILS_MODULE).describe_splats(scene_source(path), report)
    report.next.append(f"glassplat view {shell_word(path)}    shows it in the browser")
    if (path / "index.html").is_file():
        report.next.append(f"open {path / 'index.html'} in a browser, or share it: it needs no server")


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
        examiner_of(self.path)
        if self.page is None:
            return
        if not (self.path / RECORD).is_file():
            raise InputError(f"{self.path} was not made by `glassplat prepare`: there is no {RECORD} to report on")
        if self.page.exists() and self.page.resolve() != (self.path / PAGE).resolve():
            raise InputError(f"{self.page} exists; choose another name for --page")
        check_folder(self.page.parent)

    def run(self, console: Console) -> None:
        """Examines the path, and prints findings as they come."""
        report = Report(self.path, None if self.json else console)
        examiner_of(self.path)(self.path, report)
        if self.page is not None:
            import_uninterrupted(DETAILS_MODULE).write_capture_page(self.path, self.page)
        if self.json:
            found = {"path": str(self.path), "kind": report.kind, "healthy": not report.problems}
            found |= {"facts": report.facts, "problems": report.problems, "next": report.next}
            console.file.write(json.dumps(found, indent=1) + "\n")
            return
        for problem in report.problems:
            print_warning(console, problem)
        for command in report.next:
            print_line(console, f"next: {command}")

    def interrupt_message(self) -> str:
        """Message after an interrupt: nothing has changed."""
        return "nothing was changed"


def examiner_of(path: Path) -> Examiner:
    """Function that examines a path."""
    if not os.path.lexists(path):
        raise FileNotFoundError(f"{path} does not exist; expected {KINDS}")
    return _examiner_of_folder(path) if path.is_dir() else _examiner_of_file(path)


def _examiner_of_file(path: Path) -> Examiner:
    suffix = path.suffix.lower()
    if suffix in SPLAT_SUFFIXES:
        return examine_splats
    if suffix in VIDEO_SUFFIXES:
        return examine_video
    kind = "is one photograph" if is_photograph(path) else "is not a known kind of file"
    folder = f"`glassplat info {shell_word(path.parent)}` says what its folder is"
    raise InputError(f"{path} {kind}; expected {KINDS}. {folder}")


def _examiner_of_folder(path: Path) -> Examiner:
    if (path / "recipe.json").is_file():
        return examine_run
    if RunDirectory(path).is_saved:
        raise InputError(f"{path} holds a scene, but no recipe.json; expected what `glassplat train --output` wrote")
    if path.name.endswith(".partial") and (path / "settings.json").is_file():
        return examine_preparation
    if (path / SCENE_FILE).is_file():
        return examine_scene
    if scene_source(path) != path:
        return examine_export
    if all(map(is_photograph, path.iterdir())):
        return examine_photographs
    return _examine_capture_or_photographs


def _examine_capture_or_photographs(path: Path, report: Report) -> None:
    try:
        examine_capture(path, report)
    except UnknownFormatError:
        holds_runs = any(path.glob("*/recipe.json")) and not any(is_photograph(one) for one in path.iterdir())
        (examine_runs if holds_runs else examine_photographs)(path, report)
