"""A command of this package in a process of its own, while this one does something else."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from glassplat.files.folders import make_folder

PATIENCE = 60.0
"""Seconds that a command has to end in after it was asked to; a checkpoint takes less."""


class Beside:
    """The command while it runs.

    Attributes:
        log: file that takes what it says.
    """

    def __init__(self, arguments: Sequence[str], log: Path) -> None:
        self.log = log
        self._named = f"glassplat {arguments[0]}"
        make_folder(log.parent)
        # A session of its own: Ctrl-C reaches this process alone, which then asks the other one to end.
        with log.open("w", encoding="utf-8") as stream:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "glassplat", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )

    def wait(self) -> None:
        """Returns when it has ended.

        Raises:
            ChildProcessError: it failed; with the last line that it said.
        """
        if self._process.wait() != 0:
            said = self.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
            last = said[-1] if said else f"it ended with exit code {self._process.returncode}"
            raise ChildProcessError(f"{self._named} failed beside this command: {last} (all of it: {self.log})")

    def stop(self) -> None:
        """Asks it to end, as Ctrl-C would, and sees to it that it does."""
        if self._process.poll() is not None:
            return
        self._process.terminate()
        try:
            self._process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@contextmanager
def beside(arguments: Sequence[str], log: Path) -> Iterator[Beside]:
    """Runs `glassplat ARGUMENTS` beside what is done within; it has ended afterwards, whatever happens.

    Args:
        arguments: of the command line.
        log: file that takes what it says; its folder is made where it is missing.
    """
    command = Beside(arguments, log)
    try:
        yield command
    finally:
        command.stop()
