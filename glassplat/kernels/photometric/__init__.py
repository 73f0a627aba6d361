"""Difference between an image and a photograph: L1 and structural similarity (Wang et al. 2004), as in 3DGS."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.backend.devices import kernels_for
from glassplat.kernels.records import REAL_OF, check_device


class Photometric(NamedTuple):
    """Means over pixels and channels; scalars.

    Attributes:
        l1: absolute difference, 0 for equal images.
        ssim: structural similarity, within [-1, 1] up to rounding; 1 for equal images.
    """

    l1: Tensor
    ssim: Tensor


def photometric(image: Tensor, target: Tensor) -> Photometric:
    """Mean absolute difference and mean structural similarity of an image and a photograph, in one pass.

    Similarity uses an 11 x 11 Gaussian window with sigma 1.5, zero padding, C1 = 0.01^2 and C2 = 0.03^2. Differentiable
    in `image` only; the derivative of |x - y| is 0 where they are equal.

    Args:
        image: [H, W, 3] in [0, 1], float32 or float64.
        target: [H, W, 3] uint8, the photograph as stored; 255 represents 1.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.shape != target.shape or image.numel() == 0:
        raise ValueError(f"got images {list(image.shape)} and {list(target.shape)}, expected the same [H, W, 3] twice")
    if image.dtype not in REAL_OF or target.dtype != torch.uint8:
        raise TypeError(
            f"got an image of {image.dtype} and a target of {target.dtype}; the image is float32 or float64, "
            "the target uint8"
        )
    check_device("image", image, "image", image)
    check_device("target", target, "image", image)
    return Photometric(*_Photometric.apply(image, target))


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        image, target = image.detach().contiguous(), target.contiguous()
        kernels = kernels_for("photometric", image.device)
        l1, ssim, found = kernels.photometric(image, target, with_gradient=ctx.needs_input_grad[0])
        ctx.save_for_backward(image, target, found)
        return l1, ssim

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_l1: Tensor, v_ssim: Tensor) -> tuple[Tensor, None]:
        kernels = kernels_for("photometric", v_l1.device)
        return kernels.photometric_gradient(*ctx.saved_tensors, v_l1, v_ssim), None
