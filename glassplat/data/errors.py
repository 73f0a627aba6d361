"""The error that a wrong data set ends with."""

from __future__ import annotations


class InputError(ValueError):
    """The data set cannot be used as it is; the message says what was expected, what came and what to do."""


def first_names(names: list[str], limit: int = 5) -> str:
    """A list of names for a message, cut short after `limit`."""
    shown = ", ".join(names[:limit])
    return shown if len(names) <= limit else f"{shown} and {len(names) - limit} more"
