"""Images of pages are written to a folder created for them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tools import make_capture_pictures


def test_a_new_folder_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[bool] = []
    monkeypatch.setattr(make_capture_pictures, "draw", lambda scene, output: drawn.append(output.is_dir()))
    monkeypatch.setattr(sys, "argv", ["draw", "--scene", "s", "--output", str(tmp_path / "new" / "folder")])
    make_capture_pictures.main()
    assert drawn == [True]
