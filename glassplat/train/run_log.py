"""The log of a run: one line of JSON per message."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from glassplat.files.atomic import atomic_write
from glassplat.train.messages import Message, StepDone, Working

LOG_EVERY = 10


class RunLog:
    """Appends messages to an open log."""

    def __init__(self, file: TextIO, path: Path) -> None:
        self._file, self._path = file, path

    def write(self, message: Message) -> None:
        """Appends a message; of the steps, every tenth, and nothing of what happens between two of them.

        Raises:
            OSError: the disk is full or fails; names the log.
        """
        if isinstance(message, Working) or (isinstance(message, StepDone) and message.step % LOG_EVERY):
            return
        try:
            self._file.write(json.dumps({"message": type(message).__name__, **vars(message)}) + "\n")
            self._file.flush()
        except OSError as error:
            raise OSError(error.errno, f"could not write {self._path} ({error.strerror})") from error


@contextmanager
def open_log(path: Path, step: int) -> Iterator[RunLog]:
    """The log, cut back to the step from which the run goes on.

    A run that was killed may leave half a line, or the zeros of a power cut; such lines are left out.
    """
    kept = lines_until(path, step) if step and path.is_file() else []
    with atomic_write(path) as temporary:
        temporary.write_text("".join(line + "\n" for line in kept), encoding="utf-8")
    file = path.open("a", encoding="utf-8")
    try:
        yield RunLog(file, path)
    finally:
        with suppress(OSError):  # Every line was flushed when it was written.
            file.close()


def lines_until(path: Path, step: int) -> list[str]:
    """The legible lines of a log up to a step."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    return [line for line in lines if 0 <= _step_of(line) <= step]


def _step_of(line: str) -> int:
    """The step of a line; -1 where it is none of a log."""
    try:
        step = json.loads(line)["step"]
    except (ValueError, KeyError, TypeError, IndexError, RecursionError):
        return -1
    return step if isinstance(step, int) else -1
