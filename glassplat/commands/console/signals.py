"""What ends a command from outside: Ctrl-C, a job scheduler, a terminal that closes."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

WORDS = {
    name: word
    for name, word in (("SIGINT", "interrupted"), ("SIGTERM", "terminated"), ("SIGHUP", "the terminal was closed"))
    if hasattr(signal, name)  # Windows has no SIGHUP.
}
CODE_OF_SIGNALS = 128
"""Shells report a process that a signal ended by this plus the signal's number."""


class Interrupted(KeyboardInterrupt):
    """The command was asked to end.

    Attributes:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(WORDS[signal.Signals(number).name])
        self.number = number


def code_of(stop: KeyboardInterrupt) -> int:
    """The exit code: 130 after Ctrl-C, 143 and 129 after the two other signals."""
    return CODE_OF_SIGNALS + (stop.number if isinstance(stop, Interrupted) else signal.SIGINT)


@contextmanager
def raised_signals() -> Iterator[list[Interrupted]]:
    """Turns the signals into `Interrupted`, raised where the command is, so that half-written files are removed.

    Gives the list of those raised: a library that is interrupted may end with an error of its own.
    """
    raised: list[Interrupted] = []

    def stop(number: int, frame: FrameType | None) -> None:
        raised.append(Interrupted(number))
        raise raised[-1]

    with _answered(stop):
        yield raised


@contextmanager
def immediate_end() -> Iterator[None]:
    """Ends the process at the first signal, with one line: for the seconds in which libraries are imported.

    Nothing has been written yet that would be left behind. An exception would not do: a library may take it for its
    own failure, or go on without the module that it was importing.
    """

    def end(number: int, frame: FrameType | None) -> None:
        stop = Interrupted(number)
        os.write(sys.__stderr__.fileno() if sys.__stderr__ else 2, f"{stop}\n".encode())
        os._exit(code_of(stop))

    with _answered(end):
        yield


@contextmanager
def held_signals() -> Iterator[None]:
    """Answers signals when the context ends: for imports while something runs that has to be told to end."""
    held: list[int] = []
    with _answered(lambda number, frame: held.append(number)):
        yield
    for number in held[:1]:
        signal.raise_signal(number)


@contextmanager
def _answered(answer: signal._HANDLER) -> Iterator[None]:
    """Has the signals answered, but for those that the process was told to ignore, as by `nohup`."""
    if threading.current_thread() is not threading.main_thread():
        yield  # Only the main thread may say how signals are answered.
        return
    numbers = [getattr(signal, name) for name in WORDS]
    before = {number: signal.getsignal(number) for number in numbers}
    heard = [number for number, handler in before.items() if handler not in (signal.SIG_IGN, None)]
    for number in heard:
        signal.signal(number, answer)
    try:
        yield
    finally:
        for number in heard:
            signal.signal(number, before[number])
