"""Learning where the cameras really were, beside what they saw."""

from __future__ import annotations

from dataclasses import replace

from glassplat.data.dataset import Dataset
from glassplat.scene.pose_correction import PoseCorrections
from glassplat.scene.scene import Scene
from glassplat.train.photograph_options import PoseRefinement
from glassplat.train.rates import Rate
from glassplat.train.stage import Stage


def poses_begun(options: PoseRefinement, scene: Scene, dataset: Dataset) -> Scene:
    """The first scene, with all cameras where they are said to be."""
    names = tuple(view.name for view in dataset.train[options.fixed :])
    return replace(scene, poses=PoseCorrections.none(names)) if options.rate else scene


def poses_learnt(options: PoseRefinement, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """The stages, in which the cameras learn as well."""
    if not options.rate:
        return stages
    rate = {"poses.twists": Rate(options.rate, options.rate * options.rate_end)}
    return tuple(replace(stage, rates={**stage.rates, **rate}) for stage in stages)
