"""What can be said of things that are not flat and mirror: how normals spread, and what there is to be mirrored."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Literal

from glassplat.data.ranges import (
    ESSENTIAL,
    Ascending,
    Count,
    Finite,
    InnerShare,
    NotNegative,
    Positive,
    PositiveShare,
    Range,
    Several,
    Share,
    ShDegree,
)
from glassplat.densify.options import DefaultDensify, MirrorSearch, NormalPropagation
from glassplat.train.rates import GaussianRates, ReflectionRates

Texels = Annotated[int, Range(1, 2048)]


@dataclass(frozen=True)
class PropagationSchedule:
    """When normals are propagated: at the beats of `Rhythm`, but for those that reset opacities.

    Attributes:
        end: `settled` ends it when what reflects has stopped growing (the paper's criterion), `fixed` at `stop`.
        stop: share of the run after which nothing is propagated any more.
        patience: beats without growth after which it counts as settled; a strength needs some hundred steps to be seen,
            however short the run. None is needed where nothing reflects nor looks as if it did.
        pause: steps for which raised opacities are held.
        last_reset: after the end, reset opacities only if they have been raised since the last time; if not, regular
            resets go on as if nothing had been propagated.
    """

    end: Literal["settled", "fixed"] = "settled"
    stop: Share = 0.75
    patience: Several = 5
    pause: Count = 100
    last_reset: bool = True


@dataclass(frozen=True)
class SurroundingsStart:
    """What the first surroundings are.

    Attributes:
        source: Gaussians all over the box of the scene (the paper's), or copies of what stands in the scene and does
            not reflect, or both.
        cells: along an edge of the box; None takes as many as suit the photographs, 32 at the most (paper: 32).
        per_cell: Gaussians in each cell.
        outside: share of the points left out of the box at either end of each axis.
        opacity: of those in the box.
    """

    source: Annotated[Literal["box", "scene", "both"], ESSENTIAL] = "scene"
    cells: Annotated[int, Range(1, 256)] | None = None
    per_cell: Annotated[int, Range(1, 1000)] = 5
    outside: Annotated[float, Range(0, 0.45)] = 0.005
    opacity: InnerShare = 0.1


@dataclass(frozen=True)
class SurroundingsOptions:
    """How the surroundings learn.

    Attributes:
        start: what they are at first.
        sh_degree: highest degree of the colours that turn with the ray.
        rates: learning rates.
        densify: when and how Gaussians are added and pruned, by gradients in space times half of the distance.
        reset: share of the run between two resets of their opacities, while they are densified; 0 never resets them.
    """

    start: SurroundingsStart = field(default_factory=SurroundingsStart)
    sh_degree: ShDegree = 1
    rates: GaussianRates = field(default_factory=GaussianRates)
    densify: DefaultDensify = field(
        default_factory=partial(
            DefaultDensify, split_by="gradient", stop=0.7, least_contribution=0.02, contribution_moments=(0.8,)
        )
    )
    reset: Share = 0.0


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

    def contradiction(self) -> str | None:
        """What is wrong with the options together, if anything."""
        if self.learn and self.spread_until <= self.start:
            return (
                f"--curved.spread-until is {self.spread_until} and --curved.start {self.start}; normals spread in "
                "between, so expected --curved.spread-until to be larger"
            )
        return None
