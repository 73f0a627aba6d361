"""Whether there is a scene where somebody says, before anything is imported that could read it."""

from __future__ import annotations

from pathlib import Path

from glassplat.data.errors import input_checked
from glassplat.files.reading import reading
from glassplat.train.run_directory import RunDirectory


def check_scene(path: Path) -> None:
    """Refuses a folder that no run was begun in, and a file that cannot be read.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the folder is no run, or the file cannot be read.
    """
    if path.is_dir() or not (path.is_file() or path.suffix):
        RunDirectory(path).check_begun()
    else:
        check_file(path)


def check_file(path: Path) -> None:
    """Refuses a file that cannot be read.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it cannot be read.
    """
    with input_checked(), reading(path), path.open("rb"):
        pass
