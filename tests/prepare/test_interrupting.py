"""Preparations that are interrupted: COLMAP's threads do not outlive them, and what they leave is told rightly."""

from __future__ import annotations

import signal
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from glassplat.cli import capture
from glassplat.cli.main import main
from glassplat.prepare import report_page
from glassplat.prepare.colmap import interruptible
from glassplat.prepare.preparation import PAGE, RECORD


def test_an_interrupt_waits_until_the_work_has_ended() -> None:
    ended = []

    def work(token: Any) -> None:
        time.sleep(0.05)
        signal.pthread_kill(main.ident, signal.SIGINT)
        while not token.is_cancelled:
            time.sleep(0.01)
        time.sleep(0.3)
        ended.append(True)

    main = threading.main_thread()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            interruptible(work)
    finally:
        signal.signal(signal.SIGINT, before)
    assert ended


def test_work_that_ends_tells_its_result_and_what_it_raised() -> None:
    assert interruptible(lambda token: 5) == 5

    def failing(token: Any) -> None:
        raise RuntimeError("no features")

    with pytest.raises(RuntimeError, match="no features"):
        interruptible(failing)


def interrupt(*arguments: Any, **options: Any) -> None:
    raise KeyboardInterrupt


def interrupted(photographs: Path, output: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What a preparation says that Ctrl-C ended."""
    assert main(["prepare", str(photographs), "--output", str(output), "--force"]) == 130
    return " ".join(capsys.readouterr().err.split())


def test_a_capture_that_misses_its_page_is_said_to_be_whole(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture, "prepare", lambda *arguments, **options: SimpleNamespace(lines=lambda: []))
    monkeypatch.setattr(report_page, "write_page", interrupt)
    output = tmp_path / "my capture"
    told = interrupted(photographs, output, capsys)
    assert f"the capture in {output} is whole; `glassplat info '{output}' --page '{output / PAGE}'` writes" in told


def test_an_earlier_capture_is_not_taken_for_this_one(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / RECORD).write_text("{}")
    monkeypatch.setattr(capture, "prepare", interrupt)
    assert "nothing was written" in interrupted(photographs, tmp_path / "capture", capsys)
