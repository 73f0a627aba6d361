"""Marks of two pages are merged so that nothing of either is lost."""

from __future__ import annotations

import sys
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import pytest

from glassplat.annotate import session
from glassplat.annotate.document import MOST_PANES, read_document
from glassplat.annotate.session import ChangedElsewhereError, merge_documents, open_session
from tests.annotate.conftest import marked_document, saved


def document(**panes: str) -> dict:
    """A document of panes a=1, b=2, ..., each with a text that stands for its marks."""
    return {"version": 1, "panes": [{"label": ord(name) - 96, "marks": marks} for name, marks in panes.items()]}


@pytest.mark.parametrize(
    ("theirs", "ours", "together", "told"),
    [
        (document(a="1", b="2"), document(a="1", c="3"), document(a="1", b="2", c="3"), ["pane 2 added"]),
        (document(a="2"), document(a="1", b="2"), document(a="2", b="2"), ["pane 1 changed"]),
        (document(a="2"), document(a="3"), document(a="2", b="3"), ["pane 1 changed"]),
        (document(a="2"), document(a="2"), document(a="2"), ["pane 1 changed"]),
        (document(), document(a="3"), document(b="3"), ["pane 1 removed"]),
        (document(), document(a="1", b="2"), document(b="2"), ["pane 1 removed"]),
        (document(a="2"), document(), document(a="2"), ["pane 1 changed"]),
        (document(a="1", b="2"), document(), document(b="2"), ["pane 2 added"]),
    ],
)
def test_both_are_kept(theirs: dict, ours: dict, together: dict, told: list[str]) -> None:
    found = merge_documents(document(a="1"), theirs, ours)
    assert (found.document, found.changes) == (together, told)
    for old, new in found.renamed.items():
        (pane,) = (pane for pane in together["panes"] if pane["label"] == new)
        assert {**pane, "label": old} in ours["panes"]


def test_more_panes_than_fit_are_refused() -> None:
    full = {"version": 1, "panes": [{"label": label, "marks": "1"} for label in range(1, MOST_PANES + 1)]}
    ours = {"version": 1, "panes": [{"label": 1, "marks": "2"}]}
    with pytest.raises(ValueError, match="all 64 labels are in use"):
        merge_documents(document(), full, ours)


@pytest.mark.parametrize("has_folder_locks", [True, False])
def test_concurrent_saves_of_two_programs_lose_nothing(
    room: Path, monkeypatch: pytest.MonkeyPatch, *, has_folder_locks: bool
) -> None:
    if not has_folder_locks:
        monkeypatch.setitem(sys.modules, "fcntl", None)  # As on Windows.
    one, other = open_session(room), open_session(room)
    second: list[Future[Any]] = []
    write = session.write_document

    def write_late(folder: Path, document: Any) -> None:
        if not second:
            second.append(pool.submit(saved, other, marked_document(label=2)))
            wait(second, timeout=0.5)
        write(folder, document)

    with ThreadPoolExecutor(1) as pool:
        monkeypatch.setattr(session, "write_document", write_late)
        saved(one, marked_document())
        with pytest.raises(ChangedElsewhereError):
            second[0].result(30)
    assert [pane["label"] for pane in read_document(room)["panes"]] == [1]
