"""A training stage: which renderer, which losses, what learns, and what happens when."""

from __future__ import annotations

import itertools
import math
from collections.abc import Generator, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from glassplat.data.dataset import Dataset
from glassplat.data.errors import InputError
from glassplat.losses.term import LossTerm
from glassplat.render.frame import Renderer
from glassplat.train.messages import Working
from glassplat.train.rates import Rate
from glassplat.train.state import TrainState


@dataclass(frozen=True)
class Clock:
    """Where a run stands.

    Attributes:
        step: iterations done so far, counting the current one.
        iterations: length of the whole run.
        views: number of training views.
    """

    step: int
    iterations: int
    views: int

    @property
    def progress(self) -> float:
        """Share of the run that is done, in [0, 1]."""
        return self.step / self.iterations

    def is_at(self, shares: Iterable[float]) -> bool:
        """Whether this step is one of those that lie at these shares of the run."""
        return self.step in {round(share * self.iterations) for share in shares}


@dataclass(frozen=True)
class Every:
    """A recurring moment, in shares of the run, so that shortening a run keeps its shape.

    Attributes:
        share: distance between two occurrences.
        start, stop: first and last moment at which one may happen; `start` itself is not one.
        least: smallest distance in iterations, below which results suffer however short the run.
        skip_multiples_of: leave out every n-th occurrence (for interleaving two events).
        only_multiples_of: keep every n-th occurrence only.
    """

    share: float
    start: float = 0.0
    stop: float = 1.0
    least: int = 1
    skip_multiples_of: int | None = None
    only_multiples_of: int | None = None

    def interval(self, clock: Clock) -> int:
        """Steps from one multiple to the next."""
        return max(round(self.share * clock.iterations), self.least, 1)

    def due(self, clock: Clock) -> bool:
        """Whether the moment is now."""
        count, remainder = divmod(clock.step, self.interval(clock))
        if remainder or not self.start * clock.iterations < clock.step <= self.stop * clock.iterations:
            return False
        if self.skip_multiples_of and count % self.skip_multiples_of == 0:
            return False
        return not self.only_multiples_of or count % self.only_multiples_of == 0


MOST_TRIED = 1000
"""Lengths that are tried when one is looked for in which every stage has a step."""

Work = Generator[Working, None, bool]
"""An edit that tells how far it is, and whether there was anything to edit in the end."""


def carried_out(edit: Work | bool | None) -> Work:
    """Follows an edit of the state that may tell how far it is, as long ones do, or be done at once."""
    return (yield from edit) if isinstance(edit, Generator) else bool(edit)


class Action(Protocol):
    """An edit of the training state at certain moments (opacity reset, perturbation, SH growth)."""

    @property
    def name(self) -> str:
        """What the log calls it."""
        ...

    def due(self, clock: Clock) -> bool:
        """Whether to act after this step."""
        ...

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> Work | bool:
        """Edits `state`; False where there was nothing to edit. What may take seconds tells how far it is."""
        ...


class Motion(Protocol):
    """A change of values that belongs to every step, like the noise of Langevin dynamics; no message reports it."""

    def __call__(self, state: TrainState, clock: Clock, visible: Tensor | None) -> None:
        """Edits `state`.

        Args:
            state: after the optimiser's step.
            clock: where the run stands.
            visible: [N] bool, which primary Gaussians the step's view showed, also as mirror images; all if None.
        """
        ...


class Entry(Protocol):
    """Prepares the state when a stage begins (fitting planes, adding an environment)."""

    def __call__(self, state: TrainState, dataset: Dataset) -> Work | None:
        """Edits `state`; what may take seconds tells how far it is."""
        ...


@dataclass(frozen=True)
class Stage:
    """One stage of a recipe.

    Attributes:
        name: for the log.
        share: length as a share of the run; a recipe's shares add up to one.
        renderer: what turns the scene into an image.
        losses: terms of the objective.
        rates: learning rate of every parameter that learns; one that is missing is frozen.
        actions: recurring edits, in the order in which they act.
        motions: what follows the optimiser at every step, before the actions.
        entry: what to do once when the stage begins.
        densify_until: share of the run until which screen gradients are collected, for whoever densifies by them.
    """

    name: str
    share: float
    renderer: Renderer
    losses: tuple[LossTerm, ...]
    rates: Mapping[str, Rate]
    actions: tuple[Action, ...] = ()
    motions: tuple[Motion, ...] = ()
    entry: Entry | None = None
    densify_until: float = 0.0


def stage_starts(stages: tuple[Stage, ...], iterations: int) -> list[int]:
    """The first step of each stage, and the end of the run last."""
    total = sum(stage.share for stage in stages)
    starts, passed = [], 0.0
    for stage in stages:
        starts.append(round(passed / total * iterations))
        passed += stage.share
    return [*starts, iterations]


def check_length(stages: tuple[Stage, ...], iterations: int) -> None:
    """Refuse a run in which a stage falls out, because it is too short or the stage has no share of it.

    Raises:
        InputError: names the stage, and how many iterations do.
    """
    missed = missed_stages(stages, iterations)
    if not missed:
        return
    name, share = missed[0].name, missed[0].share / sum(stage.share for stage in stages)
    if share <= 0:
        raise InputError(f"the stage {name!r} has no share of the run, but begins with what the next ones need")
    likely = itertools.islice(itertools.count(max(iterations, math.ceil(0.5 / share))), MOST_TRIED)
    enough = next((length for length in likely if not missed_stages(stages, length)), math.ceil(2 / share))
    raise InputError(f"{iterations} iterations leave no room for the stage {name!r}; expected at least {enough}")


def missed_stages(stages: tuple[Stage, ...], iterations: int) -> list[Stage]:
    """The stages without a single step; one without a share that begins with nothing is meant to have none."""
    starts = stage_starts(stages, iterations)
    spans = zip(stages, starts[:-1], starts[1:], strict=True)
    return [stage for stage, start, end in spans if start >= end and (stage.share > 0 or stage.entry is not None)]
