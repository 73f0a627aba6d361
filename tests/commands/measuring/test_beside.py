"""A command in a process of its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from glassplat.commands.measuring.beside import Beside, beside
from tests.commands.console.test_cli import SCENE


def test_a_command_runs_beside_this_one(tmp_path: Path) -> None:
    with beside(["info", str(SCENE)], tmp_path / "logs" / "info.log") as command:
        command.wait()
    assert "glassplat train planar" in command.log.read_text()


def test_its_failure_is_said_with_its_last_words(tmp_path: Path) -> None:
    with (
        beside(["info", str(tmp_path / "nothing")], tmp_path / "info.log") as command,
        pytest.raises(ChildProcessError, match=r"glassplat info failed beside this command: .*nothing.*info\.log"),
    ):
        command.wait()


def test_it_ends_when_this_command_fails(tmp_path: Path) -> None:
    started: list[Beside] = []
    arguments = ["train", "splat", "--data", str(SCENE), "--output", str(tmp_path / "run")]
    with pytest.raises(RuntimeError, match="no more"), beside(arguments, tmp_path / "splat.log") as command:
        started.append(command)
        raise RuntimeError("no more")
    with pytest.raises(ChildProcessError):
        started[0].wait()
