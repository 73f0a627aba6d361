"""Progress of training and other long work: a bar in a terminal, lines now and then elsewhere."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from rich import progress
from rich.console import Console

from glassplat.cli.console import say, warn
from glassplat.prepare.photographs import Note
from glassplat.training import messages

FIRST_PAUSE, LONGEST_PAUSE = 1.0, 10.0
"""Seconds between two lines: at first, so that a newcomer sees that something happens, and in the end."""
SPEED_SECONDS = 60.0
"""How far back the speed is measured from which the time left follows."""
LONG_WORK = 5.0
"""Seconds of work between two steps from which on it is no part of the speed. What begins a stage never is."""
SMOOTHING = 0.98
WIDE = 110
"""Columns of a terminal from which on the last checkpoint has room in the bar."""
FORECAST_STEPS, FORECAST_SECONDS = 10, 5.0
"""After so many steps and seconds the whole run is forecast; the first step, which may compile, does not count."""
LONG_SECONDS = 600.0
"""A run from which on it is worth saying what would make it shorter."""
FREQUENT = ("densify", "grow")
"""Actions of which nobody wants to read each time, by how their names begin."""


@dataclass
class Standing:
    """Progress of a training; `loss` is smoothed, `saved` the step of the last checkpoint, `left` the time left."""

    iterations: int
    step: int = 0
    stage: str = ""
    loss: float = 0.0
    count: int = 0
    saved: int | None = None
    left: str = ""


@dataclass(frozen=True)
class Plan:
    """Lengths and typical costs of a run's stages, known before it begins.

    Attributes:
        ends: last step of each stage.
        costs: typical seconds of a step in each, in any unit; the speed of one stage tells that of the next by them.
        shortcuts: what would make the run shorter, as the end of a sentence; nothing if empty.
    """

    ends: tuple[int, ...]
    costs: tuple[float, ...]
    shortcuts: str = ""

    @property
    def iterations(self) -> int:
        """Length of the run."""
        return self.ends[-1]

    def work(self, step: int) -> float:
        """Work of all steps up to one, in the unit of the costs."""
        total, begin = 0.0, 0
        for end, cost in zip(self.ends, self.costs, strict=True):
            total += cost * max(min(step, end) - begin, 0)
            begin = end
        return total

    def cost(self, step: int) -> float:
        """Cost of a step."""
        return self.work(step) - self.work(step - 1)


class Pace:
    """The speed of this session over its last minute, or since the last long work, and the time left by it."""

    def __init__(self, plan: Plan, clock: Callable[[], float] = time.monotonic) -> None:
        self._plan, self._clock = plan, clock
        self._passed: deque[tuple[float, int]] = deque()
        self._is_forecast = self._has_worked = False
        self._stepped = clock()

    def work(self) -> None:
        """Notes that there is more between two steps than the step."""
        self._has_worked = True

    def enter_stage(self) -> None:
        """Measures the speed anew: what comes before a stage comes once, and its first step may compile."""
        self._passed.clear()

    def step(self, number: int) -> None:
        """Notes a step, now and then."""
        now = self._clock()
        if self._has_worked and now - self._stepped >= LONG_WORK:
            self._passed.clear()
        self._stepped, self._has_worked = now, False
        if not self._passed or now - self._passed[-1][0] >= FIRST_PAUSE:
            self._passed.append((now, number))
        while len(self._passed) > 2 and now - self._passed[1][0] > SPEED_SECONDS:
            self._passed.popleft()

    def seconds_left(self, number: int) -> float | None:
        """Seconds from a step to the end of the run; None where the speed is not known yet."""
        plan = self._plan
        seconds, steps = self._since_first(number)
        if not steps or seconds <= 0:
            return None
        speed = seconds / (plan.work(number) - plan.work(number - steps))
        return speed * (plan.work(plan.iterations) - plan.work(number))

    def forecast(self, number: int) -> str | None:
        """Sentence on the whole run's time and what would make it shorter: once, as soon as it is known."""
        seconds, steps = self._since_first(number)
        if self._is_forecast or steps < FORECAST_STEPS or seconds < FORECAST_SECONDS:
            return None
        self._is_forecast = True
        return _forecast(self._plan, number, seconds / steps, self.seconds_left(number) or 0.0)

    def _since_first(self, number: int) -> tuple[float, int]:
        """Seconds and steps since the first one that is remembered."""
        if not self._passed:
            return 0.0, 0
        since, first = self._passed[0]
        return self._clock() - since, number - first


