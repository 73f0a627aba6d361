"""What the operating system says about a file that cannot be read, as one kind of error that names the file."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

LARGEST_TEXT = 2**28
"""Bytes of a text file; a list of a hundred thousand photographs with their poses has a quarter of it."""


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turns what opening or reading a file raises into errors that say what is wrong with which file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a folder, a pipe or a device, which may never end, a file without permission, a name that is too
            long, a loop of links, a failing disk.
    """
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise ValueError(f"{path} cannot be read (it is a folder, a pipe or a device); expected a file")
        yield
    except FileNotFoundError as error:
        raise FileNotFoundError(f"no file {path}; expected it there") from error
    except OSError as error:
        reason = error.strerror or str(error)
        raise ValueError(f"{path} cannot be read ({reason}); expected a file that may be read") from error


def read_text(path: Path) -> str:
    """The text of a UTF-8 file, with or without a byte-order mark.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it cannot be read, is no text in UTF-8, or is larger than `LARGEST_TEXT`.
    """
    with reading(path):
        size = os.stat(path).st_size
        if size > LARGEST_TEXT:
            raise ValueError(f"{path} has {size} bytes; expected a text file of at most {LARGEST_TEXT}")
        data = path.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} is no text in UTF-8 ({error.reason} at byte {error.start}); save it as such"
        ) from error
