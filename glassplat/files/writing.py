"""Files written completely or not at all, the folders for them, and the formats of splats."""

from __future__ import annotations

import errno
import hashlib
import importlib
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from glassplat.errors import InputError

FORGED_SUFFIXES = (".sog", ".ksplat")
"""Formats that an extra reads and writes."""
SPLAT_SUFFIXES = (".ply", ".spz", ".glb", ".splat", *FORGED_SUFFIXES)
"""Of files of Gaussians that are read."""
LOADED = f"a run, a folder of an export, or a splat file ({', '.join(SPLAT_SUFFIXES)})"
"""What can be opened as a scene."""
SPLAT_WRITERS = {
    "ply": "glassplat.files.ply:write_gaussians",
    "spz": "glassplat.files.spz:write_spz",
    "glb": "glassplat.files.glb:write_glb",
    "sog": "glassplat.files.scene_folder:write_forged",
    "ksplat": "glassplat.files.scene_folder:write_forged",
}
"""Formats that Gaussians are written in, by suffix: the function `(path, gaussians)` of each, imported when needed."""
WRITTEN = (*SPLAT_WRITERS, "html")
"""All formats of `export` and `Model.save`; the page is written of a whole model."""


def write_splats(kind: str, path: Path, gaussians: Any, **options: Any) -> None:
    """Writes Gaussians in a format of `SPLAT_WRITERS`, with the harmonics that are active."""
    module, _, name = SPLAT_WRITERS[kind].partition(":")
    shown = replace(gaussians, sh=gaussians.sh[:, : (gaussians.active_sh_degree + 1) ** 2])
    getattr(importlib.import_module(module), name)(path, shown, **options)


UNFINISHED = re.compile(r"\..{0,32}\.[0-9a-f]{12}\.tmp(\..{1,31})?")
"""Name of a file that `atomic_write` has not put in its place yet."""


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path next to `path`; on success it replaces `path` in one step.

    The temporary file has the suffix of `path`, which may be a link to a file without it, so writers that pick a format
    by suffix work unchanged. When the body raises (a
    full disk, Ctrl-C), the temporary file is removed and an older file at `path` keeps its contents. Missing parent
    folders are created.

    Example:
        with atomic_write(run / "results.json") as temporary:
            temporary.write_text(json.dumps(results))

    Raises:
        OSError: the target cannot be written; the message names it. Keeps the subclass, such as PermissionError.
    """
    target = Path(os.path.realpath(path))
    # Shortened, because a name that is as long as names may be leaves no room for more.
    temporary = target.with_name(f".{target.stem[:32]}.{uuid4().hex[:12]}.tmp{Path(path).suffix[:32]}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush_to_disk(temporary)
        os.replace(temporary, target)
    except OSError as error:
        reason = error.strerror or str(error)
        message = f"could not write {path} ({reason}); the previous contents are unchanged"
        raise (OSError(message) if error.errno is None else OSError(error.errno, message)) from error
    finally:
        with suppress(OSError):  # never hide the error above behind one from the clean-up
            temporary.unlink()


def write_bytes(path: Path | str, data: bytes) -> None:
    """Writes a file atomically."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path | str, text: str) -> None:
    """Writes a text file in UTF-8 atomically; lines end as in the text, on every system."""
    write_bytes(path, text.encode("utf-8"))


def file_digest(path: Path) -> str:
    """Digest of a file's contents; empty where there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def remove_unfinished(folder: Path, suffixes: Sequence[str]) -> None:
    """Removes what was left in a folder by writers that were killed; nobody may be writing such files there now."""
    for path in folder.glob(".*"):
        if UNFINISHED.fullmatch(path.name) and path.suffix in suffixes:
            with suppress(OSError):
                path.unlink()


def _flush_to_disk(path: Path) -> None:
    """Force the contents out, so that a crash cannot leave the new name on an empty file."""
    descriptor = os.open(path, os.O_RDWR)  # Windows flushes only what may be written.
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


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
        kind = "a broken link" if found.is_symlink() and not found.exists() else "a file"
        where = "" if found == whole else f", so {path} cannot be created"
        raise NotADirectoryError(f"{found} is {kind}{where}; expected an existing or new folder for the output")
    if not os.access(found, os.W_OK | os.X_OK):
        raise PermissionError(
            f"no permission to write to {found}; choose another output folder, or change its permissions"
        )


def check_capture_folder(path: Path) -> None:
    """Look whether a folder is there that may be a capture."""
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
            f"cannot create the folder {path} ({error.strerror}); choose another output folder"
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
    """Path after following links; one that goes round in circles stays as it is, unlike in `Path.resolve`."""
    return Path(os.path.realpath(path))


def check_links(folder: Path, names: Sequence[str]) -> None:
    """Refuses links that lead out of a folder where files and folders of these names are to be written.

    Who has filled the folder, as with a run or a capture of somebody else, could have any file replaced by them.

    Raises:
        InputError: names the link; nothing has been written.
    """
    inside = real_path(folder)
    for path in (path for name in names for path in (folder / name, *(folder / name).rglob("*"))):
        if path.is_symlink() and not real_path(path).is_relative_to(inside):
            raise InputError(
                f"{path} is a link that leads out of {folder}, to {real_path(path)}; nothing was written. Put what it "
                "leads to in its place, or remove it"
            )


def scene_source(path: Path) -> Path:
    """The splats in a folder that `glassplat export` wrote, the most exact of its files; any other path as it is."""
    if (path / "recipe.json").is_file():
        return path
    kinds = dict.fromkeys(("ply", "glb", *SPLAT_WRITERS))
    return next((file for kind in kinds if (file := path / f"scene.{kind}").is_file()), path)
