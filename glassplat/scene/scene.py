"""Everything a renderer may draw."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from glassplat.scene.environment import Environment
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import TRAINABLE, Planes


@dataclass(frozen=True)
class Scene:
    """Primary Gaussians, glass Gaussians, reflection planes and the environment.

    Attributes:
        primary: the scene itself, in front of the panes and behind them.
        glass: Gaussians that mark where a pane reflects; they appear in the mask only.
        planes: the panes; empty for a scene without reflection.
        extent: radius of the capture in world units; learning rates and distances scale with it.
        environment: what shiny surfaces mirror from far away; empty for most methods.
    """

    primary: Gaussians
    extent: float
    glass: Gaussians = field(default_factory=lambda: Gaussians.empty(channels=("logit_mark",)))
    planes: Planes = field(default_factory=Planes.empty)
    environment: Environment = field(default_factory=Environment.empty)

    def gaussian_sets(self) -> dict[str, Gaussians]:
        """The sets of Gaussians by name."""
        return {"primary": self.primary, "glass": self.glass}

    def parameters(self) -> dict[str, Tensor]:
        """Every trainable tensor by dotted name (`primary.means`, `planes.centers`, ...).

        The environment (`environment.raw`) is among them where there is one.
        """
        found = {f"{part}.{name}": t for part, g in self.gaussian_sets().items() for name, t in g.tensors().items()}
        found |= {f"planes.{name}": getattr(self.planes, name) for name in TRAINABLE}
        distant = {} if self.environment.is_empty else self.environment.tensors()
        return found | {f"environment.{name}": tensor for name, tensor in distant.items()}

    def with_parameters(self, parameters: Mapping[str, Tensor]) -> Scene:
        """The same scene with some tensors replaced by dotted name."""
        parts: dict[str, dict[str, Tensor]] = {"primary": {}, "glass": {}, "planes": {}, "environment": {}}
        for dotted, tensor in parameters.items():
            part, _, name = dotted.partition(".")
            if part not in parts:
                raise ValueError(f"unknown scene part {part!r} in {dotted!r}; expected one of {sorted(parts)}")
            parts[part][name] = tensor
        return replace(
            self,
            primary=self.primary.with_tensors(parts["primary"]),
            glass=self.glass.with_tensors(parts["glass"]),
            planes=self.planes.with_tensors(parts["planes"]),
            environment=self.environment.with_tensors(parts["environment"]),
        )

    def with_gaussians(self, part: str, gaussians: Gaussians) -> Scene:
        """The same scene with one set of Gaussians replaced."""
        if part == "primary":
            return replace(self, primary=gaussians)
        if part == "glass":
            return replace(self, glass=gaussians)
        raise ValueError(f"unknown set of Gaussians {part!r}; expected one of {sorted(self.gaussian_sets())}")

    def to(self, device: torch.device | str) -> Scene:
        """The same scene on another device."""
        return replace(
            self,
            primary=self.primary.to(device),
            glass=self.glass.to(device),
            planes=self.planes.to(device),
            environment=self.environment.to(device),
        )
