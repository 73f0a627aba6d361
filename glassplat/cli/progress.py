"""Progress of training and other long work: a bar in a terminal, lines now and then elsewhere."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from rich import progress
from rich.console import Console

from glassplat.cli.console import print_line, print_warning
from glassplat.errors import count_noun
from glassplat.prepare.photographs import Note
from glassplat.training import messages

FIRST_INTERVAL, LONGEST_INTERVAL = 1.0, 10.0
"""Seconds between two lines, at the start of a run and later."""
SPEED_SECONDS = 60.0
"""Time window over which the speed is measured, for the remaining time."""
LONG_WORK = 5.0
"""Longer work between two steps is excluded from the speed, as is all work at the start of a stage."""
SMOOTHING = 0.98
WIDE_TERMINAL = 110
"""Minimum width of a terminal, in columns, for the last checkpoint in the bar."""
FORECAST_STEPS, FORECAST_SECONDS = 10, 5.0
"""Steps and seconds before the duration of the run is estimated; the first step, which may compile, is excluded."""
LONG_SECONDS = 600.0
"""For longer runs, the estimate suggests how to shorten them."""
SILENT_ACTIONS = ("densify", "grow", "seed", "turn", "light", "fill")
"""Prefixes of actions that are not printed: they are too frequent, or log a sentence of their own."""


@dataclass
class ProgressState:
    """Progress of a training: `loss` is smoothed, `saved_step` is the step of the last checkpoint."""

    iterations: int
    step: int = 0
    stage: str = ""
    loss: float = 0.0
    count: int = 0
    saved_step: int | None = None
    time_left: str = ""


@dataclass(frozen=True)
class Plan:
    """Lengths and typical costs of a run's stages, known before it begins.

    Attributes:
        ends: last step of each stage.
        costs: typical seconds of a step in each, in any unit; they extrapolate the speed of one stage to the next.
        shortcuts: ways to shorten the run, as the end of a sentence; empty for none.
    """

    ends: tuple[int, ...]
    costs: tuple[float, ...]
    shortcuts: str = ""

    @property
    def iterations(self) -> int:
        """Length of the run."""
        return self.ends[-1]

    def work(self, step: int) -> float:
        """Total cost of all steps up to a step."""
        total, begin = 0.0, 0
        for end, cost in zip(self.ends, self.costs, strict=True):
            total += cost * max(min(step, end) - begin, 0)
            begin = end
        return total

    def cost(self, step: int) -> float:
        """Cost of a step."""
        return self.work(step) - self.work(step - 1)


class SpeedEstimate:
    """Speed over the last minute, or since the last long work between steps, and the remaining time."""

    def __init__(self, plan: Plan, clock: Callable[[], float] = time.monotonic) -> None:
        self._plan, self._clock = plan, clock
        self._samples: deque[tuple[float, int]] = deque()
        self._is_forecast = self._had_other_work = False
        self._last_step_at = clock()

    def work(self) -> None:
        """Records that there was other work since the last step."""
        self._had_other_work = True

    def enter_stage(self) -> None:
        """Restarts the measurement: setup of a stage happens once, and its first step may compile."""
        self._samples.clear()

    def step(self, number: int) -> None:
        """Records a step, at intervals."""
        now = self._clock()
        if self._had_other_work and now - self._last_step_at >= LONG_WORK:
            self._samples.clear()
        self._last_step_at, self._had_other_work = now, False
        if not self._samples or now - self._samples[-1][0] >= FIRST_INTERVAL:
            self._samples.append((now, number))
        while len(self._samples) > 2 and now - self._samples[1][0] > SPEED_SECONDS:
            self._samples.popleft()

    def seconds_left(self, number: int) -> float | None:
        """Seconds from a step to the end of the run; None if the speed is not known yet."""
        plan = self._plan
        seconds, steps = self._elapsed(number)
        if not steps or seconds <= 0:
            return None
        speed = seconds / (plan.work(number) - plan.work(number - steps))
        return speed * (plan.work(plan.iterations) - plan.work(number))

    def forecast(self, number: int) -> str | None:
        """Sentence on the duration of the run and ways to shorten it; once, as soon as it is known."""
        seconds, steps = self._elapsed(number)
        if self._is_forecast or steps < FORECAST_STEPS or seconds < FORECAST_SECONDS:
            return None
        self._is_forecast = True
        return _forecast(self._plan, number, seconds / steps, self.seconds_left(number) or 0.0)

    def _elapsed(self, number: int) -> tuple[float, int]:
        """Seconds and steps since the first recorded step."""
        if not self._samples:
            return 0.0, 0
        since, first = self._samples[0]
        return self._clock() - since, number - first


def _forecast(plan: Plan, number: int, seconds: float, left: float) -> str:
    """The estimate, from the seconds per step and the remaining seconds."""
    later = [
        f"{_format_step_time(seconds * cost / plan.cost(number))} from step {end} on"
        for end, before, cost in zip(plan.ends, plan.costs, plan.costs[1:], strict=False)
        if end >= number and cost != before
    ]
    steps = ", about ".join([f"{_format_step_time(seconds)} a step", *later])
    shorter = f"; {plan.shortcuts}" if plan.shortcuts and left >= LONG_SECONDS else ""
    return f"about {format_duration(left)} for {plan.iterations - number} steps ({steps}){shorter}"


def _format_step_time(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 0.1 else f"{1000 * seconds:.0f} ms"


class TrainingProgress:
    """Displays the messages of a run; a context manager, which closes the bar."""

    def __init__(self, console: Console, plan: Plan, clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._state = console, ProgressState(plan.iterations)
        self._speed = SpeedEstimate(plan, clock)
        self._display: StepBar | StepLines = StepBar(console) if console.is_interactive else StepLines(console, clock)

    def __enter__(self) -> TrainingProgress:
        return self

    def __exit__(self, *exception: object) -> None:
        with suppress(OSError):  # A closed terminal must not hide the error.
            self._display.stop()

    def show(self, message: messages.Message) -> None:
        """Displays a message of the run."""
        state = self._state
        if isinstance(message, messages.RunBegun):
            self._begin(message)
        elif isinstance(message, messages.StageEntered):
            state.stage = message.stage
            self._speed.enter_stage()
            counts = [
                count_noun(number, "pane" if part == "planes" else f"{part} Gaussian")
                for part, number in message.counts.items()
                if number
            ]
            print_line(self._console, f"step {message.step}: stage {', '.join([message.stage, *counts])}")
        elif isinstance(message, messages.ActionDone) and not message.action.startswith(SILENT_ACTIONS):
            print_line(self._console, f"step {message.step}: {message.action}")
        elif isinstance(message, messages.Working):
            self._speed.work()
            self._display.work(state, message)
        elif isinstance(message, messages.CheckpointWritten):
            state.saved_step = message.step
        elif isinstance(message, messages.StepDone):
            state.step = message.step
            state.loss = _smooth_loss(state.loss, message.loss)
            state.count = sum(count for part, count in message.counts.items() if part != "planes")
            self._speed.step(message.step)
            seconds = self._speed.seconds_left(message.step)
            state.time_left = "estimating the remaining time" if seconds is None else f"{format_duration(seconds)} left"
            if forecast := self._speed.forecast(message.step):
                print_line(self._console, forecast)
            self._display.step(state)

    def _begin(self, message: messages.RunBegun) -> None:
        if message.anew:
            print_warning(self._console, "replacing an earlier run in this folder, which was never saved")
        if message.step:
            self._state.step = message.step
            print_line(self._console, f"continuing from step {message.step} of {message.iterations}")


class StepBar:
    """A bar with loss, number of Gaussians, remaining time and, if there is room, the last checkpoint.

    It appears with the first step.
    """

    def __init__(self, console: Console) -> None:
        columns: list[progress.ProgressColumn] = [
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TextColumn("loss {task.fields[loss]:.4f}"),
            progress.TextColumn("{task.fields[count]} Gaussians"),
            progress.TimeElapsedColumn(),
            progress.TextColumn("{task.fields[left]}"),
        ]
        if console.width >= WIDE_TERMINAL:
            columns.append(progress.TextColumn("{task.fields[saved]}"))
        self._bar = progress.Progress(*columns, console=console, refresh_per_second=4)

    def step(self, state: ProgressState) -> None:
        """Shows a step."""
        saved = "" if state.saved_step is None else f"saved at {state.saved_step}"
        fields: dict[str, Any] = {"loss": state.loss, "count": state.count, "left": state.time_left, "saved": saved}
        if not self._bar.task_ids:
            # The speed is that of this session, not of the steps before it.
            self._bar.add_task(state.stage, total=state.iterations, completed=state.step - 1, **fields)
            self._bar.start()
        self._bar.update(self._bar.task_ids[0], description=state.stage, completed=state.step, **fields)

    def work(self, state: ProgressState, work: messages.Working) -> None:
        """Shows the work instead of the stage; before the first step as a line, without a bar."""
        if self._bar.task_ids:
            self._bar.update(self._bar.task_ids[0], description=f"{work.what} {work.done}/{work.total}")
        elif work.done == 0:
            print_line(self._bar.console, work.what)

    def stop(self) -> None:
        """Ends the display."""
        self._bar.stop()


class StepLines:
    """Prints a line every few seconds, for files and logs of job schedulers."""

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._clock = console, clock
        self._interval, self._shown_at = FIRST_INTERVAL, clock()

    def step(self, state: ProgressState) -> None:
        """Prints a step, if a line is due."""
        if not self._is_due():
            return
        saved = "" if state.saved_step is None else f", saved at step {state.saved_step}"
        print_line(
            self._console,
            f"step {state.step} of {state.iterations}: loss {state.loss:.4f}, {state.count} Gaussians, "
            f"{state.time_left}{saved}",
        )

    def work(self, state: ProgressState, work: messages.Working) -> None:
        """Prints the work if a line is due, or if it consists of one part."""
        if work.total == 1:
            print_line(self._console, f"step {state.step}: {work.what}")
        elif self._is_due():
            print_line(self._console, f"step {state.step}: {work.what}, {work.done} of {work.total} done")

    def stop(self) -> None:
        """Does nothing; lines need no cleanup."""

    def _is_due(self) -> bool:
        now = self._clock()
        if now - self._shown_at < self._interval:
            return False
        self._shown_at, self._interval = now, min(2 * self._interval, LONGEST_INTERVAL)
        return True


def format_duration(seconds: float) -> str:
    """A duration, rounded to minutes or seconds."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def _smooth_loss(known: float, loss: float) -> float:
    return SMOOTHING * known + (1 - SMOOTHING) * loss if known else loss


