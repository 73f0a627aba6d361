"""Errors of invalid input."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """An input, an option or a name is invalid; the message says what was expected, what was found and what to do."""


class UnknownFormatError(InputError):
    """A folder is not a capture of any supported format."""


class RankLostError(RuntimeError):
    """Another process of a run has ended; the training state is intact.

    Attributes:
        ending: label, text and exit code of the other process; None if it ended unexpectedly.
    """

    def __init__(self, text: str, ending: tuple[str, str, int] | None = None) -> None:
        super().__init__(text)
        self.ending = ending


@contextmanager
def convert_to_input_error(where: object = None) -> Iterator[None]:
    """Turns the ValueError of a reader or an edit into an InputError.

    Args:
        where: prefix of the message, such as the file, if the message does not name it.
    """
    try:
        yield
    except ValueError as error:
        raise InputError(str(error) if where is None else f"{where}: {error}") from error


def count_noun(number: int, noun: str) -> str:
    """A count with its noun, as in "1 pane" and "2 panes"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def join_names(names: list[str], limit: int = 5) -> str:
    """A list of names for a message, cut short after `limit`."""
    shown = ", ".join(names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"
