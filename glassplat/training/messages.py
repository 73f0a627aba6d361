"""Messages of a run to its consumers: command line, log, viewer, tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class RunBegun:
    """A run begins, or goes on from a checkpoint.

    Attributes:
        step: iterations done so far.
        iterations: length of the whole run.
        anew: it replaces one in the same folder that was begun and never saved.
    """

    step: int
    iterations: int
    anew: bool = False


@dataclass(frozen=True)
class StageEntered:
    """A stage begins; `counts` says how many Gaussians and planes there are, by scene part."""

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


@dataclass(frozen=True)
class Working:
    """Something takes its time; between two steps the state is in the middle of a change and must not be saved.

    Attributes:
        what: is being done, as a gerund: "fitting planes".
        done: parts that are finished.
        total: parts in all.
    """

    what: str
    done: int
    total: int


@dataclass(frozen=True)
class CheckpointWritten:
    """The run can go on from this step whatever happens."""

    step: int


Message = RunBegun | StageEntered | StepDone | ActionDone | Working | CheckpointWritten
