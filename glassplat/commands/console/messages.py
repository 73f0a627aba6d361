"""Lines that commands print: names and messages appear as they are, and only a terminal breaks them.

Everything printed may hold a path or a name that somebody else chose. Rich would read `[...]` in it as markup and `:x:`
as a picture, and break it at 80 columns where the output goes to a file; a control character would reach the terminal.
"""

from __future__ import annotations

import io
import logging
import os
import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

from rich.console import Console
from rich.text import Text

UNPRINTABLE = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
"""Control characters but for tabs and line breaks, and the bytes of a file name that are not text."""


def message_console(*, stderr: bool = False) -> Console:
    """The console of a command: strings are shown as they are, and break only in a terminal."""
    console = Console(stderr=stderr, markup=False, emoji=False, highlight=False)
    console.soft_wrap = not console.is_terminal
    return console


def say(console: Console, text: object, *, label: str = "", style: str = "") -> None:
    """Prints a line as it is.

    Args:
        console: where to; any console, also one that reads markup.
        text: what to say.
        label: a word in front, followed by a colon, such as `warning`.
        style: the label's colour.
    """
    line = Text(f"{label}:" if label else "", style=style)
    line.append(f"{' ' if label else ''}{printable(str(text))}", style="default")
    console.print(line, soft_wrap=not console.is_terminal)


def warn(console: Console, text: object) -> None:
    """Prints a warning: the command goes on."""
    say(console, text, label="warning", style="yellow")


def complain(label: Literal["error", "stopped", "failed"], text: object) -> None:
    """Prints on standard error why a command ends, or one of its parts.

    Args:
        label: `error` for wrong input, `stopped` for a failure while running, `failed` for a part that is left out.
        text: what was expected, what came, and what to do.
    """
    say(message_console(stderr=True), text, label=label, style="red")


def printable(text: str) -> str:
    r"""The text with what no terminal should get written out, such as `\x1b`."""
    return UNPRINTABLE.sub(lambda found: repr(found.group())[1:-1], text)


def plain_streams() -> None:
    """Lets every program be started from: with output that is closed, or in an encoding that lacks a character."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 - Until the process ends.
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def drop_output() -> None:
    """Sends what is still to be printed nowhere, since nobody reads it any more."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)


class LogLines(logging.Handler):
    """Shows what is logged among the other lines of a command, above its progress bar."""

    def __init__(self, console: Console) -> None:
        super().__init__()
        self._console = console

    def emit(self, record: logging.LogRecord) -> None:
        """Prints one record."""
        if record.levelno >= logging.WARNING:
            warn(self._console, record.getMessage())
        else:
            say(self._console, record.getMessage())


@contextmanager
def heard_by(console: Console) -> Iterator[None]:
    """Shows on a console what the package logs and what libraries warn of, each as a line."""

    def show(message: Warning | str, *place: Any, **more: Any) -> None:
        warn(console, message)

    logging.basicConfig(level=logging.WARNING, handlers=[LogLines(console)])
    logging.getLogger("glassplat").setLevel(logging.INFO)
    with warnings.catch_warnings():
        warnings.showwarning = show
        yield
