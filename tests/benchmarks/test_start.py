"""Time until a process prints its first line, excluding everything after it."""

from __future__ import annotations

import time

from benchmarks.start import first_line, start_times


def test_a_process_is_ended_with_its_first_line() -> None:
    begin = time.perf_counter()
    heard = first_line(["-c", "import time; print('first'); time.sleep(600); print('second')"])
    assert heard.text == "first"
    assert 0 < heard.seconds < time.perf_counter() - begin


def test_a_silent_process_is_not_a_failure() -> None:
    assert first_line(["-c", "pass"]).text == ""


def test_each_command_has_a_row_with_its_summary() -> None:
    (row,) = start_times([["train", "splat", "--data", "nothing-here", "--output", "{output}"]], rounds=1).rows
    assert row[0] == "`train splat --data nothing-here --output OUTPUT`"
    assert "nothing-here" in row[2]
