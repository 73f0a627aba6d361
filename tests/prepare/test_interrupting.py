"""Interrupted preparations: COLMAP's threads end with them, and their remaining files are reported correctly."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from glassplat.cli import capture
from glassplat.cli.main import main
from glassplat.errors import InputError
from glassplat.prepare import preparation, report_page
from glassplat.prepare.colmap import run_interruptible
from glassplat.prepare.preparation import PAGE, RECORD, Preparation, prepare
from glassplat.training.messages import Working
from tests.prepare.conftest import Heard
from tests.prepare.test_video import film


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
            run_interruptible(work)
    finally:
        signal.signal(signal.SIGINT, before)
    assert ended


def test_finished_work_returns_its_result_or_raises() -> None:
    assert run_interruptible(lambda token: 5) == 5

    def failing(token: Any) -> None:
        raise RuntimeError("no features")

    with pytest.raises(RuntimeError, match="no features"):
        run_interruptible(failing)


def interrupt(*arguments: Any, **options: Any) -> None:
    raise KeyboardInterrupt


def interrupted(photographs: Path, output: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """The message of a preparation interrupted by Ctrl-C."""
    assert main(["prepare", str(photographs), "--output", str(output), "--force"]) == 130
    return " ".join(capsys.readouterr().err.split())


def test_a_capture_without_its_report_page_is_complete(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(capture, "prepare", lambda *arguments, **options: SimpleNamespace(lines=lambda: []))
    monkeypatch.setattr(report_page, "write_page", interrupt)
    output = tmp_path / "my capture"
    told = interrupted(photographs, output, capsys)
    assert f"the capture in {output} is complete; `glassplat info '{output}' --page '{output / PAGE}'` writes" in told


def test_an_earlier_capture_is_not_reported_as_the_result(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / RECORD).write_text("{}")
    monkeypatch.setattr(capture, "prepare", interrupt)
    assert "nothing was written" in interrupted(photographs, tmp_path / "capture", capsys)


def begun(photographs: Path, output: Path) -> Preparation:
    """A preparation that was interrupted at its first message."""
    task = Preparation(photographs, output)
    with pytest.raises(KeyboardInterrupt):
        prepare(task, interrupt)
    return task


def exchange(folder: Path) -> None:
    first, *_, last = sorted(folder.iterdir())
    last.with_name("new.jpg").write_bytes(last.read_bytes() + b" ")
    first.unlink()


def edit(folder: Path) -> None:
    first = min(folder.iterdir())
    data = first.read_bytes()
    first.write_bytes(data[:-1] + b" ")
    os.utime(first, (0, 0))


@pytest.mark.parametrize(
    ("change", "names"),
    [(exchange, r"Bild ä 0000\.jpg, new\.jpg\)"), (edit, r": Bild ä 0000\.jpg\)")],
)
def test_resuming_work_on_other_photographs_is_refused(
    change: Callable[[Path], None], names: str, photographs: Path, tmp_path: Path, heard: Heard
) -> None:
    task = begun(photographs, tmp_path / "capture")
    change(photographs)
    with pytest.raises(InputError, match=rf"photographs have changed since .*capture\.partial .*{names}.*--force"):
        prepare(task, heard, resume=True)
    assert not heard
    with pytest.raises(KeyboardInterrupt):
        prepare(task, interrupt, force=True)
    with pytest.raises(KeyboardInterrupt):
        prepare(task, interrupt, resume=True)


def test_work_survives_temporarily_unreadable_photographs(
    photographs: Path, tmp_path: Path, heard: Heard, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = begun(photographs, tmp_path / "capture")
    features = tmp_path / "capture.partial" / "features-4096.db"
    features.write_text("hours of work")
    refuse = Mock(side_effect=InputError("cannot read 3.jpg (Input/output error)"))
    monkeypatch.setattr(preparation, "photographs_in", refuse)
    with pytest.raises(InputError, match="Input/output error"):
        prepare(task, heard, resume=True)
    assert features.read_text() == "hours of work"
    with pytest.raises(InputError, match="Input/output error"):
        prepare(task, heard, force=True)
    assert not features.parent.exists()


def test_resuming_work_without_recorded_photographs_is_refused(photographs: Path, tmp_path: Path, heard: Heard) -> None:
    task = begun(photographs, tmp_path / "capture")
    settings = tmp_path / "capture.partial" / "settings.json"
    settings.write_text(json.dumps(task.record()))
    with pytest.raises(InputError, match=r"capture\.partial does not record the photographs .* --force"):
        prepare(task, heard, resume=True)


@pytest.mark.parametrize(
    "change", [lambda names: names[::-1], lambda names: names[1:], None], ids=["order", "selection", "no record"]
)
def test_resuming_work_whose_photographs_are_numbered_differently_is_refused(
    change: Callable[[list[str]], list[str]] | None, photographs: Path, tmp_path: Path
) -> None:
    """In another order, or selected by another rule for masks and duplicates; or it is not known."""

    def listen(message: Any) -> None:
        if message == Working("reading the photographs", 1, message.total):
            raise KeyboardInterrupt

    task = Preparation(photographs, tmp_path / "capture")
    for resume in (False, True):
        with pytest.raises(KeyboardInterrupt):
            prepare(task, listen, resume=resume)
    numbering = tmp_path / "capture.partial" / "grey" / "photographs.json"
    if change is None:
        numbering.unlink()
    else:
        numbering.write_text(json.dumps(change(json.loads(numbering.read_text()))))
    with pytest.raises(
        InputError, match=r"in this order: other ones were selected, or another version of glassplat .* --force"
    ):
        prepare(task, listen, resume=True)


def test_what_was_interrupted_is_neither_begun_again_nor_gone_on_with_by_other_options(
    photographs: Path, tmp_path: Path, heard: Heard
) -> None:
    task = begun(photographs, tmp_path / "capture")
    with pytest.raises(InputError, match=r"holds an interrupted preparation of .*capture; continue it with --resume"):
        prepare(task, heard)
    with pytest.raises(InputError, match=r"capture\.partial was started with another max-size; give the same"):
        prepare(replace(task, max_size=800), heard, resume=True)
    assert not heard


def test_resuming_with_another_video_of_the_same_name_is_refused(tmp_path: Path, heard: Heard) -> None:
    video = film(tmp_path / "walk.avi", np.arange(5) * 8)
    task = begun(video, tmp_path / "capture")
    film(video, np.arange(6) * 8)
    with pytest.raises(InputError, match=r"written again: walk\.avi\)"):
        prepare(task, heard, resume=True)
