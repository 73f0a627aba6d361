"""Folders of pictures: whose one is, and what may be written into it."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

from glassplat.data.errors import InputError, first_names
from glassplat.files.folders import check_folder, make_folder, real_path
from glassplat.files.json_text import read_json
from glassplat.train.run_directory import write_text

RECORD = "glassplat.json"
"""Marks a folder as written by one of the commands."""


def claim_folder(folder: Path, command: str, run: Path) -> bool:
    """Makes a folder for a command's pictures and records whose it is; returns whether pictures in it are replaced.

    Raises:
        InputError: the folder holds something else, which must not be overwritten.
        NotADirectoryError: it is a file, or goes through one.
    """
    found = check_claim(folder, command)
    make_folder(folder)
    write_text(folder / RECORD, json.dumps({"command": command, "run": str(run)}))
    return found


def check_claim(folder: Path, command: str) -> bool:
    """Look whether a command may write into a folder; returns whether it has done so before.

    Raises:
        InputError, NotADirectoryError: as `claim_folder` does; nothing is written.
        PermissionError: nothing may be written there.
    """
    check_folder(folder)
    found = sorted(path.name for path in folder.iterdir()) if folder.exists() else []
    if found and _recorded_command(folder / RECORD) != command:
        raise InputError(
            f"{folder} is not empty, and not from `glassplat {command}` (it holds {first_names(found)}); nothing was "
            "written. Choose a new folder for --output"
        )
    return bool(found)


def check_targets(folder: Path, targets: Sequence[Path], photographs: Sequence[Path]) -> None:
    """Refuse to write where a link leads, in a folder that is written again, out of it or to a photograph.

    Args:
        folder: what the pictures are written into.
        targets: the files to write, in it, and folders that they go into.
        photographs: what must stay whatever happens.

    Raises:
        InputError: names the file and where it leads, or what is in its place; nothing has been written.
    """
    inside, kept = real_path(folder), {real_path(path) for path in photographs}
    for target in (folder / RECORD, *targets):
        real = real_path(target)
        if real in kept or not real.is_relative_to(inside):
            what = "is a photograph of the capture" if real in kept else f"leads out of {folder}, to {real}"
            raise InputError(f"{target} {what}; nothing was written. Choose a new folder for --output")
        if os.path.lexists(real) and not (os.path.isfile(real) or os.path.isdir(real)):
            raise InputError(
                f"{target} is a pipe, a device or a link to nothing; nothing was written. Choose a new folder for "
                "--output"
            )


def _recorded_command(record: Path) -> str | None:
    """Who wrote the folder; None where nobody says."""
    try:
        content = read_json(record)
    except (OSError, ValueError):
        return None
    return content.get("command") if isinstance(content, dict) else None
