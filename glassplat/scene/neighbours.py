"""Which photographs were taken just before and after another one, by their names."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath


def neighbours(name: str, names: Sequence[str]) -> list[int]:
    """Rows of the last of `names` before `name` and of the first after it; one of them at an end.

    Numbers in names count as numbers: 9 comes before 10. Photographs of other folders are no neighbours, since nobody
    knows when they were taken; the list is empty where there are no others.
    """
    folder, here = PurePosixPath(name).parent, _in_order(name)
    beside = [row for row, known in enumerate(names) if PurePosixPath(known).parent == folder and known != name]
    before = [row for row in beside if _in_order(names[row]) < here]
    after = [row for row in beside if _in_order(names[row]) > here]
    return [
        *([max(before, key=lambda row: _in_order(names[row]))] if before else []),
        *([min(after, key=lambda row: _in_order(names[row]))] if after else []),
    ]


def _in_order(name: str) -> tuple[list[tuple[int, str]], str]:
    """What names are sorted by: their parts, with numbers by value."""
    parts = re.findall(r"\d+|\D+", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], name
