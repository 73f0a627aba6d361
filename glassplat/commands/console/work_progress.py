"""How long work is followed: a bar in a terminal, and a line now and then where the output goes elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import TimeRemainingColumn as TimeLeftColumn

from glassplat.commands.console.messages import say, warn
from glassplat.commands.console.training_progress import in_words
from glassplat.prepare.messages import Note
from glassplat.prepare.messages import Progress as Step

PAUSE = 10.0
"""Seconds between two lines about the same work."""


class WorkProgress:
    """Shows messages of work; a context, so that a bar ends with it."""

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._clock = console, clock
        self._what = ""
        self._begun = self._shown = 0.0
        self._first = 0
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> WorkProgress:
        if self._console.is_terminal:
            columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn())
            times = (TimeElapsedColumn(), TextColumn("left"), TimeLeftColumn(compact=True))
            self._bar = Progress(*columns, *times, console=self._console, refresh_per_second=4)
            self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bar is not None:
            with suppress(OSError):  # A terminal that was closed must not hide why the work ends.
                self._bar.stop()

    def show(self, message: Step | Note) -> None:
        """Follows the work."""
        if isinstance(message, Note):
            warn(self._console, message.text)
            self._what = ""
        elif self._bar is not None:
            self._show_bar(self._bar, message)
        else:
            self._show_line(message)

    def _show_bar(self, bar: Progress, step: Step) -> None:
        if step.what != self._what or self._task is None:
            if self._task is not None:
                bar.remove_task(self._task)
            self._task = bar.add_task(step.what, total=step.total, completed=step.done)
            self._what = step.what
        bar.update(self._task, completed=step.done)

    def _show_line(self, step: Step) -> None:
        now = self._clock()
        if step.what != self._what:
            self._what, self._begun, self._shown, self._first = step.what, now, now, step.done
            say(self._console, f"{step.what} ({step.total})")
        elif now - self._shown >= PAUSE:
            self._shown = now
            say(self._console, f"{step.what}: {step.done} of {step.total}, {self._left(step, now)}")

    def _left(self, step: Step, now: float) -> str:
        done = step.done - self._first
        if done <= 0:
            return "time left is not known yet"
        return f"{in_words((now - self._begun) / done * (step.total - step.done))} left"
