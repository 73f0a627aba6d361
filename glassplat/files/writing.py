"""Atomic file writing, output folders, and the formats of splats."""

from __future__ import annotations

import errno
import hashlib
import importlib.util
import itertools
import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

from glassplat.errors import InputError

GAUSSFORGE_SUFFIXES = (".sog", ".ksplat")
"""Formats that need an extra to be read and written."""
SPLAT_READERS = {
    "ply": "glassplat.files.ply:read_ply",
    "spz": "glassplat.files.spz:read_spz",
    "glb": "glassplat.files.glb:read_glb",
    "splat": "glassplat.files.scene_folder:read_dot_splat",
    "sog": "glassplat.files.scene_folder:read_with_gaussforge",
    "ksplat": "glassplat.files.scene_folder:read_with_gaussforge",
}
"""Readable formats of Gaussians by suffix: the function `(path) -> Gaussians` of each, imported when needed."""
SPLAT_WRITERS = {
    "ply": "glassplat.files.ply:write_gaussians",
    "spz": "glassplat.files.spz:write_spz",
    "glb": "glassplat.files.glb:write_glb",
    "sog": "glassplat.files.scene_folder:write_with_gaussforge",
    "ksplat": "glassplat.files.scene_folder:write_with_gaussforge",
}
"""Formats of output, all of them readable: the function `(path, gaussians)` of each."""
EXACT_FORMATS = ("ply", "glb")
"""Formats of splats that store channels, and that Gaussians are discs."""
SPLAT_SUFFIXES = tuple(f".{kind}" for kind in SPLAT_READERS)
LOADABLE = f"a run, a folder of an export, or a splat file ({', '.join(SPLAT_SUFFIXES)})"
"""Paths that can be opened as a scene."""
OUTPUT_FORMATS = (*SPLAT_WRITERS, "html")
"""All formats of `export` and `Model.save`; `html` is the page of a whole model."""


def check_scene_name(path: Path) -> None:
    """Refuse the name of a file to be saved in an unknown format; a name without a suffix is a folder's."""
    if (suffix := path.suffix.lower()) and suffix[1:] not in OUTPUT_FORMATS:
        endings = ", ".join(f".{known}" for known in OUTPUT_FORMATS)
        raise InputError(f"{path}: expected a name that ends in {endings}, or a folder's")
    if suffix in GAUSSFORGE_SUFFIXES and importlib.util.find_spec("gaussforge") is None:
        raise InputError(f"{suffix} files need gaussforge; pip install 'glassplat[formats]'")


def import_function(place: str) -> Any:
    """The function at `module:name`."""
    module, _, name = place.partition(":")
    return getattr(importlib.import_module(module), name)


def write_splats(kind: str, path: Path, gaussians: Any, **options: Any) -> None:
    """Write Gaussians in a format of `SPLAT_WRITERS`, with the active SH degree."""
    shown = replace(gaussians, sh=gaussians.sh[:, : (gaussians.active_sh_degree + 1) ** 2])
    import_function(SPLAT_WRITERS[kind])(path, shown, **options)


TEMPORARY_NAME = re.compile(r"\..{0,32}\.[0-9a-f]{12}\.tmp(\..{1,31})?")
"""Name of a temporary file of `atomic_write`."""


