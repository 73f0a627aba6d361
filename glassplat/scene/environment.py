"""What shiny surfaces mirror from far away: a learnable cube map (3DGS-DR, Section 3.1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

TRAINABLE = ("raw",)
FACES = 6


@dataclass(frozen=True)
class Environment:
    """Light from infinitely far away, one colour for each direction.

    The colour in a world direction d is sigmoid(bilinear(raw, d)): the sigmoid comes after the lookup. Faces and their
    axes are those of `kernels.cube_lookup`.

    Attributes:
        raw: [6, S, S, 3] logits of sRGB colour; S = 0 for a scene without an environment.
        region: centre and radius, world units, of the sphere that holds all that mirrors it; None for everywhere.
    """

    raw: Tensor
    region: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        shape = tuple(self.raw.shape)
        if len(shape) != 4 or shape[0] != FACES or shape[1] != shape[2] or shape[3] != 3:
            raise ValueError(
                f"raw has shape {shape}; expected (6, S, S, 3), six square faces with three colour channels each"
            )

    @property
    def size(self) -> int:
        """Texels along the side of a face, S."""
        return self.raw.shape[1]

    @property
    def is_empty(self) -> bool:
        """Whether there is no environment at all."""
        return self.size == 0

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {name: getattr(self, name) for name in TRAINABLE}

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> Environment:
        """The same environment with its tensors replaced by name."""
        unknown = set(tensors) - set(self.tensors())
        if unknown:
            raise ValueError(f"unknown tensors {sorted(unknown)}; an environment has {sorted(self.tensors())}")
        return replace(self, raw=tensors.get("raw", self.raw))

    def to(self, device: torch.device | str) -> Environment:
        """The same environment on another device."""
        return self.with_tensors({name: tensor.to(device) for name, tensor in self.tensors().items()})

    @staticmethod
    def empty() -> Environment:
        """No environment."""
        return Environment(torch.zeros(FACES, 0, 0, 3))

    @staticmethod
    def random(size: int, *, generator: torch.Generator, spread: float = 5.0) -> Environment:
        """Noise to start training from: raw values uniform in [-spread, spread], on the generator's device.

        Raises:
            ValueError: the size is below 1.
        """
        if size < 1:
            raise ValueError(f"the environment's size is {size}; expected at least 1 texel along a face")
        uniform = torch.rand(FACES, size, size, 3, generator=generator, device=generator.device)
        return Environment((2 * uniform - 1) * spread)