def _forecast(plan: Plan, number: int, seconds: float, left: float) -> str:
    """The forecast, from the seconds of a step and those left."""
    later = [
        f"{_brief(seconds * cost / plan.cost(number))} from step {end} on"
        for end, before, cost in zip(plan.ends, plan.costs, plan.costs[1:], strict=False)
        if end >= number and cost != before
    ]
    steps = ", about ".join([f"{_brief(seconds)} a step", *later])
    shorter = f"; {plan.shortcuts}" if plan.shortcuts and left >= LONG_SECONDS else ""
    return f"about {in_words(left)} for {plan.iterations - number} steps ({steps}){shorter}"


def _brief(seconds: float) -> str:
    return f"{seconds:.2f} s" if seconds >= 0.1 else f"{1000 * seconds:.0f} ms"


class TrainingProgress:
    """Shows a run's messages; a context, so that a bar ends with the run."""

    def __init__(self, console: Console, plan: Plan, clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._standing = console, Standing(plan.iterations)
        self._pace = Pace(plan, clock)
        self._display: StepBar | StepLines = StepBar(console) if console.is_interactive else StepLines(console, clock)

    def __enter__(self) -> TrainingProgress:
        return self

    def __exit__(self, *exception: object) -> None:
        with suppress(OSError):  # A terminal that was closed must not hide why the run ends.
            self._display.stop()

    def show(self, message: messages.Message) -> None:
        """Follows a run's messages."""
        standing = self._standing
        if isinstance(message, messages.RunBegun):
            self._begin(message)
        elif isinstance(message, messages.StageEntered):
            standing.stage = message.stage
            self._pace.enter_stage()
            counts = ", ".join(f"{number} {name}" for name, number in message.counts.items())
            self._say(f"step {message.step}: stage {message.stage}, {counts}")
        elif isinstance(message, messages.ActionDone) and not message.action.startswith(FREQUENT):
            self._say(f"step {message.step}: {message.action}")
        elif isinstance(message, messages.Working):
            self._pace.work()
            self._display.work(standing, message)
        elif isinstance(message, messages.CheckpointWritten):
            standing.saved = message.step
        elif isinstance(message, messages.StepDone):
            standing.step = message.step
            standing.loss = _smoothed(standing.loss, message.loss)
            standing.count = sum(count for part, count in message.counts.items() if part != "planes")
            self._pace.step(message.step)
            seconds = self._pace.seconds_left(message.step)
            standing.left = "time left is not known yet" if seconds is None else f"{in_words(seconds)} left"
            if forecast := self._pace.forecast(message.step):
                self._say(forecast)
            self._display.step(standing)

    def _begin(self, message: messages.RunBegun) -> None:
        if message.anew:
            warn(self._console, "an earlier run in this folder was begun and never saved; it is replaced")
        if message.step:
            self._standing.step = message.step
            self._say(f"going on from step {message.step} of {message.iterations}")

    def _say(self, text: str) -> None:
        say(self._console, text)


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
        if console.width >= WIDE:
            columns.append(progress.TextColumn("{task.fields[saved]}"))
        self._bar = progress.Progress(*columns, console=console, refresh_per_second=4)
        self._begun = False

    def step(self, standing: Standing) -> None:
        """Shows a step."""
        if not self._begun:
            # The speed is that of this session, not of the steps before it.
            fields = {"loss": standing.loss, "count": standing.count, "left": standing.left, "saved": ""}
            self._bar.add_task(standing.stage, total=standing.iterations, completed=standing.step - 1, **fields)  # type: ignore[arg-type]
            self._bar.start()
            self._begun = True
        saved = "" if standing.saved is None else f"saved at {standing.saved}"
        fields = {"loss": standing.loss, "count": standing.count, "left": standing.left, "saved": saved}
        task = self._bar.task_ids[0]
        self._bar.update(task, description=standing.stage, completed=standing.step, **fields)  # type: ignore[arg-type]

    def work(self, standing: Standing, work: messages.Working) -> None:
        """Shows the work in the stage's place; before the first step a line, as errors stood below an empty bar."""
        if self._begun:
            self._bar.update(self._bar.task_ids[0], description=f"{work.what} {work.done}/{work.total}")
        elif work.done == 0:
            say(self._bar.console, work.what)

    def stop(self) -> None:
        """Ends the display."""
        if self._begun:
            self._bar.stop()


class StepLines:
    """A line every few seconds, which a file or a job scheduler's log can hold."""

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._clock = console, clock
        self._pause, self._shown_at = FIRST_PAUSE, clock()

    def step(self, standing: Standing) -> None:
        """Shows a step, if it is time for a line."""
        if not self._is_time():
            return
        saved = "" if standing.saved is None else f", saved at step {standing.saved}"
        say(
            self._console,
            f"step {standing.step} of {standing.iterations}: loss {standing.loss:.4f}, {standing.count} Gaussians, "
            f"{standing.left}{saved}",
        )

    def work(self, standing: Standing, work: messages.Working) -> None:
        """Shows the work when it is time for a line, or where there will be no other moment for it."""
        if work.total == 1:
            say(self._console, f"step {standing.step}: {work.what}")
        elif self._is_time():
            say(self._console, f"step {standing.step}: {work.what}, {work.done} of {work.total} done")

    def stop(self) -> None:
        """Ends the display; lines need no end."""

    def _is_time(self) -> bool:
        now = self._clock()
        if now - self._shown_at < self._pause:
            return False
        self._shown_at, self._pause = now, min(2 * self._pause, LONGEST_PAUSE)
        return True


def in_words(seconds: float) -> str:
    """A duration as someone who waits would say it."""
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{seconds:.0f} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"


def _smoothed(known: float, loss: float) -> float:
    return SMOOTHING * known + (1 - SMOOTHING) * loss if known else loss


PAUSE = 10.0
"""Seconds between two lines about the same work."""


class WorkProgress:
    """Shows messages of work; a context, so that a bar ends with it."""

    def __init__(self, console: Console, clock: Callable[[], float] = time.monotonic) -> None:
        self._console, self._clock = console, clock
        self._what = ""
        self._begun = self._shown = 0.0
        self._first = 0
        self._bar: progress.Progress | None = None
        self._task: progress.TaskID | None = None

    def __enter__(self) -> WorkProgress:
        if self._console.is_interactive:
            columns = (
                progress.TextColumn("{task.description}", markup=False),
                progress.BarColumn(),
                progress.MofNCompleteColumn(),
            )
            times = (
                progress.TimeElapsedColumn(),
                progress.TextColumn("left"),
                progress.TimeRemainingColumn(compact=True),
            )
            self._bar = progress.Progress(*columns, *times, console=self._console, refresh_per_second=4)
            self._bar.start()
        return self

    def __exit__(self, *exception: object) -> None:
        if self._bar is not None:
            with suppress(OSError):  # A terminal that was closed must not hide why the work ends.
                self._bar.stop()

    def show(self, message: messages.Working | Note) -> None:
        """Follows the work."""
        if isinstance(message, Note):
            warn(self._console, message.text)
            self._what = ""
        elif self._bar is not None:
            self._show_bar(self._bar, message)
        else:
            self._show_line(message)

    def _show_bar(self, bar: progress.Progress, step: messages.Working) -> None:
        if step.what != self._what or self._task is None:
            if self._task is not None:
                bar.remove_task(self._task)
            self._task = bar.add_task(step.what, total=step.total, completed=step.done)
            self._what = step.what
        bar.update(self._task, completed=step.done)

    def _show_line(self, step: messages.Working) -> None:
        now = self._clock()
        if step.what != self._what:
            self._what, self._begun, self._shown, self._first = step.what, now, now, step.done
            say(self._console, f"{step.what} ({step.total})")
        elif now - self._shown >= PAUSE:
            self._shown = now
            done, left = step.done - self._first, "time left is not known yet"
            if done > 0:
                left = f"{in_words((now - self._begun) / done * (step.total - step.done))} left"
            say(self._console, f"{step.what}: {step.done} of {step.total}, {left}")
