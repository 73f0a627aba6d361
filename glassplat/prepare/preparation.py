"""From photographs or a video to a capture on disk."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from glassplat import __version__
from glassplat.captures.colmap_library import quiet_pycolmap
from glassplat.captures.masks import IGNORE_FOLDER
from glassplat.errors import InputError, convert_to_input_error, join_names
from glassplat.files import writing
from glassplat.files.records import ListOf, Optional, Text, check_fields, read_json, readable_name
from glassplat.prepare.colmap import LensName, Mapper
from glassplat.prepare.photographs import (
    FEWEST_PHOTOGRAPHS,
    PHOTOGRAPH_SUFFIX,
    VIDEO_SUFFIXES,
    Listener,
    extract_frames,
    file_states,
    masks_among,
    photographs_in,
)
from glassplat.prepare.reconstruction import CannotRegisterError, Solution, best_solution, image_numbers, write_capture

log = logging.getLogger(__name__)

RECORD = "prepare.json"
"""Record in the capture: inputs of the preparation, and its report."""
PAGE = "prepare.html"
"""The report in the capture, for people."""
PHOTOGRAPHS_KEY = "photographs"
"""Key of the settings of an interrupted preparation: states of the input files."""
MASKS_KEY = "masks"
"""Key of the record: digests of the masks of regions outside the view of a wide lens."""
WRITTEN_NAMES = ("images", "sparse", RECORD, PAGE)
"""Everything in a capture that `prepare` writes; other files are the user's work."""


