"""Strategies for the number of primary Gaussians: how they begin, and which edits and loss terms steer them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from glassplat.data.capture import PointCloud
from glassplat.data.ranges import PositiveShare, Range, Several, Share
from glassplat.densify.default import DefaultDensify
from glassplat.densify.mcmc import McmcDensify
from glassplat.init.points import gaussians_from_points
from glassplat.losses.parsimony import mean_opacity, mean_scale, of_all
from glassplat.losses.term import LossTerm, weighted
from glassplat.scene.gaussians import Gaussians
from glassplat.train.actions import Densify, Explore, PruneIdle, Relocate, ResetOpacity
from glassplat.train.averaging import AverageLast
from glassplat.train.optimizer import Rate
from glassplat.train.stage import Action, Every, Motion

Strategy = Literal["default", "mcmc"]


@dataclass(frozen=True)
class Rhythm:
    """When opacities are disturbed, when the SH degree grows, and how a run ends.

    Times are shares of the run (3DGS: of 30,000 iterations).

    Every third beat resets the opacities, as in 3DGS; `planar` perturbs them at the other two, so that
    the two never meet (TR-Gaussians, Section III-C3).

    Attributes:
        beat: distance between beats, as a share of the run.
        least: fewest iterations between beats; what a beat disturbs needs as many to recover.
        reset_stop: share of the run after which no reset happens; the `mcmc` strategy has none.
        sh: distance between rises of the SH degree, as a share of the run.
        averaged_passes: passes over the views at the end of the run of which the scene becomes the mean; 0 keeps the
            last step.
    """

    beat: PositiveShare = 1 / 30
    least: Several = 250
    reset_stop: Share = 0.45
    sh: PositiveShare = 1 / 30
    averaged_passes: Annotated[float, Range(0, 1000)] = 1.0


@dataclass(frozen=True)
class Population:
    """What a strategy contributes to every stage of a recipe.

    Attributes:
        opacity: of the first Gaussians.
        spread: standard deviation of the first Gaussians, as a share of the distance to their neighbours.
        edits: what changes the number of primary Gaussians.
        resets: opacity resets; a recipe decides in which stages they happen.
        motions: what follows the optimiser in every step.
        terms: regularisers of the objective.
        densify_until: share of the run until which `edits` read screen gradients.
    """

    opacity: float = 0.1
    spread: float = 1.0
    edits: tuple[Action, ...] = ()
    resets: tuple[ResetOpacity, ...] = ()
    motions: tuple[Motion, ...] = ()
    terms: tuple[LossTerm, ...] = ()
    densify_until: float = 0.0

    def initial(self, points: PointCloud, sh_degree: int) -> Gaussians:
        """The first primary Gaussians, one per point."""
        return gaussians_from_points(points, sh_degree=sh_degree, opacity=self.opacity, spread=self.spread)


def population_of(
    strategy: Strategy, *, default: DefaultDensify, mcmc: McmcDensify, rhythm: Rhythm, means_rate: Rate
) -> Population:
    """What the strategy of this name contributes; the options of the other one are not looked at.

    Args:
        strategy: name on the command line.
        default: options of `default`.
        mcmc: options of `mcmc`.
        rhythm: when opacities are reset, and what is averaged in the end.
        means_rate: learning rate of the positions, which the noise of `mcmc` follows.
    """
    population = mcmc_population(mcmc, means_rate) if strategy == "mcmc" else default_population(default, rhythm)
    if rhythm.averaged_passes == 0:
        return population
    return replace(population, motions=(*population.motions, AverageLast(rhythm.averaged_passes)))


def default_population(densifier: DefaultDensify, rhythm: Rhythm) -> Population:
    """3DGS: clone, split, prune, and reset the opacities; and what adds to no view is removed in the end."""
    reset = ResetOpacity(Every(rhythm.beat, 0.0, rhythm.reset_stop, rhythm.least, only_multiples_of=3))
    edits = (Densify(densifier), PruneIdle(densifier))
    return Population(edits=edits, resets=(reset,), densify_until=densifier.stop)


def mcmc_population(densifier: McmcDensify, means_rate: Rate) -> Population:
    """3DGS-MCMC: relocate, add, explore, and regularise opacities and scales; opacities are never reset.

    The regularisers are those of TR-Gaussians, Eq. 20, which adds them to whatever the objective is otherwise. They
    act on what a step's view shows directly, and the noise on what it shows, also as mirror images. The papers' act on
    everything (`reach`), which hardly differs where every view shows most of the scene; what a few of many views show,
    such as a room photographed all around, fades and wanders.
    """
    everywhere = densifier.reach == "all"
    terms = weighted(
        LossTerm("opacity", densifier.opacity_weight, of_all(mean_opacity) if everywhere else mean_opacity),
        LossTerm("scale", densifier.scale_weight, of_all(mean_scale) if everywhere else mean_scale),
    )
    return Population(
        opacity=densifier.initial_opacity,
        spread=densifier.initial_spread,
        edits=(Relocate(densifier),),
        motions=(Explore(densifier, means_rate),) if densifier.noise_rate != 0 else (),
        terms=terms,
    )
