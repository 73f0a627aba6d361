"""Coloured points that a scene begins with."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from glassplat.data.capture import RawPoints


@dataclass(frozen=True)
class PointCloud:
    """Coloured points in world space.

    Attributes:
        positions: [P, 3] float32, world units.
        colors: [P, 3] uint8 sRGB.
    """

    positions: Tensor
    colors: Tensor

    def __post_init__(self) -> None:
        expected = (self.positions.shape[0], 3)
        if tuple(self.positions.shape) != expected or tuple(self.colors.shape) != expected:
            raise ValueError(
                f"expected positions and colors of shape [P, 3], got {list(self.positions.shape)} and "
                f"{list(self.colors.shape)}"
            )
        if self.positions.dtype != torch.float32 or self.colors.dtype != torch.uint8:
            raise TypeError(
                f"expected float32 positions and uint8 colors, got {self.positions.dtype}, {self.colors.dtype}"
            )

    def __len__(self) -> int:
        return self.positions.shape[0]

    @staticmethod
    def of(points: RawPoints) -> PointCloud:
        """The points that were read; they share their memory."""
        return PointCloud(torch.from_numpy(points.positions), torch.from_numpy(points.colors))
