"""`glassplat annotate` without its page: what it suggests, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import pytest

from glassplat.cli import main
from glassplat.commands.capture import marking
from tests.annotate.conftest import write_room
from tests.annotate.suggested import suggestions


def told_by(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """The exit code of `glassplat annotate`, and what it said, in one line."""
    code = main(["annotate", *arguments])
    said = capsys.readouterr()
    return code, " ".join((said.out + said.err).split())


def test_suggestions_are_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    room = write_room(tmp_path / "room")
    monkeypatch.setattr(marking, "suggested_panes", lambda views, extent, listen: suggestions())
    code, told = told_by(capsys, str(room), "--suggest", "--no-page")
    assert code == 0
    assert "suggestion 1:" in told and "7 things are seen in it and directly too, in 5 photographs" in told
    assert not (room / "annotations.json").exists(), "to look changes nothing"


def test_a_room_without_texture_has_no_suggestion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, told = told_by(capsys, str(write_room(tmp_path / "room")), "--suggest", "--no-page")
    assert code == 0
    assert "no pane was found" in told and "mark the corners by hand" in told


def test_nothing_to_do_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, told = told_by(capsys, str(write_room(tmp_path / "room")), "--no-page")
    assert code == 2
    assert "without --suggest nothing is looked for" in told


def test_a_folder_that_is_no_capture_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, told = told_by(capsys, str(tmp_path / "nothing"), "--suggest", "--no-page")
    assert code == 2
    assert "nothing" in told and "Traceback" not in told
