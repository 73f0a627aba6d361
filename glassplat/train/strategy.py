"""Strategies for the number of primary Gaussians: how they begin, and which edits and loss terms steer them."""

from __future__ import annotations

from dataclasses import dataclass, replace

from glassplat.data.point_cloud import PointCloud
from glassplat.densify.options import DefaultDensify, McmcDensify
from glassplat.init.points import gaussians_from_points
from glassplat.losses.parsimony import mean_opacity, mean_scale, of_all
from glassplat.losses.term import LossTerm, weighted
from glassplat.scene.gaussians import Gaussians
from glassplat.train.actions import Densify, Explore, PruneIdle, Relocate, ResetOpacity
from glassplat.train.averaging import AverageLast
from glassplat.train.rates import Rate
from glassplat.train.rhythm import Rhythm, Strategy
from glassplat.train.stage import Action, Every, Motion


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
