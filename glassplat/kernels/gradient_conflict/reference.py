"""The definition of `gradient_conflict`: Sobel derivatives of both images, multiplied."""

from __future__ import annotations

from torch import Tensor


def gradient_conflict(transmission: Tensor, reflection: Tensor, hit: Tensor) -> Tensor:
    """See `glassplat.kernels.gradient_conflict.gradient_conflict`."""
    along, across = sobel(transmission), sobel(reflection.detach())
    product = along[0] * across[0] + along[1] * across[1]
    return (product.abs() * hit[1:-1, 1:-1, None]).mean()


def sobel(image: Tensor) -> tuple[Tensor, Tensor]:
    """Horizontal and vertical Sobel derivatives [H-2, W-2, C] of an image [H, W, C], borders left out."""
    across = image[:, 2:] - image[:, :-2]
    down = image[2:] - image[:-2]
    horizontal = across[:-2] + 2 * across[1:-1] + across[2:]
    vertical = down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]
    return horizontal, vertical
