"""Learning curved mirrors where there are panes, beside what the panes do."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from glassplat.data.dataset import Dataset
from glassplat.densify.edit import append, apply_edit, keep
from glassplat.densify.mirrors import neighbours
from glassplat.densify.options import NormalPropagation
from glassplat.densify.outlines import fitted_ellipsoid, mirrored_by, outlines_of, refined_ellipsoid, surface_gaussians
from glassplat.densify.propagate import colors_disturbed, normals_propagated
from glassplat.losses.geometry import normal_consistency
from glassplat.losses.reflectors import mean_strength, strength_outside
from glassplat.losses.term import LossTerm, weighted
from glassplat.render.curved import curved_contributions
from glassplat.render.planar import Planar
from glassplat.render.traced import Traced
from glassplat.scene.activations import logit
from glassplat.scene.gaussians import Gaussians
from glassplat.train.actions import Densify, GrowSh, PruneIdle, ResetOpacity
from glassplat.train.deferred_stages import doublings
from glassplat.train.environment_entry import AddEnvironment
from glassplat.train.messages import Working
from glassplat.train.mirror_options import CurvedMirrors
from glassplat.train.propagation import RefineEnvironment
from glassplat.train.rates import Rate
from glassplat.train.reflection_entry import BeginReflections
from glassplat.train.stage import Clock, Every, Stage, Work, carried_out
from glassplat.train.state import TrainState
from glassplat.train.surroundings_entry import AddSurroundings

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


def with_curved_mirrors(options: CurvedMirrors, planar: Planar) -> Planar:
    """The renderer of the finished scene."""
    return replace(planar, curved=Traced(planar.background, options.least_strength)) if options.learn else planar


def curved_mirrors_learnt(options: CurvedMirrors, stages: tuple[Stage, ...], sh: float) -> tuple[Stage, ...]:
    """The stages: from `start` on things reflect, which divides the last one into up to three.

    Args:
        options: when and how.
        stages: of a run with panes; their renderers show no curved mirrors.
        sh: share of the run between two rises of the degree of the surroundings' colours.
    """
    if not options.learn:
        return stages
    *earlier, last = stages
    began = 1 - last.share / sum(stage.share for stage in stages)
    total = last.share / (1 - began)
    first, spreading = max(options.start, began), max(options.spread_until, options.start, began)
    without = replace(last, share=(first - began) * total)
    reflecting = _reflecting(options, last, sh)
    spread = replace(
        _spreading(options, reflecting),
        name="4 curved mirrors",
        share=(spreading - first) * total,
        entry=_entry(options, last),
    )
    rest = replace(reflecting, name="5 refinement", share=(1 - spreading) * total, entry=None)
    return (*earlier, without, spread, rest)


def _reflecting(options: CurvedMirrors, stage: Stage, sh: float) -> Stage:
    """A stage of `planar` in which things reflect."""
    assert isinstance(stage.renderer, Planar)
    traced = Traced(stage.renderer.background, options.least_strength, faintest=0.0)
    guidance = weighted(
        LossTerm("outside", options.outside_weight, strength_outside),
        LossTerm("strength", options.strength_weight, mean_strength),
    )
    around = options.surroundings.densify
    kept = [action for action in stage.actions if not isinstance(action, ResetOpacity)]
    moments = doublings(options.first_texels, options.texels, options.refinements)
    return replace(
        stage,
        renderer=replace(stage.renderer, curved=traced),
        losses=(*stage.losses, *guidance),
        rates={**slowly_turning(stage.rates), **options.rates.of(), **options.surroundings.rates.of("surroundings")},
        actions=(
            *kept,
            Densify(around, "surroundings"),
            PruneIdle(around, "surroundings", curved_contributions),
            GrowSh(Every(sh), "surroundings"),
            RefineEnvironment(moments, options.texels),
        ),
        densify_until=max(stage.densify_until, around.stop),
    )


def _spreading(options: CurvedMirrors, stage: Stage) -> Stage:
    """A stage in which normals spread."""
    consistency = weighted(LossTerm("consistency", options.consistency_weight, normal_consistency))
    when = Every(options.beat, options.start, options.spread_until)
    spread = SpreadMirrors(when, options.propagation)
    return replace(stage, losses=(*stage.losses, *consistency), actions=(*stage.actions, spread))


def _entry(options: CurvedMirrors, stage: Stage) -> BeginCurved:
    """How things begin to reflect."""
    environment = AddEnvironment(min(options.first_texels, options.texels), options.region, options.find_region)
    around = AddSurroundings(options.surroundings.start, options.surroundings.sh_degree)
    begin = BeginReflections(environment, around, options.search, stage.renderer)
    return BeginCurved(options.first_strength, begin, options.least_overlap)


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
        primary, moments = normals_propagated(self.propagation, primary, moments, near)
        primary, moments = colors_disturbed(self.propagation, primary, moments, state.generator(self.name), near)
        state.scene, state.optimizer.moments = replace(state.scene, primary=primary), moments
        return True


def beside_mirrors(gaussians: Gaussians, strength: float) -> torch.Tensor:
    """[N] bool: Gaussians of which a near neighbour, or they themselves, reflect at least so much."""
    reflects = gaussians.channels["logit_strength"] >= logit(strength)
    return reflects[neighbours(gaussians.means, NEIGHBOURS)].any(dim=1)
