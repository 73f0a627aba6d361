"""Helpers that train, or carry out an edit of the training state, and collect the messages."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch

from glassplat.captures.dataset import Dataset
from glassplat.training.checkpoint import load_checkpoint, save_checkpoint
from glassplat.training.loop import train
from glassplat.training.messages import Message, StepDone, Working
from glassplat.training.stage import Stage, TrainState, Work, run_edit
from tests.training.tiny_capture import tiny_capture


def followed(edit: Work | bool | None) -> tuple[list[Working], bool]:
    """The progress messages of an edit, and True if there was anything to edit."""
    messages, work = [], run_edit(edit)
    while True:
        try:
            messages.append(next(work))
        except StopIteration as end:
            return messages, end.value


def finished(edit: Work | bool | None) -> bool:
    """True if there was anything to edit."""
    return followed(edit)[1]


def trained(
    state: TrainState,
    stages: tuple[Stage, ...],
    iterations: int,
    *,
    until: int | None = None,
    dataset: Dataset | None = None,
) -> list[Message]:
    """The messages of a run to its end, or until a step is done."""
    messages = []
    for message in train(stages, dataset or tiny_capture(), state, iterations):
        messages.append(message)
        if isinstance(message, StepDone) and message.step == until:
            break
    return messages


def assert_resumes(
    train_until: Callable[[TrainState, int | None], object], begin: Callable[[], TrainState], pause: int, folder: Path
) -> TrainState:
    """Checks that a run ends in the same state if it is saved, loaded and continued after some steps; returns it."""
    whole, interrupted = begin(), begin()
    train_until(whole, None)
    train_until(interrupted, pause)
    save_checkpoint(folder / "checkpoint.safetensors", interrupted)
    resumed = load_checkpoint(folder / "checkpoint.safetensors")
    assert resumed.step == pause
    train_until(resumed, None)
    expected = whole.scene.parameters()
    assert resumed.scene.parameters().keys() == expected.keys() and resumed.records == whole.records
    for name, tensor in resumed.scene.parameters().items():
        assert torch.equal(tensor, expected[name]), name
    return resumed
