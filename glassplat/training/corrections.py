"""Learning of exposures, of poses and of the photographer."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from glassplat.captures.dataset import Dataset
from glassplat.render.planar import Planar, with_photographer
from glassplat.scene import logit
from glassplat.scene.camera import Camera
from glassplat.scene.corrections import Exposures, PerPhotograph, PoseCorrections, estimate_up
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes, rectangle_offsets
from glassplat.scene.scene import Scene
from glassplat.training.actions import Densify
from glassplat.training.options import DefaultDensify, MethodRecipe, Photographer, Rate
from glassplat.training.stage import Clock, Setup, Stage, TrainState, Work, run_edit

FINAL_RATE_SHARE = 0.1
"""Learning rate at the end of the run, as a share of that at the start."""
CORRECTIONS: dict[str, type[PerPhotograph]] = {"exposures": Exposures, "poses": PoseCorrections}
"""Corrections of photographs, by part of the scene."""


def _correction_rates(recipe: MethodRecipe) -> dict[str, float]:
    """Initial learning rates, by part of the scene, of the corrections that are learned."""
    rates = {"exposures": recipe.exposure.rate, "poses": recipe.poses.rate}
    return {part: rate for part, rate in rates.items() if rate}


def with_neutral_corrections(recipe: MethodRecipe, scene: Scene, dataset: Dataset) -> Scene:
    """The initial scene, with neutral corrections."""
    names = tuple(view.name for view in dataset.train)
    neutral: dict[str, Any] = {part: CORRECTIONS[part].neutral(names) for part in _correction_rates(recipe)}
    return replace(scene, **neutral)


def with_learned_corrections(recipe: MethodRecipe, stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """The stages with learning of the corrections added."""
    for part, start in _correction_rates(recipe).items():
        rate = {f"{part}.{CORRECTIONS[part].TENSOR}": Rate(start, start * FINAL_RATE_SHARE)}
        # Before post-steps that average over steps.
        stages = tuple(replace(s, rates={**s.rates, **rate}, post_steps=(Center(part), *s.post_steps)) for s in stages)
    return stages


@dataclass(frozen=True)
class Center:
    """Subtracts the mean of all corrections from each of them.

    A common factor of all photographs belongs to the scene: a scene twice as bright, with exposures half as large, has
    the same training loss, but wrong colours in novel views. The same holds for a common shift of cameras and scene,
    relative to the test cameras. Of a common rotation, the part about each camera's own centre is subtracted, so that
    the mean orientation is unchanged.

    Attributes:
        part: exposures or poses.
    """

    part: str

    def __call__(self, state: TrainState, clock: Clock, visible: Tensor | None) -> None:
        """Edits `state`."""
        values = getattr(state.scene, self.part).values.detach()
        values -= values.mean(dim=0)


NEAREST, FARTHEST = 0.03, 0.6
"""Distances of the cloud from the camera, as shares of the distance to the panes: the size of a body in the capture's
units is unknown, and the feet are ten times as far from the camera as the head."""
SPREAD = 0.2
"""Standard deviation of each Gaussian, as a share of its distance from the camera."""
OPACITY = 0.05
"""Initial opacity of each Gaussian."""


def initial_photographer(
    planes: Planes, cameras: Sequence[Camera], *, count: int, sh_degree: int, seed: int
) -> Gaussians:
    """A faint grey cloud behind the camera, with constant density in the logarithm of the distance.

    It is in the photographer's frame, with x to the right, y down and z ahead; there has to be a pane.
    """
    generator = torch.Generator().manual_seed(seed)
    distance = distance_to_panes(planes, cameras)
    low, high = math.log(NEAREST * distance), math.log(FARTHEST * distance)
    radii = torch.exp(low + (high - low) * torch.rand(count, generator=generator, dtype=torch.float32))
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator, dtype=torch.float32), dim=1)
    # Behind the camera; near the face, all around it.
    directions[:, 2] = -directions[:, 2].abs()
    device = planes.centers.device
    cloud = Gaussians(
        means=radii[:, None] * directions,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float32).repeat(count, 1),
        log_scales=torch.log(SPREAD * radii)[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), logit(OPACITY), dtype=torch.float32),
        sh=torch.zeros(count, (sh_degree + 1) ** 2, 3, dtype=torch.float32),
        active_sh_degree=0,
    )
    return cloud.to(device)


def distance_to_panes(planes: Planes, cameras: Sequence[Camera]) -> float:
    """The median, over the cameras, of the distance to the nearest rectangle; world units."""
    centers = torch.stack([camera.center for camera in cameras]).to(planes.centers)
    return float(rectangle_offsets(centers, planes).norm(dim=-1).amin(dim=1).median())


PART = "photographer"


@dataclass(frozen=True)
class AddPhotographer:
    """Adds the photographer once there are panes.

    Attributes:
        options: options of the photographer.
        seed: random seed of the initial positions.
        after: the setup that finds the panes, which runs first.
    """

    options: Photographer
    seed: int
    after: Setup | None

    def __call__(self, state: TrainState, dataset: Dataset) -> Work:
        """Edits `state`, and yields its progress."""
        if self.after is not None:
            yield from run_edit(self.after(state, dataset))
        cameras = [view.camera for view in dataset.train]
        photographer = initial_photographer(
            state.scene.planes, cameras, count=self.options.count, sh_degree=self.options.sh_degree, seed=self.seed
        )
        up = estimate_up(cameras) if self.options.upright else None
        state.scene = replace(state.scene, photographer=photographer, up=up)
        return True


def with_learned_photographer(
    options: Photographer, stages: tuple[Stage, ...], densify: DefaultDensify, seed: int
) -> tuple[Stage, ...]:
    """The stages with the photographer rendered and learned in all that have panes."""
    if not options.learn:
        return stages
    first = next(number for number, stage in enumerate(stages) if isinstance(stage.renderer, Planar))
    setup = AddPhotographer(options, seed, after=stages[first].setup)
    learning = [
        replace(
            stage,
            renderer=with_photographer(stage.renderer, "present"),
            rates={**stage.rates, **options.rates.of(PART)},
            actions=(*stage.actions, Densify(densify, part=PART)),
        )
        for stage in stages[first:]
    ]
    return (*stages[:first], replace(learning[0], setup=setup), *learning[1:])
