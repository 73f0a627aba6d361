"""What `glassplat info` says of captures; what their folders hold it says before PyTorch is imported."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from glassplat.commands.console.importing import import_held
from glassplat.commands.inspecting.finding import Finding
from glassplat.data.capture_files import CaptureFiles, read_capture
from glassplat.files.json_text import read_json
from glassplat.prepare.workplace import RECORD


def capture_finding(path: Path) -> Iterator[Finding]:
    """A capture that can be trained.

    Raises:
        UnknownFormatError: it is none.
        InputError: it cannot be read.
    """
    files = read_capture(path)
    yield _first_part(files)
    details = import_held("glassplat.commands.inspecting.capture_details")
    yield from details.remaining_parts(files)


def _first_part(files: CaptureFiles) -> Finding:
    capture = files.capture
    finding = Finding("a capture", {"format": capture.format_name})
    finding.facts["points"] = "none (random ones are used)" if capture.points is None else len(capture.points)
    _prepared(files.root, finding)
    return finding


def _prepared(path: Path, finding: Finding) -> None:
    """What `glassplat prepare` reported, where it made the capture."""
    try:
        report = read_json(path / RECORD)["report"]
        finding.facts["prepared"] = (
            f"{report['registered']} of {report['photographs']} photographs placed, points "
            f"{report['reprojection_error']:.2f} pixels off"
        )
        finding.problems += report["advice"]
    except (OSError, ValueError, KeyError, TypeError):
        return  # Others make captures too.
