"""Folders of pictures: which file holds which view, and whose the folder is."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from glassplat.data.errors import InputError, first_names
from glassplat.files.json_text import read_json
from glassplat.train.run_directory import write_text

RECORD = "glassplat.json"
"""Marks a folder as written by one of the commands."""


def claim_folder(folder: Path, command: str, run: Path) -> bool:
    """Makes a folder for a command's pictures and records whose it is; returns whether pictures in it are replaced.

    Raises:
        InputError: the folder holds something else, which must not be overwritten.
    """
    record = folder / RECORD
    found = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    if found and _recorded_command(record) != command:
        raise InputError(
            f"{folder} is not empty, and not from `glassplat {command}` (it holds {first_names(found)}); nothing was "
            "written. Choose a new folder for --output"
        )
    write_text(record, json.dumps({"command": command, "run": str(run)}))
    return bool(found)


def picture_paths(names: Sequence[str]) -> dict[str, Path]:
    """The PNG of each view, relative to the folder: the photograph's name, also distinct for `a.jpg` and `a.png`."""
    plain = {name: PurePosixPath(name).with_suffix(".png") for name in names}
    times = Counter(plain.values())
    return {name: Path(path if times[path] == 1 else f"{name}.png") for name, path in plain.items()}


def _recorded_command(record: Path) -> str | None:
    """Who wrote the folder; None where nobody says."""
    try:
        content = read_json(record)
    except (FileNotFoundError, ValueError):
        return None
    return content.get("command") if isinstance(content, dict) else None
