"""Learning where the cameras really were, beside what they saw."""

from __future__ import annotations

from dataclasses import dataclass, replace

from glassplat.data.dataset import Dataset
from glassplat.data.ranges import Count, LearningRate, PositiveShare
from glassplat.scene.pose_correction import PoseCorrections
from glassplat.scene.scene import Scene
from glassplat.train.optimizer import Rate
from glassplat.train.stage import Stage


@dataclass(frozen=True)
class PoseRefinement:
    """A small rigid motion of each training camera, by the gradient that the image has to its pose.

    Attributes:
        rate: learning rate at the start, radians and extents; 0 takes the capture's cameras as they are.
        rate_end: that at the end of the run, as a share of `rate`.
        fixed: the first so many photographs keep their cameras, and with them the scene its place.
    """

    rate: LearningRate = 0.0
    rate_end: PositiveShare = 0.1
    fixed: Count = 1

    def begun(self, scene: Scene, dataset: Dataset) -> Scene:
        """The first scene, with all cameras where they are said to be."""
        names = tuple(view.name for view in dataset.train[self.fixed :])
        return replace(scene, poses=PoseCorrections.none(names)) if self.rate else scene

    def learnt_in(self, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
        """The stages, in which the cameras learn as well."""
        if not self.rate:
            return stages
        rate = {"poses.twists": Rate(self.rate, self.rate * self.rate_end)}
        return tuple(replace(stage, rates={**stage.rates, **rate}) for stage in stages)
