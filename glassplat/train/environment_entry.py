"""How the stage begins in which things learn to reflect, with an environment of noise, and what stands in for it."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

from glassplat.data.dataset import Dataset
from glassplat.init.region import reflective_region
from glassplat.scene.environment import Environment
from glassplat.train.state import TrainState

log = logging.getLogger("glassplat.train")

TOO_SHORT = (
    "%d iterations are too few for normals to spread: nothing will reflect, and the run trains like splat, which has "
    "the better picture then. Reflections need %d --iterations; --least-iterations 1 looks for them all the same"
)


@dataclass(frozen=True)
class AddEnvironment:
    """Surrounds the scene with an environment of noise, drawn by the run's seed.

    Attributes:
        texels: along the edge of a face.
        region: centre and radius of the sphere that holds all that may reflect, world units; None for everywhere.
        find_region: without a region, take the place that the cameras stand around, if there is one.
    """

    texels: int
    region: tuple[float, float, float, float] | None = None
    find_region: bool = True

    def __call__(self, state: TrainState, dataset: Dataset) -> None:
        """Edits `state`."""
        environment = Environment.random(self.texels, generator=state.generator("environment"))
        region = self.region
        if region is None and self.find_region:
            region = reflective_region([view.camera for view in dataset.train])
        state.scene = replace(state.scene, environment=replace(environment, region=region))


@dataclass(frozen=True)
class StayMatte:
    """Says that a run is too short for reflections; its scene has an environment all the same, which nothing mirrors.

    Attributes:
        iterations: length of the run.
        least: length of the shortest run in which things learn to reflect.
        environment: adds the environment.
    """

    iterations: int
    least: int
    environment: AddEnvironment

    def __call__(self, state: TrainState, dataset: Dataset) -> None:
        """Edits `state`."""
        log.warning(TOO_SHORT, self.iterations, self.least)
        self.environment(state, dataset)
