"""Learning curved mirrors where there are panes, beside what the panes do."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated

import torch

from glassplat.data.dataset import Dataset
from glassplat.data.ranges import ESSENTIAL, Ascending, Finite, InnerShare, NotNegative, Positive, PositiveShare, Share
from glassplat.densify.edit import append, apply_edit, keep
from glassplat.densify.mirrors import MirrorSearch, neighbours
from glassplat.densify.outlines import fitted_ellipsoid, mirrored_by, outlines_of, refined_ellipsoid, surface_gaussians
from glassplat.densify.propagate import NormalPropagation
from glassplat.losses.geometry import normal_consistency
from glassplat.losses.reflectors import mean_strength, strength_outside
from glassplat.losses.term import LossTerm, weighted
from glassplat.render.curved import curved_contributions
from glassplat.render.planar import Planar
from glassplat.render.traced import Traced
from glassplat.scene.activations import logit
from glassplat.scene.gaussians import Gaussians
from glassplat.train.actions import Densify, GrowSh, PruneIdle, ResetOpacity
from glassplat.train.deferred_recipe import ReflectionRates, Texels, doublings
from glassplat.train.environment_entry import AddEnvironment
from glassplat.train.messages import Working
from glassplat.train.optimizer import Rate
from glassplat.train.propagation import RefineEnvironment
from glassplat.train.reflection_entry import BeginReflections
from glassplat.train.stage import Clock, Every, Stage, Work, carried_out
from glassplat.train.state import TrainState
from glassplat.train.surroundings_entry import AddSurroundings
from glassplat.train.traced_recipe import SurroundingsOptions

log = logging.getLogger("glassplat.train")

LEAST_ON_SURFACE = 1500
"""Gaussians that an ellipsoid begins with."""
WITHIN = 0.95
"""Share of its radii within which everything is a part of the picture in the mirror."""
TURNING = 0.05
"""Factor on the learning rate of rotations."""
RESHAPED = "mirrors reshaped"
"""Name in `TrainState.records`: the step at which that happened."""
NEIGHBOURS = 16
"""Gaussians, itself among them, of which one has to be a mirror for normals to spread to another."""


@dataclass(frozen=True)
class CurvedMirrors:
    """Whether things that are not flat mirror what is around them, as those of `traced` do: a silver bowl in a case.

    Attributes:
        learn: look for such things.
        start: share of the run at which they begin to reflect; panes have to be known by then, and what they reflect
            nearly so, or it would be taken for theirs.
        spread_until: share of the run until which normals spread over what is beside a mirror.
        beat: distance between two such moments, as a share of the run.
        least_strength: rays are traced where the strength is larger.
        first_strength: of what was not taken for a mirror.
        search: what is taken for a mirror at once.
        least_overlap: how well the outlines of what was found have to be those of an ellipsoid, pixels in both as a
            share of those in either, for it to begin as that; 1 never lets it.
        surroundings: how the Gaussians learn that reflections show.
        texels: edge length of a face of the environment behind them in the end.
        first_texels: edge length at the start.
        refinements: shares of the run at which it doubles for the first and for the last time.
        region: only what lies in this sphere may reflect: centre and radius, world units.
        find_region: without one, look for the place that the cameras stand around.
        outside_weight: of the mean strength outside of the region in the objective.
        strength_weight: of the mean strength of all Gaussians.
        consistency_weight: of the difference between normals and the slope of the depths, while normals spread.
        propagation: how normals spread.
        rates: learning rates of strength and environment.
    """

    learn: Annotated[bool, ESSENTIAL] = False
    start: PositiveShare = 0.37
    spread_until: Share = 0.65
    beat: PositiveShare = 0.0214
    least_strength: Share = 0.02
    first_strength: InnerShare = 1e-3
    search: MirrorSearch = field(default_factory=partial(MirrorSearch, views=200))
    least_overlap: Share = 0.6
    surroundings: SurroundingsOptions = field(default_factory=SurroundingsOptions)
    texels: Texels = 64
    first_texels: Texels = 16
    refinements: Annotated[tuple[Share, Share], Ascending()] = (0.5, 0.7)
    region: tuple[Finite, Finite, Finite, Positive] | None = None
    find_region: bool = True
    outside_weight: NotNegative = 0.4
    strength_weight: NotNegative = 0.005
    consistency_weight: NotNegative = 0.3
    propagation: NormalPropagation = field(default_factory=NormalPropagation)
    rates: ReflectionRates = field(default_factory=ReflectionRates)

    def renderer(self, planar: Planar) -> Planar:
        """The renderer of the finished scene."""
        return replace(planar, curved=Traced(planar.background, self.least_strength)) if self.learn else planar

    def learnt_in(self, stages: tuple[Stage, ...], sh: float) -> tuple[Stage, ...]:
        """The stages: from `start` on things reflect, which divides the last one into up to three.

        Args:
            stages: of a run with panes; their renderers show no curved mirrors.
            sh: share of the run between two rises of the degree of the surroundings' colours.
        """
        if not self.learn:
            return stages
        *earlier, last = stages
        began = 1 - last.share / sum(stage.share for stage in stages)
        total = last.share / (1 - began)
        first, spreading = max(self.start, began), max(self.spread_until, self.start, began)
        without = replace(last, share=(first - began) * total)
        reflecting = self._reflecting(last, sh)
        spread = replace(
            self._spreading(reflecting),
            name="4 curved mirrors",
            share=(spreading - first) * total,
            entry=self._entry(last),
        )
        rest = replace(reflecting, name="5 refinement", share=(1 - spreading) * total, entry=None)
        return (*earlier, without, spread, rest)

    def contradiction(self) -> str | None:
        """What is wrong with the options together, if anything."""
        if self.learn and self.spread_until <= self.start:
            return (
                f"--curved.spread-until is {self.spread_until} and --curved.start {self.start}; normals spread in "
                "between, so expected --curved.spread-until to be larger"
            )
        return None

    def _reflecting(self, stage: Stage, sh: float) -> Stage:
        """A stage of `planar` in which things reflect."""
        assert isinstance(stage.renderer, Planar)
        traced = Traced(stage.renderer.background, self.least_strength, faintest=0.0)
        guidance = weighted(
            LossTerm("outside", self.outside_weight, strength_outside),
            LossTerm("strength", self.strength_weight, mean_strength),
        )
        around = self.surroundings.densify
        kept = [action for action in stage.actions if not isinstance(action, ResetOpacity)]
        moments = doublings(self.first_texels, self.texels, self.refinements)
        return replace(
            stage,
            renderer=replace(stage.renderer, curved=traced),
            losses=(*stage.losses, *guidance),
            rates={**slowly_turning(stage.rates), **self.rates.of(), **self.surroundings.rates.of("surroundings")},
            actions=(
                *kept,
                Densify(around, "surroundings"),
                PruneIdle(around, "surroundings", curved_contributions),
                GrowSh(Every(sh), "surroundings"),
                RefineEnvironment(moments, self.texels),
            ),
            densify_until=max(stage.densify_until, around.stop),
        )

    def _spreading(self, stage: Stage) -> Stage:
        """A stage in which normals spread."""
        consistency = weighted(LossTerm("consistency", self.consistency_weight, normal_consistency))
        when = Every(self.beat, self.start, self.spread_until)
        spread = SpreadMirrors(when, self.propagation)
        return replace(stage, losses=(*stage.losses, *consistency), actions=(*stage.actions, spread))

    def _entry(self, stage: Stage) -> BeginCurved:
        """How things begin to reflect."""
        environment = AddEnvironment(min(self.first_texels, self.texels), self.region, self.find_region)
        around = AddSurroundings(self.surroundings.start, self.surroundings.sh_degree)
        begin = BeginReflections(environment, around, self.search, stage.renderer)
        return BeginCurved(self.first_strength, begin, self.least_overlap)


def slowly_turning(rates: Mapping[str, Rate]) -> dict[str, Rate]:
    """The rates of a scene in which things reflect: at the usual ones single normals lose their way at once."""
    turning = rates["primary.quats"]
    return {**rates, "primary.quats": replace(turning, start=TURNING * turning.start)}


@dataclass(frozen=True)
class BeginCurved:
    """Lets the scene's things reflect, and takes for mirrors what looks like them.

    Attributes:
        strength: of reflections, at first.
        begin: adds what is mirrored, and finds mirrors.
        least_overlap: see `CurvedMirrors`.
    """

    strength: float
    begin: BeginReflections
    least_overlap: float = 1.0

    def __call__(self, state: TrainState, dataset: Dataset) -> Work:
        """Edits `state`, and tells how far it is."""
        primary = state.scene.primary
        strengths = torch.full_like(primary.logit_opacities, logit(self.strength))
        primary = replace(primary, channels={**primary.channels, "logit_strength": strengths})
        state.scene = replace(state.scene, primary=primary)
        yield from carried_out(self.begin(state, dataset))
        found = int((state.scene.primary.channels["logit_strength"] > logit(0.5)).sum())
        log.info("%d of %d Gaussians look like curved mirrors", found, len(primary))
        if found and self.least_overlap < 1:
            yield Working("looking for the outlines of mirrors", 0, 1)
            self._reshape(state, dataset)
        return True

    @torch.no_grad()
    def _reshape(self, state: TrainState, dataset: Dataset) -> None:
        """Puts what was found onto the ellipsoid that its outlines describe, if they describe one."""
        scene = state.scene
        chosen = scene.primary.channels["logit_strength"] > logit(0.5)
        outlines = outlines_of(scene, dataset.train, chosen)
        if not len(outlines.inside):
            return
        like = scene.primary.select(chosen)
        ellipsoid = fitted_ellipsoid(outlines, like.means, state.generator("outlines"))
        overlap = ellipsoid.overlap(outlines)
        log.info("its outlines are those of an ellipsoid to %.0f %%", 100 * overlap)
        if overlap < self.least_overlap:
            return
        mirrored = mirrored_by(scene, dataset.train, chosen, self.begin.renderer)
        ellipsoid = refined_ellipsoid(ellipsoid, outlines, mirrored, scene, state.generator("reflections"))
        log.info("mirrored, they make it %.3f x %.3f x %.3f world units", *torch.exp(ellipsoid.log_radii).tolist())
        count = max(int(chosen.sum()), LEAST_ON_SURFACE)
        inside = ellipsoid.in_units(scene.primary.means - ellipsoid.center).norm(dim=1) < WITHIN
        primary, moments = apply_edit(scene.primary, state.optimizer.moments, keep(~(chosen | inside)))
        primary, state.optimizer.moments = append(primary, moments, surface_gaussians(like, ellipsoid, count))
        state.scene = replace(scene, primary=primary)
        state.statistics.pop("primary", None)
        state.records[RESHAPED] = state.step


@dataclass(frozen=True)
class SpreadMirrors:
    """Spreads normals over what is beside a mirror, and disturbs the colours of what does not reflect there.

    `deferred` and `traced` do so all over the scene. Here that would make opaque again what was found to be but a
    reflection of a pane.

    Attributes:
        when: the moments.
        propagation: what it does.
    """

    when: Every
    propagation: NormalPropagation
    name: str = "propagate normals"

    def due(self, clock: Clock) -> bool:
        """Whether to act after this step."""
        return self.when.due(clock)

    @torch.no_grad()
    def apply(self, state: TrainState, dataset: Dataset, clock: Clock) -> bool:
        """Edits `state`, if there is a mirror."""
        primary, moments = state.scene.primary, state.optimizer.moments
        near = beside_mirrors(primary, self.propagation.reflective)
        # What has got the right shape needs no normals from its neighbours.
        if RESHAPED in state.records or not bool(near.any()):
            return False
        primary, moments = self.propagation.propagate(primary, moments, near)
        primary, moments = self.propagation.disturb(primary, moments, state.generator(self.name), near)
        state.scene, state.optimizer.moments = replace(state.scene, primary=primary), moments
        return True


def beside_mirrors(gaussians: Gaussians, strength: float) -> torch.Tensor:
    """[N] bool: Gaussians of which a near neighbour, or they themselves, reflect at least so much."""
    reflects = gaussians.channels["logit_strength"] >= logit(strength)
    return reflects[neighbours(gaussians.means, NEIGHBOURS)].any(dim=1)
