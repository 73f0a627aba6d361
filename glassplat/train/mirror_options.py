"""What can be said of things that are not flat and mirror: how normals spread, and what there is to be mirrored."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Literal

from glassplat.data.ranges import (
    ESSENTIAL,
    Count,
    InnerShare,
    Internal,
    Range,
    Several,
    Share,
    ShDegree,
)
from glassplat.densify.options import DefaultDensify
from glassplat.train.rates import GaussianRates

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

    end: Internal[Literal["settled", "fixed"]] = "settled"
    stop: Share = 0.75
    patience: Internal[Several] = 5
    pause: Internal[Count] = 100
    last_reset: Internal[bool] = True


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
    per_cell: Internal[Annotated[int, Range(1, 1000)]] = 5
    outside: Internal[Annotated[float, Range(0, 0.45)]] = 0.005
    opacity: Internal[InnerShare] = 0.1


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
    rates: Internal[GaussianRates] = field(default_factory=GaussianRates)
    densify: Internal[DefaultDensify] = field(
        default_factory=partial(
            DefaultDensify, split_by="gradient", stop=0.7, least_contribution=0.02, contribution_moments=(0.8,)
        )
    )
    reset: Internal[Share] = 0.0
