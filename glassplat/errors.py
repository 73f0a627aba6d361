"""Errors that a wrong input ends with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """An input, an option or a name cannot be used; the message says what was expected, what came and what to do."""


class UnknownFormatError(InputError):
    """A folder holds no capture of any format that is read."""


class RankLostError(RuntimeError):
    """Another process of a run has ended; what was trained is intact.

    Attributes:
        ending: label, text and exit code that it ended with; None where it ended without a word.
    """

    def __init__(self, text: str, ending: tuple[str, str, int] | None = None) -> None:
        super().__init__(text)
        self.ending = ending


@contextmanager
def input_checked(where: object = None) -> Iterator[None]:
    """Turns the ValueError of a reader or an edit, whose message says what is wrong, into an InputError.

    Args:
        where: what to name before the message, such as a file, where that does not name it.
    """
    try:
        yield
    except ValueError as error:
        raise InputError(str(error) if where is None else f"{where}: {error}") from error


def first_names(names: list[str], limit: int = 5) -> str:
    """A list of names for a message, cut short after `limit`."""
    shown = ", ".join(names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"
