"""Helpers that carry out an edit of the training state and collect its progress messages."""

from __future__ import annotations

from glassplat.training.messages import Working
from glassplat.training.stage import Work, run_edit


def followed(edit: Work | bool | None) -> tuple[list[Working], bool]:
    """The progress messages of an edit, and True if there was anything to edit."""
    messages, work = [], run_edit(edit)
    while True:
        try:
            messages.append(next(work))
        except StopIteration as end:
            return messages, end.value


def finished(edit: Work | bool | None) -> bool:
    """True if there was anything to edit."""
    return followed(edit)[1]
