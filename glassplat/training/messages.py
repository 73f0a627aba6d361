"""Messages of a run to its consumers: command line, log, viewer, tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class RunBegun:
    """A run starts, or continues from a checkpoint.

    Attributes:
        step: iterations done so far.
        iterations: length of the whole run.
        anew: it replaces a run in the same folder that was never saved.
    """

    step: int
    iterations: int
    anew: bool = False


@dataclass(frozen=True)
class StageEntered:
    """A stage starts; `counts` has the numbers of Gaussians and planes, by scene part."""

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
    """An action edited the state after a step; actions that change nothing send no message."""

    step: int
    action: str
    counts: Mapping[str, int]


@dataclass(frozen=True)
class Working:
    """Progress of long work; between two steps, the state is incomplete and must not be saved.

    Attributes:
        what: description of the work, as a gerund: "fitting planes".
        done: parts that are finished.
        total: number of parts.
    """

    what: str
    done: int
    total: int


@dataclass(frozen=True)
class CheckpointWritten:
    """The run can be resumed from this step."""

    step: int


Message = RunBegun | StageEntered | StepDone | ActionDone | Working | CheckpointWritten
