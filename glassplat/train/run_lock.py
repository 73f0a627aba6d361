"""One training at a time in a run's folder."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from glassplat.data.errors import InputError

log = logging.getLogger("glassplat.train")

NAME = "train.lock"
"""The file stays behind, empty; the lock on it ends with the process, however that ends."""


@contextmanager
def run_lock(folder: Path) -> Iterator[None]:
    """Holds the folder against other trainings; a file system that knows no locks is used without one.

    Raises:
        InputError: another training writes into it.
    """
    descriptor = os.open(folder / NAME, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        _lock(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def check_unlocked(folder: Path) -> None:
    """Look whether another training writes into a folder.

    Raises:
        InputError: one does.
    """
    if (folder / NAME).is_file():
        with run_lock(folder):
            pass


def _lock(descriptor: int, folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # Windows, where nothing holds a second training off.
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise InputError(
            f"another training is writing into {folder}; expected a folder for each. Wait until it has ended, or "
            "choose another --output"
        ) from error
    except OSError as error:
        log.warning("%s cannot be locked (%s); see that no second training writes into it", folder, error.strerror)
