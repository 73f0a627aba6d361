"""Folders to write into: whether there can be one, and one message where there cannot."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

SCENE = "scene.json"
"""The file by which a folder is known to hold a scene that was exported."""
IN_THE_WAY = (errno.EEXIST, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL)


def check_folder(path: Path) -> None:
    """Look whether a folder is there or can be made, without making it.

    Raises:
        NotADirectoryError: it is a file, or its path goes through one.
        PermissionError: nothing may be written there.
    """
    whole = Path(os.path.abspath(path))
    found = next(folder for folder in (whole, *whole.parents) if os.path.lexists(folder))
    if not found.is_dir():
        kind = "a link that leads nowhere" if found.is_symlink() and not found.exists() else "a file"
        where = "" if found == whole else f", so there can be no folder {path}"
        raise NotADirectoryError(
            f"{found} is {kind}{where}; expected a folder, or a name for a new one, for the output"
        )
    if not os.access(found, os.W_OK | os.X_OK):
        raise PermissionError(f"nothing may be written in {found}; choose another folder for the output, or allow it")


def check_capture_folder(path: Path) -> None:
    """Look whether a folder is there that may be a capture.

    Raises:
        FileNotFoundError: there is none.
    """
    if not os.path.isdir(path):
        raise FileNotFoundError(f"no folder {path}; expected the folder of a capture")


def make_folder(path: Path) -> None:
    """Make a folder, with those above it, where there is none; where that fails, none of them is left.

    Raises:
        NotADirectoryError: something that is no folder is in the way, or it cannot have that name.
        PermissionError: nothing may be written there.
        OSError: the disk is full, or fails.
    """
    check_folder(path)
    missing = missing_folders(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        remove_empty(missing)
        if error.errno not in IN_THE_WAY:
            raise
        raise NotADirectoryError(
            f"there can be no folder {path} ({error.strerror}); choose another folder for the output"
        ) from error


def missing_folders(path: Path) -> list[Path]:
    """A folder and those above it, as far as they are not there, the innermost first."""
    return [folder for folder in (path, *path.parents) if not os.path.lexists(folder)]


def remove_empty(folders: Sequence[Path]) -> None:
    """Removes those folders that hold nothing, the first one first."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def real_path(path: Path) -> Path:
    """Where a path leads through links; one that goes round in circles stays what it is, unlike in `Path.resolve`."""
    return Path(os.path.realpath(path))
