"""Only one training at a time can use a folder."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from glassplat.errors import InputError
from glassplat.model.run_directory import LOCK_FILE, check_unlocked, run_lock

HOLD = """
import sys
from pathlib import Path
from glassplat.model.run_directory import run_lock
with run_lock(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_training_is_refused_until_the_first_ends(tmp_path: Path) -> None:
    with run_lock(tmp_path):
        for refused in (run_lock(tmp_path).__enter__, lambda: check_unlocked(tmp_path)):
            with pytest.raises(InputError, match="another training is writing"):
                refused()
    check_unlocked(tmp_path)
    with run_lock(tmp_path):
        pass


def test_a_killed_process_leaves_no_lock(tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline() == "held\n"
        with pytest.raises(InputError):
            check_unlocked(tmp_path)
        process.kill()
    assert (tmp_path / LOCK_FILE).is_file()
    check_unlocked(tmp_path)


def test_reading_creates_no_file(tmp_path: Path) -> None:
    check_unlocked(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_without_locks_gets_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def unsupported(descriptor: int, operation: int) -> None:
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr("fcntl.flock", unsupported)
    with run_lock(tmp_path):
        assert "cannot be locked (Operation not supported)" in caplog.text
