"""What a run tells its consumers: command line, log, viewer, tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class StageEntered:
    """A stage begins."""

    step: int
    stage: str
    counts: Mapping[str, int]


@dataclass(frozen=True)
class StepDone:
    """One optimisation step is done; `losses` holds the weighted terms."""

    step: int
    view: str
    loss: float
    losses: Mapping[str, float]
    counts: Mapping[str, int]


@dataclass(frozen=True)
class ActionDone:
    """An action edited the state after a step; one that found nothing to edit says nothing."""

    step: int
    action: str
    counts: Mapping[str, int]


Message = StageEntered | StepDone | ActionDone
