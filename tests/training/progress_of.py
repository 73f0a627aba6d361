"""Carrying out an edit of the training state that tells how far it is."""

from __future__ import annotations

from glassplat.training.messages import Working
from glassplat.training.stage import Work, run_edit


def followed(edit: Work | bool | None) -> tuple[list[Working], bool]:
    """What an edit tells on the way, and whether there was anything to edit."""
    messages, work = [], run_edit(edit)
    while True:
        try:
            messages.append(next(work))
        except StopIteration as end:
            return messages, end.value


def finished(edit: Work | bool | None) -> bool:
    """Whether there was anything to edit."""
    return followed(edit)[1]
