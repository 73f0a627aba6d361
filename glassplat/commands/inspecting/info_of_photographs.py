"""What `glassplat info` says of photographs without poses, videos and interrupted preparations: without PyTorch."""

from __future__ import annotations

from pathlib import Path

from glassplat.commands.inspecting.finding import FEW_VIEWS, Finding
from glassplat.data.errors import first_names
from glassplat.files.images import IMAGE_SUFFIXES
from glassplat.files.json_text import read_json
from glassplat.prepare.photographs import broken_photographs


def photographs_finding(path: Path) -> Finding | None:
    """A folder of photographs without poses; None where there are none."""
    found = sorted(one for one in path.rglob("*") if one.suffix.lower() in IMAGE_SUFFIXES and one.is_file())
    if not found:
        return None
    finding = Finding("photographs without poses", {"photographs": len(found)})
    if broken := broken_photographs(found):
        finding.problems.append(
            f"{len(broken)} are broken, tiny or of a kind that cannot be read ({first_names(broken)}); replace or "
            "remove them"
        )
    if len(found) - len(broken) < FEW_VIEWS:
        finding.problems.append(f"{len(found) - len(broken)} photographs are few; 30 and more do better")
    finding.next.append(f"glassplat prepare {path} --output CAPTURE    finds out where they were taken")
    return finding


def video_finding(path: Path) -> Finding:
    """A video."""
    finding = Finding("a video", {"bytes": path.stat().st_size})
    finding.next.append(f"glassplat prepare {path} --output CAPTURE    takes photographs from it, and places them")
    return finding


def preparation_finding(path: Path) -> Finding:
    """The folder of a preparation that was interrupted."""
    settings = read_json(path / "settings.json")
    finding = Finding("an interrupted preparation", {"of": settings.get("input")})
    finding.problems.append("it is not finished")
    output = str(path).removesuffix(".partial")
    finding.next.append(f"glassplat prepare {settings.get('input')} --output {output} --resume")
    return finding
