"""When normals are propagated, when that ends, and what waits for the end (3DGS-DR, Section 3.3)."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch

from glassplat.data.dataset import Dataset
from glassplat.densify.options import NormalPropagation
from glassplat.densify.propagate import colors_disturbed, normals_propagated
from glassplat.densify.reflectors import Search
from glassplat.render.environment import resized
from glassplat.render.frame import Renderer
from glassplat.train.actions import Densify, GrowSh, ResetOpacity
from glassplat.train.mirror_options import PropagationSchedule
from glassplat.train.rates import Rate
from glassplat.train.stage import Clock, Every
from glassplat.train.state import TrainState

log = logging.getLogger("glassplat.train")

ENDED, MOST, GREW, TURNS = "propagation ended", "most reflective", "reflective grew", "turns with the view"
"""Names in `TrainState.records`: the step of the end, the largest share of reflection, the step of its growth, and the
share that does not reflect, but turns with the view."""
RAISED, LOWERED = "opacities raised", "opacities lowered"
"""The same: the last step at which each was done."""
GROWTH = 0.01
"""By how much the share has to rise to count as growing; a ratio would let the little that noise makes of it in a matte
scene go on for ever."""
FOUND = 0.03
"""Share from which on something reflective has been found."""
LOOKS_REFLECTIVE = 0.16
"""Share that turns with the view, below which propagation would cost more than it finds: two metal eggs with 0.07 lost
1.3 dB by it at 7000 iterations, a mirror ball with 0.30 gained (docs/experiments.md)."""
NOTHING_FOUND = (
    "step %d: little or nothing reflective was found, so that normals are not propagated and the rest of the run "
    "learns as fast as splat; %s"
)
MATTE = (
    "no more than %.0f %% of what is seen looks different from different sides. Should something reflect all the same, "
    "--region X Y Z RADIUS names its place"
)
OVERLOOKED = (
    "but %.0f %% of what is seen looks different from different sides. More --iterations give normals more time to "
    "spread, and --region X Y Z RADIUS names the place where something reflects"
)


@dataclass(frozen=True)
class Propagate:
    """Propagates normals and disturbs the colours of what does not reflect, until no more reflectors are found.

    Where none has been found, the run goes on like one of `splat`, and the log says what may help.

    Attributes:
        when: the beats at which it happens; whether to go on is asked at those that it skips, too.
        propagation: what it does.
        schedule: when it ends.
        renderer: that of the stage; its frames have a layer `base`.
        matte_rates: factors on learning rates after the end where nothing reflective was found, by dotted parameter
            name; of them the value for a run of this length is taken.
        search: what tells how much reflects.
        hurries_found: they count after the end where something was found, too.
    """

    when: Every
    propagation: NormalPropagation
    schedule: PropagationSchedule
    renderer: Renderer
    matte_rates: Mapping[str, Rate] = field(default_factory=dict)
    search: Search = field(default_factory=Search)
    hurries_found: bool = False
    name: str = "propagate normals"

    def due(self, clock: Clock) -> bool:
        """Whether to act after this step."""
        return self._beats.due(clock) or clock.step == self._last(clock)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, until propagation has ended."""
        if has_ended(state):
            return False
        if clock.step < min(self._first(clock), self._last(clock)):
            return False
        if clock.step >= self._last(clock) or self._settles(state, dataset, clock):
            self._end(state, dataset, clock)
            return False
        if not self.when.due(clock):
            return False
        primary, moments = normals_propagated(self.propagation, state.scene.primary, state.optimizer.moments)
        primary, moments = colors_disturbed(self.propagation, primary, moments, state.generator(self.name))
        state.scene, state.optimizer.moments = replace(state.scene, primary=primary), moments
        if self.propagation.propagates:
            state.optimizer.paused["primary.logit_opacities"] = self.schedule.pause
            state.records[RAISED] = clock.step
        return True

    @property
    def _beats(self) -> Every:
        """All of them."""
        return replace(self.when, skip_multiples_of=None)

    def _hurry(self, state: TrainState, clock: Clock) -> None:
        """Learns faster where there is no normal that this would spoil."""
        state.optimizer.hurried = {name: rate.at(0.0, 1.0, clock.iterations) for name, rate in self.matte_rates.items()}

    def _first(self, clock: Clock) -> int:
        """The first beat that is left to a reset.

        Before it, what random points became is still in the way everywhere; made opaque, it hides the surfaces.
        """
        return self.when.interval(clock) * (self.when.skip_multiples_of or 1)

    def _last(self, clock: Clock) -> int:
        """The step at which it ends at the latest."""
        return round(self.schedule.stop * clock.iterations)

    def _settles(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Whether what reflects has not grown for long enough; keeps the records."""
        if self.schedule.end == "fixed":
            return False
        share = self.search.reflective(state.scene, dataset.train)
        if GREW not in state.records or share > state.records[MOST] + GROWTH:
            state.records |= {MOST: share, GREW: clock.step}
        waited = (clock.step - state.records[GREW]) / self.when.interval(clock)
        return waited >= self.schedule.patience or self._looks_matte(state, dataset, clock)

    def _looks_matte(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Whether nothing reflects nor turns with the view; keeps the record.

        That is asked before opacities are raised for the first time, and at the beats after a reset. At others,
        whatever stands in the way turns with the view.
        """
        if state.records[MOST] >= FOUND:
            return False
        if TURNS not in state.records or clock.step % self._first(clock) == self.when.interval(clock):
            state.records[TURNS] = self.search.turning(state.scene, dataset.train, self.renderer)
        return state.records[TURNS] < LOOKS_REFLECTIVE

    def _end(self, state: TrainState, dataset: Dataset, clock: Clock) -> None:
        """Notes the end and says what was found."""
        state.records[ENDED] = clock.step
        share = max(self.search.reflective(state.scene, dataset.train), state.records.get(MOST, 0.0))
        if share < FOUND or self.hurries_found:
            self._hurry(state, clock)
        if share >= FOUND:
            log.info(
                "step %d: normal propagation has ended, %.0f %% of what is seen is reflection", clock.step, 100 * share
            )
            return
        turns = state.records.get(TURNS)
        if turns is None:
            turns = self.search.turning(state.scene, dataset.train, self.renderer)
        log.warning(NOTHING_FOUND, clock.step, (MATTE if turns < LOOKS_REFLECTIVE else OVERLOOKED) % (100 * turns))


@dataclass(frozen=True)
class GrowShAfterPropagation(GrowSh):
    """Raises the SH degree, but not while normals are propagated: colours that turn with the view would explain
    what reflects.
    """

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, once propagation has ended."""
        return has_ended(state) and super().apply(state, dataset, clock)


@dataclass(frozen=True)
class ResetRaised(ResetOpacity):
    """Resets opacities regularly while normals are propagated, and once more afterwards if they have been raised since.

    Propagation raises every opacity, also of what only stands in the way, as in the hole of a ring. Most of that is
    never lowered again without a reset. A scene whose opacities have not come back is worse than one in which something
    stands in the way: the rest of the run has to be as long as the time between two resets.

    Attributes:
        when: its moments, to the end of the run.
        regular: those of them at which resets happen while normals are propagated.
    """

    regular: Every = field(kw_only=True)

    @staticmethod
    def instead_of(reset: ResetOpacity) -> ResetRaised:
        """The one that takes the place of regular resets, at the same moments and those at which they would go on."""
        return ResetRaised(replace(reset.when, stop=1.0), reset.ceiling, regular=reset.when)

    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, where something is to be lowered and there is time to recover."""
        raised = state.records.get(RAISED, 0) > state.records.get(LOWERED, 0)
        wanted = raised if has_ended(state) else self.regular.due(clock)
        if not wanted or clock.step + self._recovery(clock) > clock.iterations:
            return False
        state.records[LOWERED] = clock.step
        return super().apply(state, dataset, clock)

    def _recovery(self, clock: Clock) -> int:
        """Steps in which opacities come back: those between two resets."""
        return self.when.interval(clock) * (self.when.only_multiples_of or 1)


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
