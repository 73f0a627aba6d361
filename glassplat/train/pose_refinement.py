"""Learning where the cameras really were, beside what they saw."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from glassplat.data.dataset import Dataset
from glassplat.scene.pose_correction import PoseCorrections
from glassplat.scene.scene import Scene
from glassplat.train.photograph_options import PoseRefinement
from glassplat.train.rates import Rate
from glassplat.train.stage import Clock, Stage
from glassplat.train.state import TrainState


def poses_begun(options: PoseRefinement, scene: Scene, dataset: Dataset) -> Scene:
    """The first scene, with all cameras where they are said to be."""
    names = tuple(view.name for view in dataset.train)
    return replace(scene, poses=PoseCorrections.none(names)) if options.rate else scene


def poses_learnt(options: PoseRefinement, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """The stages, in which the cameras learn as well."""
    if not options.rate:
        return stages
    rate = {"poses.twists": Rate(options.rate, options.rate * options.rate_end)}
    # Before the motions that take means over steps.
    return tuple(replace(s, rates={**s.rates, **rate}, motions=(center_poses, *s.motions)) for s in stages)


def center_poses(state: TrainState, clock: Clock, visible: Tensor | None) -> None:
    """Takes the mean of all motions off each of them, translation and rotation.

    Were all cameras and the scene moved together, training would see no difference, and test cameras stay behind.
    """
    twists = state.scene.poses.twists.detach()
    twists -= twists.mean(dim=0)
