"""`glassplat demo` where it cannot begin."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from glassplat.cli import main


def test_a_demo_too_short_for_its_stages_leaves_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--output", str(tmp_path / "demo"), "--iterations", "1"]) == 2
    assert "expected at least" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()


@pytest.mark.parametrize("name", ["splat.log", "planar"])
def test_a_demo_does_not_follow_links_out_of_its_folder(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "demo").mkdir()
    (tmp_path / "mine").write_text("kept")
    (tmp_path / "demo" / name).symlink_to(tmp_path / "mine")
    assert main(["demo", "--output", str(tmp_path / "demo"), "--iterations", "8"]) == 2
    assert "leads out of" in capsys.readouterr().err
    assert (tmp_path / "mine").read_text() == "kept"


def test_a_pipe_in_place_of_the_log_does_not_hold_the_demo_up(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "demo").mkdir()
    os.mkfifo(tmp_path / "demo" / "splat.log")
    assert main(["demo", "--output", str(tmp_path / "demo"), "--iterations", "8"]) == 2
    assert "is a pipe" in capsys.readouterr().err
