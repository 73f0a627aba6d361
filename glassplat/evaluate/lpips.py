"""LPIPS, the learned perceptual distance, by torchmetrics where that is installed.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric" (CVPR 2018).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

SMALLEST_SIDE = 32


@dataclass(frozen=True)
class Lpips:
    """The distance with one backbone.

    Attributes:
        network: the distance of two batches [1, 3, H, W] in [0, 1].
        backbone: which network; a value without it means nothing.
    """

    network: Callable[[Tensor, Tensor], Tensor]
    backbone: str = "vgg"

    def __call__(self, image: Tensor, target: Tensor) -> float:
        """The distance of two sRGB images [H, W, 3], uint8 or floating point in [0, 1].

        Images enter the network scaled to [-1, 1], as the authors define it. (3DGS's own script feeds
        [0, 1], so its published numbers differ slightly.)

        Raises:
            ValueError: shapes disagree, or a side is shorter than 32 pixels.
        """
        if image.shape != target.shape or image.ndim != 3 or image.shape[-1] != 3:
            raise ValueError(
                f"expected two images [H, W, 3] of one size, got {list(image.shape)}, {list(target.shape)}"
            )
        if min(image.shape[:2]) < SMALLEST_SIDE:
            raise ValueError(f"LPIPS needs at least {SMALLEST_SIDE} pixels a side, got {list(image.shape[:2])}")
        with torch.no_grad():
            return float(self.network(_batch(image), _batch(target)))


def load_lpips() -> Lpips | str:
    """The distance with the backbone that splatting papers report, or why there is none.

    torchmetrics needs torchvision, which gets the weights of the network when they are first used.
    """
    try:
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        network = LearnedPerceptualImagePatchSimilarity(net_type="vgg", normalize=True)
    except ImportError:
        return "no LPIPS: torchmetrics or torchvision is not installed; install glassplat[lpips]"
    except (OSError, RuntimeError) as error:  # torchvision of another build, or weights that cannot be had.
        return f"no LPIPS: torchmetrics cannot load it: {error}"
    return Lpips(network)


def _batch(image: Tensor) -> Tensor:
    """[1, 3, H, W] in [0, 1]."""
    pixels = image.detach().cpu()
    values = pixels.to(torch.float32) / 255 if pixels.dtype == torch.uint8 else pixels.to(torch.float32).clamp(0, 1)
    return values.permute(2, 0, 1)[None]