@dataclass(frozen=True)
class WorkFolder:
    """The temporary folder in which a capture is made.

    Attributes:
        output: folder of the finished capture; links are resolved.
    """

    output: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "output", writing.real_path(self.output))

    @property
    def folder(self) -> Path:
        """The temporary folder, next to the output, so that the finished capture is moved atomically."""
        return self.output.with_name(f"{self.output.name}.partial")

    @property
    def capture(self) -> Path:
        """The capture while it is written."""
        return self.folder / "capture"

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Locks the output against other preparations on this machine, if it supports locks."""
        user = os.getuid() if hasattr(os, "getuid") else ""
        name = hashlib.sha256(os.fsencode(self.output)).hexdigest()[:16]
        lock = FileLock(Path(tempfile.gettempdir()) / f"glassplat-prepare-{user}-{name}.lock", blocking=False)
        try:
            lock.acquire()
        except Timeout as error:
            raise InputError(
                f"another preparation is writing {self.output}; wait until it has finished, or choose another --output"
            ) from error
        except OSError as error:
            log.debug("%s is not locked: %s", self.output, error)
        try:
            yield
        finally:
            if lock.is_locked:  # Before the release: whoever locks a removed file, tries again.
                with suppress(OSError):
                    os.unlink(lock.lock_file)
            lock.release()

    def begin(self, settings: Mapping[str, Any], *, resume: bool, force: bool) -> bool:
        """Creates the folder, or reuses that of an interrupted preparation; returns true for a new one.

        Args:
            settings: inputs of the work; an interrupted preparation continues only with equal ones.
            resume: continue an interrupted preparation.
            force: start again, and replace a capture that was prepared before.
        """
        self._check_output(force)
        known = self._interrupted_settings()
        if known is not None and force and not resume:
            shutil.rmtree(self.folder)
            known = None
        if known is None:
            writing.make_folder(self.folder)
            writing.write_text(self.folder / "settings.json", json.dumps(settings, indent=1))
            return True
        if not resume:
            raise InputError(
                f"{self.folder} holds an interrupted preparation of {self.output}; continue it with --resume, or "
                "start again with --force"
            )
        self._check_unchanged(known, json.loads(json.dumps(settings)))
        return False

    def finish(self, record: Mapping[str, Any]) -> None:
        """Writes the record into the finished capture and moves it to the output."""
        writing.write_text(self.capture / RECORD, json.dumps(record, indent=1) + "\n")
        if self.output.exists():
            before = self.folder / "before"
            shutil.rmtree(before, ignore_errors=True)
            os.replace(self.output, before)
        os.replace(self.capture, self.output)
        self.discard()

    def discard(self) -> None:
        """Removes the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _check_unchanged(self, known: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
        """Refuse to continue with other settings or photographs."""
        changed = sorted(key for key in {*known, *settings} if known.get(key) != settings.get(key))
        if set(changed) - {PHOTOGRAPHS_KEY}:
            raise InputError(
                f"{self.folder} was started with another "
                f"{join_names([key for key in changed if key != PHOTOGRAPHS_KEY])}; give the same "
                "to --resume, or start again with --force"
            )
        if not changed:
            return
        before, now = known.get(PHOTOGRAPHS_KEY), settings[PHOTOGRAPHS_KEY]
        if not isinstance(before, dict):
            raise InputError(
                f"{self.folder} does not record the photographs it was started with; start again with --force"
            )
        names = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
        raise InputError(
            f"photographs have changed since {self.folder} was started (added, removed or written again: "
            f"{join_names(names)}); put them back to continue with --resume, or start again with --force"
        )

    def _check_output(self, force: bool) -> None:
        writing.check_folder(self.output)
        writing.check_folder(self.folder)
        found = sorted(path.name for path in self.output.iterdir()) if self.output.exists() else []
        if not found:
            return
        if RECORD not in found:
            raise InputError(
                f"{self.output} is not empty, and not from `glassplat prepare` (it holds {join_names(found)}); "
                "nothing was written. Choose a new folder for --output"
            )
        if not force:
            raise InputError(
                f"{self.output} holds a capture that was prepared before; choose a new folder for --output, or replace "
                "it with --force"
            )
        others = [name for name in found if name not in (*WRITTEN_NAMES, IGNORE_FOLDER) and not name.startswith(".")]
        record = self.output / RECORD
        with convert_to_input_error():
            own = check_fields(read_json(record), {MASKS_KEY: Optional(ListOf(Text()), ())}, str(record))[MASKS_KEY]
        others += [
            path.relative_to(self.output).as_posix()
            for path in sorted((self.output / IGNORE_FOLDER).rglob("*"))
            if path.is_file() and writing.file_digest(path) not in own
        ]
        pictures = [path for path in (self.output / "images").rglob("[!.]*") if path.is_file()]
        added = {path for path in pictures if path.suffix != PHOTOGRAPH_SUFFIX} | set(masks_among(pictures))
        others += sorted(path.relative_to(self.output).as_posix() for path in added)
        if others:
            raise InputError(
                f"{self.output} holds {join_names(others)}, which are not from `glassplat prepare` and would "
                "be removed by --force: move the folder away, or choose a new one for --output"
            )

    def _interrupted_settings(self) -> dict[str, Any] | None:
        """Settings of an interrupted preparation, or None."""
        if not self.folder.exists() or not any(self.folder.iterdir()):
            return None
        try:
            content = read_json(self.folder / "settings.json")
        except (OSError, ValueError):
            content = None
        if not isinstance(content, dict):
            raise InputError(
                f"{self.folder} is in the way, and not from `glassplat prepare`; move it, or choose another --output"
            )
        return content


FEW_FEATURES = 500
SHORT_TRACK = 3.0
LARGE_ERROR = 1.5
PLAUSIBLE_FOCALS = (0.4, 3.0)
"""Range of plausible focal lengths, in longer image sides."""


@dataclass(frozen=True)
class Report:
    """Statistics of a preparation.

    Attributes:
        photographs: number of photographs.
        registered: number of photographs with a pose in the largest connected group.
        missing: names of the other files.
        groups: sizes of the separately registered groups; each photograph counts once.
        points: number of triangulated points.
        reprojection_error: mean, in pixels.
        track_length: mean number of photographs per point.
        features: median number per photograph.
        cameras: description of each lens.
        attempt: name of the settings of the best attempt.
        attempts: number of attempts.
        advice: suggestions for improvement.
    """

    photographs: int
    registered: int
    missing: tuple[str, ...]
    groups: tuple[int, ...]
    points: int
    reprojection_error: float
    track_length: float
    features: int
    cameras: tuple[str, ...]
    attempt: str
    attempts: int
    advice: tuple[str, ...]

    @property
    def registered_share(self) -> float:
        """Share of the photographs that were registered."""
        return self.registered / self.photographs

    def lines(self) -> list[str]:
        """Lines of the report for people."""
        missing = f" (not: {join_names(list(self.missing), 8)})" if self.missing else ""
        return [
            f"{self.registered} of {self.photographs} photographs registered{missing}, with {self.attempt}",
            f"{self.points} points, each in {self.track_length:.1f} photographs on average, "
            f"mean reprojection error {self.reprojection_error:.2f} pixels",
            *(f"camera: {camera}" for camera in self.cameras),
            *(f"advice: {line}" for line in self.advice),
        ]


def make_report(solution: Solution) -> Report:
    """The report of a solution; zeros if it has no model."""
    photographs = solution.database.photographs
    model = solution.models[0] if solution.models else None
    used = {image.camera_id for image in image_numbers(model).values()} if model else set()
    report = Report(
        photographs=len(photographs),
        registered=solution.registered,
        missing=tuple(readable_name(one.path.name) for one in solution.missing()),
        groups=_group_sizes(solution),
        points=int(model.num_points3D()) if model else 0,
        reprojection_error=float(model.compute_mean_reprojection_error()) if model else 0.0,
        track_length=float(model.compute_mean_track_length()) if model else 0.0,
        features=int(np.median(solution.database.feature_counts())),
        cameras=tuple(
            f"{camera.width}x{camera.height}, focal length {camera.mean_focal_length():.0f} pixels"
            for key, camera in (sorted(model.cameras.items()) if model else ())
            if key in used
        ),
        attempt=solution.attempt,
        attempts=solution.attempts_made,
        advice=(),
    )
    return replace(report, advice=tuple(_advice(report, model)))


def _group_sizes(solution: Solution) -> tuple[int, ...]:
    """Number of photographs that each model adds to the larger ones, because some may be in several models."""
    known: set[int] = set()
    sizes = []
    for model in solution.models:
        added = set(image_numbers(model)) - known
        known |= added
        if len(added) >= FEWEST_PHOTOGRAPHS:
            sizes.append(len(added))
    return tuple(sizes)


def _advice(report: Report, model: Any) -> Iterator[str]:
    if report.missing:
        yield (
            f"take more photographs around {join_names(list(report.missing), 3)}: in steps of half a metre, with two "
            "thirds overlap, and some that show the surroundings of the glass"
        )
    if len(report.groups) > 1:
        yield (
            f"the photographs fall into {len(report.groups)} groups without matches between them "
            f"({', '.join(map(str, report.groups))} photographs): take some that connect them, or prepare each "
            "group separately"
        )
    if report.features < FEW_FEATURES:
        yield (
            f"photographs have only {report.features} features (median): use more light, a steadier camera, "
            "or a larger --max-size"
        )
    if report.points and report.track_length < SHORT_TRACK:
        yield "points are visible in few photographs: take more, in smaller steps"
    if report.reprojection_error > LARGE_ERROR:
        yield "points have large errors for a static scene: make sure that nothing large moves, or try --lens opencv"
    least, most = PLAUSIBLE_FOCALS
    cameras = model.cameras.values() if model else ()
    if any(not least <= one.mean_focal_length() / max(one.width, one.height) <= most for one in cameras):
        yield "a focal length is implausible: take photographs from different distances"


@dataclass(frozen=True)
class Preparation:
    """Input, output and options of a preparation.

    Attributes:
        source: folder of photographs, or a video.
        output: folder of the capture.
        max_size: maximum longer side in pixels; larger photographs are reduced.
        frames: maximum number of frames extracted from a video.
        least_registered: minimum share of registered photographs.
        lens: COLMAP's camera model.
        mapper: incremental or global structure from motion.
    """

    source: Path
    output: Path
    max_size: int = 1600
    frames: int = 150
    least_registered: float = 0.8
    lens: LensName = "simple_radial"
    mapper: Mapper = "incremental"

    def record(self) -> dict[str, Any]:
        """Inputs of the work; an interrupted preparation continues only with equal ones."""
        source, options = readable_name(writing.real_path(self.source)), {"lens": self.lens, "mapper": self.mapper}
        return {"input": source, "max-size": self.max_size, "frames": self.frames, **options}


def prepare(task: Preparation, listen: Listener, *, resume: bool = False, force: bool = False) -> Report:
    """Makes the capture and returns its report.

    Args:
        task: input, output and options.
        listen: receives the progress.
        resume: continue an interrupted call.
        force: replace a capture that was prepared before, or restart an interrupted preparation.
    """
    check_paths(task)
    quiet_pycolmap()
    work_folder = WorkFolder(task.output)
    with work_folder.lock():
        return _prepare(task, work_folder, listen, resume=resume, force=force)


def _prepare(task: Preparation, work_folder: WorkFolder, listen: Listener, *, resume: bool, force: bool) -> Report:
    settings = {**task.record(), PHOTOGRAPHS_KEY: file_states(task.source)}
    missing = writing.missing_folders(work_folder.folder.parent)
    begun = work_folder.begin(settings, resume=resume, force=force)
    try:
        source = task.source
        if is_video(source):
            source = work_folder.folder / "frames"
            extract_frames(task.source, source, task.frames, listen)
        photographs = photographs_in(source, task.max_size, listen)
        begun = False
        solution = best_solution(
            photographs, work_folder.folder, listen, lens=task.lens, mapper=task.mapper, least=task.least_registered
        )
        report = make_report(solution)
        _check_enough(report, task)
    except InputError as error:
        # Keep the results of an earlier call, because the photographs may only be unavailable at the moment.
        if begun or isinstance(error, CannotRegisterError):
            work_folder.discard()
            writing.remove_empty(missing)
        raise
    write_capture(solution, work_folder.capture, listen)
    masks = sorted({writing.file_digest(path) for path in (work_folder.capture / IGNORE_FOLDER).rglob("*.png")})
    record = {"command": "prepare", "version": __version__, **task.record()}
    work_folder.finish({**record, "report": asdict(report), **({MASKS_KEY: masks} if masks else {})})
    return report


def is_video(source: Path) -> bool:
    """Return whether an input is read as a video."""
    return source.is_file() and source.suffix.lower() in VIDEO_SUFFIXES


def check_paths(task: Preparation) -> None:
    """Refuse an input other than a folder or a video, and an output inside the input."""
    source, output = writing.real_path(task.source), writing.real_path(task.output)
    if source.is_file() and not is_video(source):
        known = ", ".join(VIDEO_SUFFIXES)
        raise InputError(f"{task.source} is a file; expected a folder of photographs, or a video ({known})")
    if output == source or source in output.parents:
        raise InputError(
            f"the output {task.output} is inside the photographs' folder {task.source}; choose a folder next to it"
        )
    if os.path.ismount(output):
        raise InputError(
            f"a disk is mounted at {task.output}, which a finished capture cannot replace; choose a new folder in it"
        )


def _check_enough(report: Report, task: Preparation) -> None:
    """Refuse a capture with too few registered photographs."""
    if report.registered >= FEWEST_PHOTOGRAPHS and report.registered_share >= task.least_registered:
        return
    lines = "\n".join(report.lines())
    kind = InputError if report.registered >= FEWEST_PHOTOGRAPHS else CannotRegisterError
    remedy = (
        "nothing was written"
        if kind is CannotRegisterError
        else f"to accept this, repeat with --resume --least-registered {int(100 * report.registered_share) / 100:g}"
    )
    raise kind(
        f"{report.registered} of {report.photographs} photographs could be registered, expected at least "
        f"{task.least_registered:.0%}\n{lines}\n{remedy}"
    )
