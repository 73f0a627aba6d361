"""What `glassplat info` says of photographs without poses, videos and interrupted preparations: without PyTorch."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from glassplat.commands.inspecting.finding import FEW_VIEWS, KINDS, Finding
from glassplat.data.errors import InputError, first_names
from glassplat.files.images import IMAGE_SUFFIXES
from glassplat.files.json_text import read_json
from glassplat.prepare.photographs import broken_photographs
from glassplat.prepare.video import NoOpenCVError, video_facts


def photographs_finding(path: Path) -> Iterator[Finding]:
    """A folder of photographs without poses.

    Raises:
        InputError: there are none.
    """
    found = sorted(one for one in path.rglob("*") if one.suffix.lower() in IMAGE_SUFFIXES and one.is_file())
    if not found:
        names = first_names(sorted(one.name for one in path.iterdir()), 8) or "nothing"
        raise InputError(f"{path} is nothing that is known; expected {KINDS}; it holds {names}")
    yield Finding("photographs without poses", {"photographs": len(found)})
    finding = Finding()
    if broken := broken_photographs(found):
        finding.problems.append(
            f"{len(broken)} are broken, tiny or of a kind that cannot be read ({first_names(broken)}); replace or "
            "remove them"
        )
    if len(found) - len(broken) < FEW_VIEWS:
        finding.problems.append(f"{len(found) - len(broken)} photographs are few; 30 and more do better")
    finding.next.append(f"glassplat prepare {path} --output CAPTURE    finds out where they were taken")
    yield finding


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
    finding.next.append(f"glassplat prepare {path} --output CAPTURE    takes photographs from it, and places them")
    yield finding


def preparation_finding(path: Path) -> Iterator[Finding]:
    """The folder of a preparation that was interrupted."""
    settings = read_json(path / "settings.json")
    finding = Finding("an interrupted preparation", {"of": settings.get("input")})
    finding.problems.append("it is not finished")
    output = str(path).removesuffix(".partial")
    finding.next.append(f"glassplat prepare {settings.get('input')} --output {output} --resume")
    yield finding
