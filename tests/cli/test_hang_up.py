"""Training whose terminal closes or which is killed."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from glassplat.cli.main import main
from glassplat.training.checkpoint import read_progress
from tests.training.tiny_capture import write_tiny_capture

LENGTH = 10**6


def command(tmp_path: Path) -> list[str]:
    capture = write_tiny_capture(tmp_path / "capture")
    options = ["--data", str(capture), "--output", str(tmp_path / "run"), "--iterations", str(LENGTH)]
    return [sys.executable, "-m", "glassplat.cli.main", "train", "splat", *options]


TAKE_TERMINAL = "import os, sys; os.open(os.ttyname(0), os.O_RDWR); os.execv(sys.argv[1], sys.argv[1:])"
"""Makes standard input the controlling terminal of a new session, whose end is a hang-up; then becomes the command."""


def read_until(descriptor: int, words: bytes) -> None:
    seen = b""
    while words not in seen:
        seen += os.read(descriptor, 4096)


def test_a_closed_terminal_loses_no_progress(tmp_path: Path) -> None:
    mine, its = pty.openpty()
    arguments = [sys.executable, "-c", TAKE_TERMINAL, *command(tmp_path)]
    with subprocess.Popen(arguments, stdin=its, stdout=its, stderr=its, start_new_session=True) as process:
        os.close(its)
        read_until(mine, b"loss")
        os.close(mine)
        assert process.wait(60) == 128 + signal.SIGHUP
    assert read_progress(tmp_path / "run" / "checkpoint.safetensors").seconds > 0
    assert not list((tmp_path / "run").glob(".*.tmp*"))


def test_a_run_killed_before_saving_reports_how_to_continue(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with subprocess.Popen(command(tmp_path), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
        assert process.stdout is not None
        read_until(process.stdout.fileno(), b"loss")
        process.kill()
    options = ["--data", str(tmp_path / "capture"), "--output", str(tmp_path / "run")]
    assert main(["train", "splat", *options, "--iterations", str(LENGTH), "--resume"]) == 2
    assert "nothing was saved yet" in capsys.readouterr().err
    assert main(["train", "splat", *options, "--iterations", "5"]) == 0
    assert "replacing an earlier run" in capsys.readouterr().out
