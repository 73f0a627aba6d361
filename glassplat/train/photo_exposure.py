"""Learning how each photograph was exposed, beside what it shows."""

from __future__ import annotations

from dataclasses import dataclass, replace

from glassplat.data.dataset import Dataset
from glassplat.data.ranges import LearningRate, NotNegative, PositiveShare
from glassplat.losses.exposure import exposure_departure
from glassplat.losses.term import LossTerm, weighted
from glassplat.scene.exposure import Exposures
from glassplat.scene.scene import Scene
from glassplat.train.optimizer import Rate
from glassplat.train.stage import Stage


@dataclass(frozen=True)
class PhotoExposure:
    """An affine transform of colours for each photograph (3DGS's public code has one).

    Attributes:
        rate: learning rate at the start; 0 takes all photographs as exposed alike.
        rate_end: that at the end of the run, as a share of `rate`.
        weight: of the departure from the scene's own colours in the objective.
    """

    rate: LearningRate = 0.0
    rate_end: PositiveShare = 0.1
    weight: NotNegative = 0.01

    def begun(self, scene: Scene, dataset: Dataset) -> Scene:
        """The first scene, with transforms that change nothing yet."""
        names = tuple(view.name for view in dataset.train)
        return replace(scene, exposures=Exposures.neutral(names)) if self.rate else scene

    def learnt_in(self, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
        """The stages, in which the transforms learn as well."""
        if not self.rate:
            return stages
        rate = {"exposures.affine": Rate(self.rate, self.rate * self.rate_end)}
        terms = weighted(LossTerm("exposure", self.weight, exposure_departure))
        return tuple(replace(s, rates={**s.rates, **rate}, losses=(*s.losses, *terms)) for s in stages)
