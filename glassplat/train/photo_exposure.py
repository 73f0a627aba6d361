"""Learning how each photograph was exposed, beside what it shows."""

from __future__ import annotations

from dataclasses import replace

from glassplat.data.dataset import Dataset
from glassplat.losses.exposure import exposure_departure
from glassplat.losses.term import LossTerm, weighted
from glassplat.scene.exposure import Exposures
from glassplat.scene.scene import Scene
from glassplat.train.photograph_options import PhotoExposure
from glassplat.train.rates import Rate
from glassplat.train.stage import Stage


def exposures_begun(options: PhotoExposure, scene: Scene, dataset: Dataset) -> Scene:
    """The first scene, with transforms that change nothing yet."""
    names = tuple(view.name for view in dataset.train)
    return replace(scene, exposures=Exposures.neutral(names)) if options.rate else scene


def exposures_learnt(options: PhotoExposure, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """The stages, in which the transforms learn as well."""
    if not options.rate:
        return stages
    rate = {"exposures.affine": Rate(options.rate, options.rate * options.rate_end)}
    terms = weighted(LossTerm("exposure", options.weight, exposure_departure))
    return tuple(replace(s, rates={**s.rates, **rate}, losses=(*s.losses, *terms)) for s in stages)
