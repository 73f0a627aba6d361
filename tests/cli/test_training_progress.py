"""Progress of a training, in a terminal and in a file."""

from __future__ import annotations

import io
import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from glassplat.cli import progress as training_progress
from glassplat.cli.main import main
from glassplat.cli.progress import FIRST_INTERVAL, LONGEST_INTERVAL, Plan, TrainingProgress, format_duration
from glassplat.cli.runs import STEP_COSTS, training_plan
from glassplat.cli.train import SCENE, Train
from glassplat.methods.recipe import RECIPES, recipe_of
from glassplat.training.messages import (
    ActionDone,
    CheckpointWritten,
    Message,
    RunBegun,
    StageEntered,
    StepDone,
    Working,
)
from tests.training.tiny_capture import write_tiny_capture

PLAN = Plan((1000,), (1.0,))
COUNTS = {"primary": 1000, "glass": 20, "planes": 1}
BUSY = [Working("searching for unnecessary Gaussians", done, 40) for done in range(40)]


def step(number: int, loss: float = 0.25) -> StepDone:
    return StepDone(number, "1.png", loss, {"photometric": loss}, COUNTS)


class FakeClock:
    """A clock that only moves when a test sets it."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def lines_of(messages: Iterable[Message], seconds: float, plan: Plan = PLAN, **terminal: Any) -> list[str]:
    """Lines written to a file while messages arrive at a fixed interval."""
    clock, file = FakeClock(), io.StringIO()
    with TrainingProgress(Console(file=file, width=40, **terminal), plan, clock) as progress:
        for message in messages:
            progress.show(message)
            clock.now += seconds
    return file.getvalue().splitlines()


def test_lines_come_soon_at_first_and_then_every_few_seconds() -> None:
    lines = lines_of([step(number) for number in range(1, 101)], 0.5)
    shown = [int(line.split()[1]) for line in lines if line.startswith("step")]
    pauses = [0.5 * (later - earlier) for earlier, later in pairwise(shown)]
    assert shown[0] == 1 + FIRST_INTERVAL / 0.5
    assert pauses == [2.0, 4.0, 8.0, *[LONGEST_INTERVAL] * 3]
    left = format_duration((1000 - shown[-1]) / 2)
    assert lines[-1] == f"step {shown[-1]} of 1000: loss 0.2500, 1020 Gaussians, {left} left"


def test_a_terminal_that_redraws_nothing_gets_the_lines_of_a_file() -> None:
    messages = [step(number) for number in range(1, 101)]
    dumb: dict[str, Any] = {"force_terminal": True, "_environ": {"TERM": "dumb"}}
    assert lines_of(messages, 0.5, **dumb) == lines_of(messages, 0.5)


def test_the_time_left_is_that_of_this_session_and_its_last_minute() -> None:
    lines = lines_of([RunBegun(899, 1000), *(step(number) for number in range(900, 1000))], 6.0)
    assert lines[0] == "continuing from step 899 of 1000"
    assert lines[-1].endswith(f"{format_duration(6 * (1000 - int(lines[-1].split()[1])))} left")


def test_work_before_the_first_step_of_a_resumed_run_is_at_its_step() -> None:
    lines = lines_of([RunBegun(899, 1000), Working("fitting planes to the masks", 0, 2)], 1.0)
    assert lines[1].startswith("step 899") and "fitting planes" in lines[1]


def test_every_set_of_gaussians_counts() -> None:
    counts = COUNTS | {"surroundings": 500}
    lines = lines_of([StepDone(number, "1.png", 0.1, {}, counts) for number in range(1, 21)], 1.0)
    assert "1520 Gaussians" in lines[-1]


def test_the_duration_of_a_run_is_printed_once_and_includes_slower_stages() -> None:
    plan = Plan((250, 1000), (1.0, 9.0), "shorter with an NVIDIA GPU")
    steps = [step(number) for number in range(1, 31)]
    forecasts = [line for line in lines_of(steps, 1.0, plan) if line.startswith("about")]
    left = format_duration(250 - 11 + 9 * 750)
    assert forecasts == [
        f"about {left} for 989 steps (1.00 s a step, about 9.00 s from step 250 on); shorter with an NVIDIA GPU"
    ]
    assert lines_of(steps, 0.01, plan) == []
    assert lines_of(steps[:8], 1.0, plan)[-1].startswith("step 8")


def test_a_short_run_needs_no_advice() -> None:
    lines = lines_of([step(number) for number in range(1, 31)], 0.5, Plan((1000,), (1.0,), "shorter with a GPU"))
    assert [line for line in lines if line.startswith("about")] == ["about 8 min for 989 steps (0.50 s a step)"]


def test_the_time_left_of_a_cheap_stage_counts_what_the_next_one_costs() -> None:
    plan = Plan((250, 1000), (1.0, 9.0))
    assert lines_of([step(number) for number in range(1, 31)], 1.0, plan)[-1].endswith(
        f"{format_duration(224 + 6750)} left"
    )
    assert lines_of([step(number) for number in range(900, 931)], 9.0, plan)[-1].endswith(
        f"{format_duration(9 * 70)} left"
    )


def left_after(work: list[Message], seconds: float) -> str:
    """Remaining time shown after steps of half a second, work that takes `seconds`, and further steps."""
    clock, file = FakeClock(), io.StringIO()
    with TrainingProgress(Console(file=file, width=40), PLAN, clock) as progress:
        for number in range(1, 101):
            clock.now += 0.5
            progress.show(step(number))
        for message in work:
            clock.now += seconds / len(work)
            progress.show(message)
        for number in range(101, 125):
            clock.now += 0.5
            progress.show(step(number))
    return file.getvalue().splitlines()[-1].split(", ")[-1]


@pytest.mark.parametrize("work", [[Working("fitting planes", 0, 2)] * 2, [StageEntered(100, "2", COUNTS)]])
def test_long_work_at_the_start_of_a_stage_is_excluded_from_the_speed(work: list[Message]) -> None:
    assert left_after(work, 300.0) == left_after([], 0.0) == "7 min left"


def test_short_work_at_the_start_of_a_stage_is_excluded_from_the_speed() -> None:
    assert left_after([Working("fitting planes", 0, 1), StageEntered(100, "2", COUNTS)], 4.0) == "7 min left"


def test_recurring_work_between_steps_counts_for_the_speed() -> None:
    assert left_after([Working("searching for unnecessary Gaussians", 0, 2)], 4.0) == "8 min left"


@pytest.mark.parametrize("method", RECIPES)
def test_every_method_has_a_plan(method: str, tmp_path: Path) -> None:
    run = Train(recipe_of(method), tmp_path, tmp_path / "run", 30_000, device="cpu")
    plan = training_plan(run)
    assert plan.iterations == 30_000
    assert max(plan.costs) == STEP_COSTS.get(method.title(), 1.0)
    assert "--downscale 2, a quarter of the pixels, or --iterations 7000" in plan.shortcuts
    assert plan.shortcuts.endswith("or an NVIDIA GPU")


def test_long_work_between_steps_is_shown() -> None:
    lines = lines_of([Working("fitting planes to the masks", 0, 1), step(7), *BUSY], 1.0)
    assert lines[0] == "step 0: fitting planes to the masks"
    busy = [line for line in lines if "unnecessary Gaussians" in line]
    assert len(busy) >= 3
    assert all(re.fullmatch(r"step 7: searching for unnecessary Gaussians, \d+ of 40 done", line) for line in busy)


def test_quick_work_between_steps_is_not_shown() -> None:
    assert lines_of([step(1), *BUSY], 0.01) == []


def test_a_checkpoint_is_reported_in_the_next_progress_line() -> None:
    messages: list[Message] = [CheckpointWritten(3), *(step(number) for number in range(4, 10))]
    lines = lines_of(messages, 1.0)
    assert lines
    assert all(line.endswith("left, saved at step 3") or "estimating the remaining" in line for line in lines)


def test_events_are_lines_but_for_frequent_ones_and_those_with_a_log_line() -> None:
    names = ("densify primary", "grow SH", "seed unexplained", "reset opacity")
    actions = [ActionDone(5, name, COUNTS) for name in names]
    lines = lines_of([RunBegun(0, 1000, anew=True), StageEntered(0, "1 [stage]", COUNTS), *actions], 0.0)
    assert lines == [
        "warning: replacing an earlier run in this folder, which was never saved",
        "step 0: stage 1 [stage], 1000 primary Gaussians, 20 glass Gaussians, 1 pane",
        "step 5: reset opacity",
    ]


def terminal(messages: list[Message], error: Exception | None = None) -> str:
    """Output sent to a terminal."""
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=150, color_system=None)
    try:
        with TrainingProgress(console, PLAN) as progress:
            for message in messages:
                progress.show(message)
            if error is not None:
                raise error
    except ValueError:
        pass
    return file.getvalue()


def test_an_error_before_the_first_step_shows_no_progress_bar() -> None:
    shown = terminal([Working("preparing the first scene", 0, 1)], ValueError("broken"))
    assert shown == "preparing the first scene\n"


def test_the_bar_shows_loss_count_work_and_checkpoint() -> None:
    shown = terminal([step(499), CheckpointWritten(499), *BUSY[:13], step(500, 0.5)])
    last = shown.rpartition("\x1b[2K")[2]
    assert all(text in last for text in ("500/1000", "loss 0.2550", "1020 Gaussians", "saved at 499"))
    assert "searching for unnecessary Gaussians 12/40" in terminal([step(499), *BUSY[:13]])


def test_the_reason_for_the_end_of_a_run_survives_a_closed_terminal() -> None:
    class Closed(io.StringIO):
        is_closed = False

        def write(self, text: str) -> int:
            if self.is_closed:
                raise OSError(5, "Input/output error")
            return super().write(text)

    file = Closed()
    with (
        pytest.raises(KeyboardInterrupt),
        TrainingProgress(Console(file=file, force_terminal=True), PLAN) as progress,
    ):
        progress.show(step(1))
        file.is_closed = True
        raise KeyboardInterrupt
    file.is_closed = False


def test_a_training_logged_to_a_file_reports_progress(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(training_progress, "FIRST_INTERVAL", 0.0)
    monkeypatch.setattr(training_progress, "LONGEST_INTERVAL", 0.0)
    capture = write_tiny_capture(tmp_path / "capture")
    options = ["--data", str(capture), "--output", str(tmp_path / "run"), "--iterations", "20"]
    assert main(["train", "splat", *options, "--checkpoint-every", "1e-9"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert re.search(r"step 20 of 20: loss 0\.\d+, \d+ Gaussians, 0 s left, saved at step 19", shown)


@pytest.mark.parametrize("seconds", ["0", "-1", "nan"])
def test_the_distance_of_checkpoints_is_positive(
    seconds: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--data", str(SCENE), "--output", str(tmp_path / "run"), "--checkpoint-every", seconds]
    assert main(["train", "splat", *options]) == 2
    assert "--checkpoint-every is" in capsys.readouterr().err


def test_durations_in_words() -> None:
    assert (format_duration(20), format_duration(90), format_duration(5400)) == ("20 s", "2 min", "1 h 30 min")
