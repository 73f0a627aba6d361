"""Everything a renderer may draw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from glassplat.scene.environment import Environment
from glassplat.scene.exposure import Exposures
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.photographer import Direction
from glassplat.scene.plane import TRAINABLE, Planes
from glassplat.scene.pose_correction import PoseCorrections

GAUSSIAN_SETS = ("primary", "glass", "surroundings", "photographer")
OPTIONAL_SETS = GAUSSIAN_SETS[2:]
"""Those that most scenes have not."""
PARTS = (*GAUSSIAN_SETS, "planes", "environment", "exposures", "poses")
"""Fields of `Scene` that hold tensors."""


@dataclass(frozen=True)
class Scene:
    """Primary Gaussians, glass Gaussians, reflection planes, and what shiny surfaces mirror.

    Attributes:
        primary: the scene itself, in front of the panes and behind them.
        glass: Gaussians that mark where a pane reflects; they appear in the mask only.
        planes: the panes; empty for a scene without reflection.
        extent: radius of the capture in world units; learning rates and distances scale with it.
        environment: what shiny surfaces mirror from far away; empty for most methods.
        surroundings: Gaussians that shiny surfaces mirror from near by, and nothing else shows (EnvGS); empty for most
            methods.
        photographer: Gaussians in the frame of whoever held the camera (`world_from_photographer`), which only panes
            show; empty for most methods.
        up: the direction in which the photographer stands, unit; None where the body leans with the camera.
        exposures: how the photographs were exposed that it was trained on; empty where all are taken as alike.
        poses: how far their cameras are from where they were said to be; empty where they are taken as right.
    """

    primary: Gaussians
    extent: float
    glass: Gaussians = field(default_factory=lambda: Gaussians.empty(channels=("logit_mark",)))
    planes: Planes = field(default_factory=Planes.empty)
    environment: Environment = field(default_factory=Environment.empty)
    surroundings: Gaussians = field(default_factory=Gaussians.empty)
    photographer: Gaussians = field(default_factory=Gaussians.empty)
    up: Direction | None = None
    exposures: Exposures = field(default_factory=Exposures.neutral)
    poses: PoseCorrections = field(default_factory=PoseCorrections.none)

    def gaussian_sets(self) -> dict[str, Gaussians]:
        """The sets of Gaussians by name; surroundings and photographer are among them where there are any."""
        sets = {"primary": self.primary, "glass": self.glass}
        return sets | {name: getattr(self, name) for name in OPTIONAL_SETS if len(getattr(self, name))}

    def parameters(self) -> dict[str, Tensor]:
        """Every trainable tensor by dotted name (`primary.means`, `planes.centers`, ...).

        The environment (`environment.raw`), the exposures and the poses are among them where there are any.
        """
        found = {f"{part}.{name}": t for part, g in self.gaussian_sets().items() for name, t in g.tensors().items()}
        found |= {f"planes.{name}": t for name, t in self.planes.tensors().items() if name in TRAINABLE}
        distant = {} if self.environment.is_empty else self.environment.tensors()
        found |= {f"environment.{name}": tensor for name, tensor in distant.items()}
        exposed = self.exposures.tensors() if len(self.exposures) else {}
        moved = self.poses.tensors() if len(self.poses) else {}
        found |= {f"poses.{name}": tensor for name, tensor in moved.items()}
        return found | {f"exposures.{name}": tensor for name, tensor in exposed.items()}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Scene:
        """The same scene with some tensors replaced by dotted name."""
        parts: dict[str, dict[str, Tensor]] = {name: {} for name in PARTS}
        for dotted, tensor in parameters.items():
            part, _, name = dotted.partition(".")
            if part not in parts:
                raise ValueError(f"unknown scene part {part!r} in {dotted!r}; expected one of {sorted(parts)}")
            parts[part][name] = tensor
        changed: dict[str, Any] = {name: getattr(self, name).with_tensors(parts[name]) for name in PARTS if parts[name]}
        return replace(self, **changed)

    def with_gaussians(self, part: str, gaussians: Gaussians) -> Scene:
        """The same scene with one set of Gaussians replaced."""
        if part not in GAUSSIAN_SETS:
            raise ValueError(f"unknown set of Gaussians {part!r}; expected one of {sorted(GAUSSIAN_SETS)}")
        changed: dict[str, Any] = {part: gaussians}
        return replace(self, **changed)

    def to(self, device: torch.device | str) -> Scene:
        """The same scene on another device."""
        moved: dict[str, Any] = {name: getattr(self, name).to(device) for name in PARTS}
        return replace(self, **moved)
