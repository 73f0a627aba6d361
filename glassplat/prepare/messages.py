"""What a preparation says while it runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Progress:
    """How far one part of the work is; `done` counts from 0 to `total`."""

    what: str
    done: int
    total: int


@dataclass(frozen=True)
class Note:
    """Something that the user should know now, a full sentence."""

    text: str


Listener = Callable[[Progress | Note], None]