@contextmanager
def atomic_write(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path next to `path`; on success it replaces `path` in one step.

    The temporary file has the suffix of `path`, even if that is a link to a file without it, so writers that choose the
    format by suffix work unchanged. If the body raises (a full disk, Ctrl-C), the temporary file is removed and an
    older file at `path` keeps its contents. Missing parent folders are created.

    Example:
        with atomic_write(run / "results.json") as temporary:
            temporary.write_text(json.dumps(results))

    Raises:
        OSError: the target cannot be written; the message names it. Keeps the subclass, such as PermissionError.
    """
    target = Path(os.path.realpath(path))
    # Shortened, because a name of maximum length leaves no room for additions.
    temporary = target.with_name(f".{target.stem[:32]}.{uuid4().hex[:12]}.tmp{Path(path).suffix[:32]}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        _flush_to_disk(temporary)
        os.replace(temporary, target)
    except OSError as error:
        reason = error.strerror or str(error)
        kept = "; the previous contents are unchanged" if os.path.exists(target) else ""
        message = f"could not write {path} ({reason}){kept}"
        raise (OSError(message) if error.errno is None else OSError(error.errno, message)) from error
    finally:
        with suppress(OSError):  # A clean-up error must not hide the one above.
            temporary.unlink()


def write_bytes(path: Path | str, data: bytes) -> None:
    """Write a file atomically."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path | str, text: str) -> None:
    """Write a text file in UTF-8 atomically; line endings are kept on every system."""
    write_bytes(path, text.encode("utf-8"))


def file_digest(path: Path) -> str:
    """SHA-256 of a file's contents; empty if there is no file."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


def remove_unfinished(folder: Path, suffixes: Sequence[str]) -> None:
    """Remove temporary files of killed writers from a folder; no writer of such files may be running there."""
    for path in folder.glob(".*"):
        if TEMPORARY_NAME.fullmatch(path.name) and path.suffix in suffixes:
            with suppress(OSError):
                path.unlink()


def _flush_to_disk(path: Path) -> None:
    """Flush the contents to disk, so that a crash cannot leave an empty file under the new name."""
    descriptor = os.open(path, os.O_RDWR)  # Windows flushes only writable files.
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


SCENE_FILE = "scene.json"
"""The file that marks a folder as an exported scene."""
OBSTRUCTION_ERRNOS = (errno.EEXIST, errno.ENOTDIR, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL)


def check_folder(path: Path) -> None:
    """Check that a folder exists or can be created, without creating it.

    Raises:
        NotADirectoryError: it is a file, or its path contains one.
        PermissionError: the folder is not writable.
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
    """Check that the folder of a capture exists."""
    if os.path.isfile(path):
        scene = ". `glassplat.load` reads splat files" if path.suffix.lower() in SPLAT_SUFFIXES else ""
        raise NotADirectoryError(f"{path} is a file; expected the folder of a capture{scene}")
    if not os.path.isdir(path):
        raise FileNotFoundError(f"no folder {path}; expected the folder of a capture, as `glassplat prepare` makes it")


def make_folder(path: Path) -> None:
    """Create a folder and its missing parents; after a failure, none of them is left.

    Raises:
        NotADirectoryError: a file is in the way, or the name is not allowed.
        PermissionError: the folder is not writable.
        OSError: the disk is full, or fails.
    """
    check_folder(path)
    missing = missing_folders(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        remove_empty(missing)
        if error.errno not in OBSTRUCTION_ERRNOS:
            raise
        raise NotADirectoryError(
            f"cannot create the folder {path} ({error.strerror}); choose another output folder"
        ) from error


def missing_folders(path: Path) -> list[Path]:
    """A folder and its parents, as far as they are missing, the innermost first."""
    return [folder for folder in (path, *path.parents) if not os.path.lexists(folder)]


def remove_empty(folders: Sequence[Path]) -> None:
    """Remove those of the folders that are empty, in order."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def real_path(path: Path) -> Path:
    """Path after following links; circular links are kept, unlike in `Path.resolve`."""
    return Path(os.path.realpath(path))


def check_links(folder: Path, names: Sequence[str]) -> None:
    """Refuse links that lead out of a folder in which files and folders of these names will be written.

    In a folder from another person, such as a run or a capture, links could make any file be overwritten. A link to an
    empty folder, for example on another disk, is allowed.

    Raises:
        InputError: there is such a link; nothing has been written.
    """
    inside = real_path(folder)
    for top in (folder / name for name in names):
        for path in itertools.chain([top], top.rglob("*")):  # A folder is searched after the link to it was checked.
            leads_out = path.is_symlink() and not real_path(path).is_relative_to(inside)
            if leads_out and not (path.is_dir() and not any(path.iterdir())):
                raise InputError(
                    f"{path} is a link that leads out of {folder}, to {real_path(path)}; nothing was written. Put what "
                    "it leads to in its place, or remove it"
                )


def scene_source(path: Path) -> Path:
    """The most exact splat file in a folder of `glassplat export`; any other path unchanged."""
    if (path / "recipe.json").is_file():
        return path
    kinds = dict.fromkeys((*EXACT_FORMATS, *SPLAT_WRITERS))
    return next((file for kind in kinds if (file := path / f"scene.{kind}").is_file()), path)
