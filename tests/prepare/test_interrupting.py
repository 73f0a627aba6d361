"""Work that is interrupted has ended when the interrupt goes on: COLMAP's threads must not outlive the command."""

from __future__ import annotations

import signal
import threading
import time
from typing import Any

import pytest

from glassplat.prepare.colmap import interruptible


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
