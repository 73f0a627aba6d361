"""How each photograph was exposed: an affine transform of the scene's colours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from glassplat.scene.neighbours import neighbours

TRAINABLE = ("affine",)


@dataclass(frozen=True)
class Exposures:
    """For each photograph what makes its colours of those of the scene: c' = c + A c + b, sRGB.

    Cameras change exposure and white balance from one photograph to the next. In sRGB, a power of the radiance, both
    are nearly factors on the channels.

    Attributes:
        affine: [V, 3, 4] A and b; zero for a photograph in the scene's own colours.
        names: of the V photographs.
    """

    affine: Tensor
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        if tuple(self.affine.shape) != (len(self.names), 3, 4):
            raise ValueError(
                f"affine has shape {list(self.affine.shape)} for {len(self.names)} photographs; expected "
                f"[{len(self.names)}, 3, 4]"
            )

    def __len__(self) -> int:
        """Number of photographs."""
        return len(self.names)

    def of(self, name: str) -> Tensor | None:
        """[3, 4] that of a photograph; None for one that has none, whose colours are the scene's."""
        return self.affine[self.names.index(name)] if name in self.names else None

    def interpolated(self, name: str) -> Exposures:
        """The same with a transform for a photograph that has none: the mean of its neighbours' in the order of names.

        Itself where the photograph has its own, or no neighbours.
        """
        rows = [] if name in self.names else neighbours(name, self.names)
        if not rows:
            return self
        return Exposures(torch.cat([self.affine, self.affine[rows].mean(dim=0, keepdim=True)]), (*self.names, name))

    def applied(self, image: Tensor, name: str) -> Tensor:
        """An image [..., 3] of the scene in the colours of a photograph; differentiable in both."""
        own = self.of(name)
        if own is None:
            return image
        return image @ (torch.eye(3, dtype=image.dtype, device=image.device) + own[:, :3].T) + own[:, 3]

    def undone(self, photo: Tensor, name: str) -> Tensor:
        """A photograph [..., 3] in the colours of the scene: what `applied` would have made the photograph."""
        own = self.of(name)
        if own is None:
            return photo
        own = own.to(photo)
        return (photo - own[:, 3]) @ torch.linalg.inv(torch.eye(3).to(photo) + own[:, :3].T)

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name."""
        return {name: getattr(self, name) for name in TRAINABLE}

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> Exposures:
        """The same with its tensors replaced by name."""
        unknown = set(tensors) - set(TRAINABLE)
        if unknown:
            raise ValueError(f"unknown tensors {sorted(unknown)}; exposures have {sorted(TRAINABLE)}")
        return replace(self, affine=tensors.get("affine", self.affine))

    def to(self, device: torch.device | str) -> Exposures:
        """The same on another device."""
        return self.with_tensors({name: tensor.to(device) for name, tensor in self.tensors().items()})

    @staticmethod
    def neutral(names: tuple[str, ...] = ()) -> Exposures:
        """All photographs in the scene's own colours."""
        return Exposures(torch.zeros(len(names), 3, 4), names)
