"""Learning how each photograph was exposed, beside what it shows."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from glassplat.data.dataset import Dataset
from glassplat.scene.exposure import Exposures
from glassplat.scene.scene import Scene
from glassplat.train.photograph_options import PhotoExposure
from glassplat.train.rates import Rate
from glassplat.train.stage import Clock, Stage
from glassplat.train.state import TrainState


def exposures_begun(options: PhotoExposure, scene: Scene, dataset: Dataset) -> Scene:
    """The first scene, with transforms that change nothing yet."""
    names = tuple(view.name for view in dataset.train)
    return replace(scene, exposures=Exposures.neutral(names)) if options.rate else scene


def exposures_learnt(options: PhotoExposure, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """The stages, in which the transforms learn as well."""
    if not options.rate:
        return stages
    rate = {"exposures.affine": Rate(options.rate, options.rate * options.rate_end)}
    # Before the motions that take means over steps.
    return tuple(replace(s, rates={**s.rates, **rate}, motions=(center_exposures, *s.motions)) for s in stages)


def center_exposures(state: TrainState, clock: Clock, visible: Tensor | None) -> None:
    """Takes the mean of all transforms off each of them.

    What all photographs have in common belongs to the scene: were it twice as bright and all photographs half as much,
    training would see no difference, and views that nobody photographed would have the wrong colours.
    """
    affine = state.scene.exposures.affine.detach()
    affine -= affine.mean(dim=0)
