"""Whether there is a scene where somebody says, before anything is imported that could read it."""

from __future__ import annotations

from pathlib import Path

from glassplat.commands.console.messages import message_console, say
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


def say_scene(path: Path) -> None:
    """Says what the records of a run tell, or how large a file is: the first that is known of a scene.

    Raises:
        InputError: the records are damaged.
    """
    say(message_console(), f"{path}: {_in_words(path)}")


def _in_words(path: Path) -> str:
    if path.is_file():
        return f"a splat file of {path.stat().st_size / 1e6:.1f} MB"
    directory = RunDirectory(path)
    if directory.imported.is_file():
        return "an imported scene"
    recipe, settings = directory.recipe(), directory.settings()
    return f"a {recipe.method} run of {settings.iterations} iterations on {settings.data}"


def check_file(path: Path) -> None:
    """Refuses a file that cannot be read.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it cannot be read.
    """
    with input_checked(), reading(path), path.open("rb"):
        pass
