"""What can be learned of the photographs, beside what they show: exposure, poses, and who took them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from glassplat.data.ranges import (
    Internal,
    LearningRate,
    PositiveShare,
    Range,
    ShDegree,
)
from glassplat.train.rates import GaussianRates


@dataclass(frozen=True)
class PhotoExposure:
    """An affine transform of colours for each photograph (3DGS's public code has one).

    Attributes:
        rate: learning rate at the start; 0 takes all photographs as exposed alike.
        rate_end: that at the end of the run, as a share of `rate`.
    """

    rate: LearningRate = 0.0
    rate_end: Internal[PositiveShare] = 0.1


@dataclass(frozen=True)
class PoseRefinement:
    """A small rigid motion of each training camera, by the gradient that the image has to its pose.

    Attributes:
        rate: learning rate at the start, radians and extents; 0 takes the capture's cameras as they are.
        rate_end: that at the end of the run, as a share of `rate`.
    """

    rate: LearningRate = 0.0
    rate_end: Internal[PositiveShare] = 0.1


@dataclass(frozen=True)
class Photographer:
    """Whether the panes show who took the photographs: Gaussians that the camera carries along.

    Attributes:
        learn: look for one.
        upright: the body stands on the ground however the camera is tilted; if not, it leans with the camera.
        count: Gaussians at first.
        sh_degree: highest degree of their colours.
        rates: learning rates.
    """

    learn: bool = False
    upright: bool = True
    count: Internal[Annotated[int, Range(1, 1_000_000)]] = 500
    sh_degree: Internal[ShDegree] = 0
    rates: Internal[GaussianRates] = field(default_factory=GaussianRates)