LINE_INTERVAL = 10.0
"""Seconds between two lines on the same work."""


class WorkProgress:
    """Displays the progress of work outside of training; a context manager, which closes the bar."""

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._clock = console, clock
        self._what = ""
        self._begun = self._shown = 0.0
        self._first = 0
        columns = (
            progress.TextColumn("{task.description}", markup=False),
            progress.BarColumn(),
            progress.MofNCompleteColumn(),
            progress.TimeElapsedColumn(),
            progress.TextColumn("left"),
            progress.TimeRemainingColumn(compact=True),
        )
        bar = progress.Progress(*columns, console=console, refresh_per_second=4)
        self._bar = bar if console.is_interactive else None

    def __enter__(self) -> WorkProgress:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bar is not None:
            with suppress(OSError):  # A closed terminal must not hide the error.
                self._bar.stop()

    def show(self, message: messages.Working | Note) -> None:
        """Displays a message."""
        if isinstance(message, Note):
            print_warning(self._console, message.text)
            self._what = ""
        elif self._bar is not None:
            self._show_bar(self._bar, message)
        else:
            self._show_line(message)

    def _show_bar(self, bar: progress.Progress, step: messages.Working) -> None:
        if step.what != self._what:
            for task in bar.task_ids:
                bar.remove_task(task)
            bar.add_task(step.what, total=step.total, completed=step.done)
            self._what = step.what
        bar.update(bar.task_ids[0], completed=step.done)

    def _show_line(self, step: messages.Working) -> None:
        now = self._clock()
        if step.what != self._what:
            self._what, self._begun, self._shown, self._first = step.what, now, now, step.done
            print_line(self._console, f"{step.what} ({step.total})")
        elif now - self._shown >= LINE_INTERVAL:
            self._shown = now
            done, left = step.done - self._first, "estimating the remaining time"
            if done > 0:
                left = f"{format_duration((now - self._begun) / done * (step.total - step.done))} left"
            print_line(self._console, f"{step.what}: {step.done} of {step.total}, {left}")
