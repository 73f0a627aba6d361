"""Image metrics, taken on eight-bit sRGB images as everybody stores and compares them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from glassplat.kernels.photometric import photometric


def quantized(image: Tensor) -> Tensor:
    """The image as it would be stored: clamped to [0, 1] and rounded to uint8; uint8 passes through.

    Raises:
        TypeError: the image is neither uint8 nor floating point.
        ValueError: a value is not finite.
    """
    if image.dtype == torch.uint8:
        return image
    if not image.is_floating_point():
        raise TypeError(f"expected a uint8 or floating-point image, got {image.dtype}; convert it first")
    if not bool(torch.isfinite(image).all()):
        raise ValueError("the image holds values that are not finite; expected sRGB in [0, 1]")
    return torch.round(image.detach().clamp(0, 1) * 255).to(torch.uint8)


def psnr(image: Tensor, target: Tensor, region: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in decibels; infinite for equal images.

    Args:
        image: [..., 3] sRGB, uint8 or floating point in [0, 1]; quantised here.
        target: of the same shape.
        region: [...] bool; only these pixels count, with equal weight. None takes all.

    Raises:
        ValueError: shapes disagree, or no pixel counts.
    """
    _check_shapes(image, target)
    difference = quantized(image).to(torch.float64) - quantized(target).to(torch.float64)
    if region is not None:
        if region.dtype != torch.bool or region.shape != image.shape[:-1]:
            raise ValueError(
                f"expected a boolean region of shape {list(image.shape[:-1])}, got {region.dtype} {list(region.shape)}"
            )
        difference = difference[region]
    if difference.numel() == 0:
        raise ValueError("no pixel to compare; give a region that is not empty")
    mean_square = difference.square().mean().item()
    return math.inf if mean_square == 0 else 10 * math.log10(255**2 / mean_square)


def color_corrected(
    image: Tensor, target: Tensor, columns: slice = slice(None), region: Tensor | None = None
) -> Tensor:
    """The image [H, W, 3] in the colours of another, by the affine transform that brings it closest in least squares.

    Exposure and white balance of a photograph that nobody trained on are not known; what is left then is what the
    scene is to blame for.

    Args:
        image: sRGB, uint8 or floating point in [0, 1].
        target: of the same shape.
        columns: of the pixels that the transform is found from.
        region: [H, W] bool, of them those that count; None takes all.
    """
    _check_shapes(image, target)
    source, wanted = (quantized(picture).to(torch.float64) / 255 for picture in (image, target))
    chosen = torch.ones(image.shape[:2], dtype=torch.bool) if region is None else region
    known = source[:, columns][chosen[:, columns]]
    known = torch.cat([known, torch.ones_like(known[:, :1])], dim=1)
    # The identity where the pixels leave the transform open, as those of one colour do.
    rest = wanted[:, columns][chosen[:, columns]] - known[:, :3]
    transform = torch.linalg.solve(known.T @ known + 1e-3 * torch.eye(4, dtype=torch.float64), known.T @ rest)
    return (source + source @ transform[:3] + transform[3]).to(torch.float32)


def ssim(image: Tensor, target: Tensor) -> float:
    """Mean structural similarity of two images [H, W, 3]; Gaussian window 11, sigma 1.5, as 3DGS.

    Raises:
        ValueError: shapes disagree.
    """
    _check_shapes(image, target)
    return float(photometric(quantized(image).to(torch.float32) / 255, quantized(target)).ssim)


def reflection_gain(images: list[Tensor], targets: list[Tensor]) -> float:
    """The one factor on `images` that brings them closest to `targets` in least squares.

    The reflection layer's scale trades off against the strength and the intensity a(u), so it is
    compared up to a factor shared by the whole scene. 1 where the images are black.

    Args:
        images: pixels [P, 3], floating point; one entry per view, of any number of pixels.
        targets: the same shapes.
    """
    pairs = [(a.to(torch.float64), b.to(torch.float64)) for a, b in zip(images, targets, strict=True)]
    power = sum((image.square().sum().item() for image, _ in pairs), 0.0)
    product = sum(((image * target).sum().item() for image, target in pairs), 0.0)
    return product / power if power > 0 else 1.0


def _check_shapes(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape or image.shape[-1] != 3:
        raise ValueError(f"expected two images of one shape [..., 3], got {list(image.shape)} and {list(target.shape)}")
