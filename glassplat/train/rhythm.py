"""What decides how many Gaussians there are, and when they are disturbed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from glassplat.data.ranges import (
    Internal,
    PositiveShare,
    Range,
    Several,
    Share,
)

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

    beat: Internal[PositiveShare] = 1 / 30
    least: Internal[Several] = 250
    reset_stop: Internal[Share] = 0.45
    sh: Internal[PositiveShare] = 1 / 30
    averaged_passes: Annotated[float, Range(0, 1000)] = 1.0
