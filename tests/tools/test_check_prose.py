"""The check of prose finds what it should, and the pages pass it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools import check_prose

LONG = " ".join(["word"] * 41)


def test_code_tables_and_headings_are_no_sentences() -> None:
    page = "# A heading\n\nOne `a b c` two. Three.\n\n    indented code\n\n```\nfenced. Code.\n```\n\n"
    prose = check_prose.prose_of(f"{page}| a | b c |\n|---|---|\n")
    assert prose.sentences == ["One Code two.", "Three."]
    assert prose.cells == ["a", "b c"]


@pytest.mark.parametrize("page", [f"{LONG}.", f"- {LONG}.", f"| {LONG} | b |", "The beat.", "[Whom](x.md) it serves."])
def test_long_sentences_and_banned_words_are_found(page: str) -> None:
    assert len(list(check_prose.page_complaints("page", page))) == 1


@pytest.mark.parametrize("page", ["Short. " * 50, "`beat` is code.", "Besides, this is fine."])
def test_plain_pages_pass(page: str) -> None:
    assert not list(check_prose.page_complaints("page", page))


def test_sizes_are_limited() -> None:
    assert not list(check_prose.size_complaints("short", {"page": "A short page."}))
    assert len(list(check_prose.size_complaints("line\n" * 61, {"page": "Word.\n" * 2301}))) == 2
    assert len(list(check_prose.size_complaints("", {"page": "word " * 21 + "."}))) == 1


def test_unclear_expressions_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check_prose, "ROOT", tmp_path)
    path = tmp_path / "code.py"
    functions = 'def asked():\n    """Whether it is so."""\n\n\ndef told():\n    """Whatever."""\n'
    path.write_text(f'"""A module."""\n\n\n{functions}')
    assert [complaint.split(":")[:2] for complaint in check_prose.riddles(path)] == [["code.py", "4"]]
