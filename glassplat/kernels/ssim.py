"""Structural similarity of two images (Wang et al. 2004), as 3DGS uses it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.devices import kernels_for
from glassplat.kernels.tensor_checks import check_device


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity over pixels and channels.

    Window of 11 x 11 with a Gaussian of sigma 1.5, zero beyond the border, C1 = 0.01^2, C2 = 0.03^2.
    Differentiable in `image` only.

    Args:
        image: [H, W, 3] in [0, 1], float32 or float64.
        target: [H, W, 3], of the same type in [0, 1], or uint8.

    Returns:
        Scalar in [-1, 1]; 1 for equal images.

    Raises:
        TypeError: a type is not supported, or the images are on different devices or one without kernels.
        ValueError: shapes disagree, or there is no pixel.
    """
    _check_images(image, target)
    mean: Tensor = _Ssim.apply(image, _as_real(target, image))
    return mean


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Structural similarity of each pixel [H, W], mean over channels; arguments as `ssim`, not differentiable."""
    _check_images(image, target)
    image, target = image.detach().contiguous(), _as_real(target, image)
    _, similarity, _ = kernels_for("ssim", image.device).ssim(image, target, with_slopes=False)
    return similarity.mean(dim=-1)


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> Tensor:
        image = image.detach().contiguous()
        kernels = kernels_for("ssim", image.device)
        mean, _, slopes = kernels.ssim(image, target, with_slopes=ctx.needs_input_grad[0])
        ctx.save_for_backward(image, target, slopes)
        return mean

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_mean: Tensor) -> tuple[Tensor, None]:
        image, target, slopes = ctx.saved_tensors
        return kernels_for("ssim", image.device).ssim_gradient(image, target, slopes, v_mean), None


def _as_real(target: Tensor, image: Tensor) -> Tensor:
    target = target.detach().contiguous()
    return target.to(image.dtype) / 255 if target.dtype == torch.uint8 else target


def _check_images(image: Tensor, target: Tensor) -> None:
    if image.ndim != 3 or image.shape[2] != 3 or image.shape != target.shape or image.numel() == 0:
        raise ValueError(f"got images {list(image.shape)} and {list(target.shape)}, expected the same [H, W, 3] twice")
    if image.dtype not in (torch.float32, torch.float64) or target.dtype not in (image.dtype, torch.uint8):
        raise TypeError(
            f"got an image of {image.dtype} and a target of {target.dtype}; the image is float32 or float64, "
            "the target of the same type or uint8"
        )
    check_device("image", image, "image", image)
    check_device("target", target, "image", image)
