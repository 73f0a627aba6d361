"""When normals are propagated, when that ends, and what waits for the end (3DGS-DR, Section 3.3)."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from typing import Literal

import torch

from glassplat.data.dataset import Dataset
from glassplat.data.ranges import Count, Share
from glassplat.densify.propagate import NormalPropagation
from glassplat.render.environment import resized
from glassplat.train.actions import Densify, GrowSh, ResetOpacity
from glassplat.train.stage import Clock, Every
from glassplat.train.state import TrainState

log = logging.getLogger("glassplat.train")

ENDED, MOST, GREW = "propagation ended", "most reflective", "reflective grew"
"""Names in `TrainState.records`: the step of the end, the largest number of reflective Gaussians, and its step."""
GROWTH = 0.01
"""Share of all Gaussians by which the number has to rise to count as growing; a share of the number itself would let
the few that noise makes reflective in a matte scene go on for ever."""


@dataclass(frozen=True)
class PropagationSchedule:
    """When normals are propagated; at the beats of `Rhythm` that do not reset opacities.

    Attributes:
        end: `settled` ends it when the number of reflective Gaussians has stopped growing (the paper's criterion),
            `fixed` at `stop`.
        stop: share of the run after which nothing is propagated any more.
        patience: share of the run without growth after which the number counts as settled.
        pause: steps for which raised opacities are held.
        last_reset: reset opacities once more after the end, if no regular reset comes after it.
    """

    end: Literal["settled", "fixed"] = "settled"
    stop: Share = 0.75
    patience: Share = 0.1
    pause: Count = 100
    last_reset: bool = True


@dataclass(frozen=True)
class Propagate:
    """Propagates normals and disturbs the colours of what does not reflect, until no more reflectors are found.

    Attributes:
        when: the beats at which it happens.
        propagation: what it does.
        schedule: when it ends.
    """

    when: Every
    propagation: NormalPropagation
    schedule: PropagationSchedule
    name: str = "propagate normals"

    def due(self, clock: Clock) -> bool:
        """Whether to act after this step."""
        return self.when.due(clock) or clock.step == self._last(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, until propagation has ended."""
        if has_ended(state):
            return False
        if self._settles(state, clock) or clock.step >= self._last(clock):
            state.records[ENDED] = clock.step
            log.info("step %d: normal propagation has ended, %d reflective Gaussians", clock.step, self._count(state))
            return False
        primary, moments = self.propagation.propagate(state.scene.primary, state.optimizer.moments)
        primary, moments = self.propagation.disturb(primary, moments, state.generator(self.name))
        state.scene, state.optimizer.moments = replace(state.scene, primary=primary), moments
        if self.propagation.propagates:
            state.optimizer.paused["primary.logit_opacities"] = self.schedule.pause
        return True

    def _last(self, clock: Clock) -> int:
        """The step at which it ends at the latest."""
        return round(self.schedule.stop * clock.iterations)

    def _settles(self, state: TrainState, clock: Clock) -> bool:
        """Whether the number of reflective Gaussians has not grown for long enough; keeps the records."""
        count = self._count(state)
        least = GROWTH * len(state.scene.primary)
        if GREW not in state.records or count > state.records[MOST] + least:
            state.records |= {MOST: count, GREW: clock.step}
        waited = clock.step - state.records[GREW]
        return self.schedule.end == "settled" and waited >= self.schedule.patience * clock.iterations

    def _count(self, state: TrainState) -> int:
        return self.propagation.count_reflective(state.scene.primary)


@dataclass(frozen=True)
class GrowShAfterPropagation(GrowSh):
    """Raises the SH degree, but not while normals are propagated: colours that turn with the view would explain
    what reflects.
    """

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, once propagation has ended."""
        return has_ended(state) and super().apply(state, dataset, clock)


@dataclass(frozen=True)
class ResetAfterPropagation(ResetOpacity):
    """Resets opacities once more, if propagation has gone on after the last regular reset.

    Propagation raises every opacity, also of what only stands in the way, as in the hole of a ring. Most of that is
    never lowered again without a reset.

    Attributes:
        when: its moments, of which it takes the first after the end of propagation; they begin after the regular ones.
        regular: moments of the regular resets.
    """

    regular: Every = field(kw_only=True)

    @staticmethod
    def following(reset: ResetOpacity) -> ResetAfterPropagation:
        """The one that comes after regular resets, at the moments at which they would go on."""
        when = replace(reset.when, start=reset.when.stop, stop=1.0)
        return ResetAfterPropagation(when, reset.ceiling, regular=reset.when)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, once, and only if no reset has come since propagation ended."""
        if not has_ended(state):
            return False
        since = range(int(state.records[ENDED]) + 1, clock.step)
        if any(when.due(replace(clock, step=step)) for step in since for when in (self.regular, self.when)):
            return False
        return super().apply(state, dataset, clock)


@dataclass(frozen=True)
class DensifyWhilePropagating(Densify):
    """Densifies at an interval of its own while normals are propagated, and as at any other time once that has ended.

    Attributes:
        regular: what densifies then.
    """

    regular: Densify = field(kw_only=True)

    def due(self, clock: Clock) -> bool:
        """Whether to act after this step, before or after the end."""
        return super().due(clock) or self.regular.due(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, if this is a moment of the interval that holds."""
        turn: Densify = self.regular if has_ended(state) else Densify(self.densifier, self.part)
        return turn.due(clock) and turn.apply(state, dataset, clock)


@dataclass(frozen=True)
class RefineEnvironment:
    """Doubles the environment's texels at certain moments, twice where two fall on one step.

    A normal has a gradient only as far as the texels that its reflection meets reach. Large texels at first let normals
    find their way from farther off; small ones make the reflection sharp in the end.

    Attributes:
        moments: shares of the run.
        largest: texels along a face that are enough.
    """

    moments: tuple[float, ...]
    largest: int
    name: str = "refine environment"

    def due(self, clock: Clock) -> bool:
        """Whether to act after this step."""
        return clock.is_at(self.moments)

    @torch.no_grad()
    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, until the environment is as fine as it gets; the optimiser forgets its moments."""
        environment = state.scene.environment
        if environment.size >= self.largest:
            return False
        doublings = sum(round(moment * clock.iterations) == clock.step for moment in self.moments)
        finer = resized(environment, min(2**doublings * environment.size, self.largest))
        state.scene = replace(state.scene, environment=finer)
        return True


def has_ended(state: TrainState) -> bool:
    """Whether normal propagation is over."""
    return ENDED in state.records
