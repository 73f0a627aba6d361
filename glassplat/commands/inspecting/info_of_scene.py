"""What `glassplat info` says of runs, exported scenes and splat files, and of the scenes in them with PyTorch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from glassplat.commands.console.importing import import_held
from glassplat.commands.inspecting.finding import Finding
from glassplat.files.folders import SCENE
from glassplat.train.run_directory import RunDirectory

DETAILS = "glassplat.commands.inspecting.scene_details"


def splat_finding(path: Path) -> Iterator[Finding]:
    """A file of Gaussians.

    Raises:
        InputError: it cannot be read.
    """
    first = Finding("a splat file", {"bytes": path.stat().st_size})
    if (path.parent / SCENE).is_file():
        first.facts["beside it"] = ", ".join(sorted(one.name for one in path.parent.iterdir() if one != path))
    yield first
    yield import_held(DETAILS).splats_part(path)


def run_finding(path: Path) -> Iterator[Finding]:
    """The directory of a training.

    Raises:
        InputError: its records are damaged.
    """
    directory = RunDirectory(path)
    recipe, settings = directory.recipe(), directory.settings()
    finding = Finding(f"a {recipe.method} run")
    finding.facts |= {"capture": settings.data, "iterations": settings.iterations, "downscale": settings.downscale}
    if not os.path.isdir(settings.data):
        finding.problems.append(f"its capture is no longer at {settings.data}; say with --data where it is now")
    yield finding
    yield import_held(DETAILS).trained_part(directory)


def scene_finding(path: Path) -> Iterator[Finding]:
    """A folder that a scene was exported to.

    Raises:
        InputError: it cannot be read.
    """
    yield Finding("an exported scene", {"files": ", ".join(sorted(one.name for one in path.iterdir()))})
    yield import_held(DETAILS).scene_part(path)
