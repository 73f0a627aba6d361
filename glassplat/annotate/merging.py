"""Marks of two pages, or programs, in one capture: what of both is kept when both have changed the document."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from glassplat.annotate.document import MOST_PANES

Panes = Mapping[int, Any]


class Merged(NamedTuple):
    """A document with the changes of both sides.

    Attributes:
        document: as JSON.
        changes: what the others have changed, in words.
        renamed: new labels of our panes by the ones that they had.
    """

    document: Any
    changes: list[str]
    renamed: dict[int, int]


def merged(base: Any, theirs: Any, ours: Any) -> Merged:
    """Puts together what two sides have made of one document.

    A pane that one side has changed or added is as that side has it. One that both have changed stays as they
    have it, and ours is added under a label that is free; so is one that they have removed and we have changed.

    Args:
        base: the document that both began with.
        theirs: what is saved.
        ours: what was to be saved.

    Raises:
        ValueError: there are too many panes for both to be kept.
    """
    before, there, here = (_by_label(document) for document in (base, theirs, ours))
    kept, renamed = dict(there), dict[int, int]()
    for label in sorted({*before, *here}):
        ours_now, old = here.get(label), before.get(label)
        if ours_now == old or ours_now == there.get(label):
            continue
        if there.get(label) == old:
            kept[label] = ours_now
        elif ours_now is not None:
            new = renamed[label] = _free_label({*kept, *here})
            kept[new] = {**ours_now, "label": new}
    panes = [pane for _, pane in sorted(kept.items()) if pane is not None]
    return Merged({**theirs, "panes": panes}, _changes(before, there), renamed)


def _by_label(document: Any) -> dict[int, Any]:
    return {pane["label"]: pane for pane in document["panes"]}


def _free_label(used: set[int]) -> int:
    label = next((label for label in range(1, MOST_PANES + 1) if label not in used), None)
    if label is None:
        raise ValueError(f"all {MOST_PANES} labels are in use; remove a pane here before what is marked elsewhere fits")
    return label


def _changes(before: Panes, after: Panes) -> list[str]:
    words = []
    for label in sorted({*before, *after}):
        if before.get(label) != after.get(label):
            how = "added" if label not in before else "removed" if label not in after else "changed"
            words.append(f"pane {label} {how}")
    return words or ["nothing of the panes"]
