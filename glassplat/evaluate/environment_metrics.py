"""How far a learned environment is from the true one: panoramas in sRGB, z up, row 0 at the top.

How bright an environment is trades off against how strongly surfaces reflect it, so the learned map is first given the
energy of the true one, by one factor (3DGS-DR, Section 4.1). Energy is the mean over the sphere of the sRGB values, in
which 3DGS-DR blends the reflection: there the two trade off exactly.
"""

from __future__ import annotations

import math
from pathlib import Path

import torch
from torch import Tensor

from glassplat.data.errors import input_checked
from glassplat.evaluate.lpips import Lpips
from glassplat.evaluate.metrics import quantized
from glassplat.evaluate.outcome import NO_LPIPS, Outcome
from glassplat.files.environment_image import read_equirect
from glassplat.render.environment import equirect_from_environment
from glassplat.scene.scene import Scene

NO_ENVIRONMENT = "the method learns no environment"
NO_TRUE_ENVIRONMENT = "the data set has no true environment"


PANORAMA_HEIGHT = 64
"""Rows at which environments are compared."""


def learned_environment(scene: Scene) -> Tensor | None:
    """The scene's environment as a panorama [H, 2H, 3]; None where it has none."""
    if scene.environment.is_empty:
        return None
    with torch.no_grad():
        return equirect_from_environment(scene.environment, PANORAMA_HEIGHT).cpu()


def true_environment(capture: Path) -> Tensor | None:
    """The panorama [h, 2h, 3] that a synthetic capture ships as `environment.exr` or `environment.png`, if any.

    Raises:
        InputError: the file is broken.
    """
    for path in (capture / f"environment{suffix}" for suffix in (".exr", ".png")):
        if path.is_file():
            with input_checked():
                return read_equirect(path)
    return None


def environment_metrics(learned: Tensor | None, truth: Tensor | None, lpips: Lpips | str) -> dict[str, Outcome]:
    """`environment_psnr`, `environment_gain` and `environment_lpips` of a scene.

    Args:
        learned: [H, 2H, 3] as in `environment_psnr`; None where the method learns none.
        truth: [h, 2h, 3], or None where it is not known.
        lpips: the distance, or why there is none.
    """
    if learned is None or truth is None:
        reason = NO_ENVIRONMENT if learned is None else NO_TRUE_ENVIRONMENT
        return {"environment_psnr": reason, "environment_gain": reason, "environment_lpips": reason}
    value, gain = environment_psnr(learned, truth)
    return {
        "environment_psnr": value,
        "environment_gain": gain,
        "environment_lpips": environment_lpips(learned, truth, lpips),
    }


def environment_psnr(learned: Tensor, truth: Tensor) -> tuple[float, float]:
    """Peak signal-to-noise ratio over the whole sphere in decibels, and the gain that the learned map was given.

    Directions count by their solid angle. Infinite for equal maps.

    Args:
        learned: [H, 2H, 3] panorama, sRGB, floating point.
        truth: [h, 2h, 3] panorama, floating point or uint8; averaged down where it is larger.

    Raises:
        ValueError: a panorama is not twice as wide as high, or holds values that are not finite.
    """
    image, target, gain = _equalised(learned, truth)
    difference = quantized(image).to(torch.float64) - quantized(target).to(torch.float64)
    mean_square = _mean_over_sphere(difference.square())
    return math.inf if mean_square == 0 else 10 * math.log10(255**2 / mean_square), gain


def environment_lpips(learned: Tensor, truth: Tensor, lpips: Lpips | str) -> Outcome:
    """The perceptual distance of the panoramas as they are seen, not weighted by solid angle (the paper's measure).

    Args:
        learned: as in `environment_psnr`.
        truth: as in `environment_psnr`.
        lpips: the distance, or why there is none.
    """
    if isinstance(lpips, str):
        return NO_LPIPS
    image, target, _ = _equalised(learned, truth)
    return lpips(quantized(image), quantized(target))


def _equalised(learned: Tensor, truth: Tensor) -> tuple[Tensor, Tensor, float]:
    """The learned map at the energy of the true one, the true one at its size, and the factor; 1 for a black map."""
    image, target = _panorama(learned, "learned"), _panorama(truth, "true")
    target = _averaged(target, image.shape[0])
    energy = _mean_over_sphere(image)
    gain = _mean_over_sphere(target) / energy if energy > 0 else 1.0
    return gain * image, target, gain


def _panorama(pixels: Tensor, which: str) -> Tensor:
    """The pixels as float64 in [0, 1], not clamped."""
    if pixels.ndim != 3 or pixels.shape[2] != 3 or not 0 < 2 * pixels.shape[0] == pixels.shape[1]:
        raise ValueError(f"expected the {which} environment as a panorama [H, 2H, 3], got {list(pixels.shape)}")
    values = pixels.detach().cpu().to(torch.float64) / (255 if pixels.dtype == torch.uint8 else 1)
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"the {which} environment holds values that are not finite; expected sRGB in [0, 1]")
    return values


def _averaged(panorama: Tensor, height: int) -> Tensor:
    """A panorama at another height."""
    if panorama.shape[0] == height:
        return panorama
    channels_first = panorama.permute(2, 0, 1)[None]
    return torch.nn.functional.interpolate(channels_first, (height, 2 * height), mode="area")[0].permute(1, 2, 0)


def _mean_over_sphere(values: Tensor) -> float:
    """Mean of [H, 2H, 3] by solid angle: rows shrink towards the poles with the cosine of their latitude."""
    height = values.shape[0]
    latitudes = math.pi * ((torch.arange(height, dtype=torch.float64) + 0.5) / height - 0.5)
    weights = torch.cos(latitudes)
    return float((values.mean(dim=(1, 2)) * weights).sum() / weights.sum())
