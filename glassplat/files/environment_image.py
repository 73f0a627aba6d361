"""Environments as panoramas for people and other programs: OpenEXR and PNG."""

from __future__ import annotations

from os.path import isfile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.files.atomic import atomic_write
from glassplat.files.images import read_image_float, write_image
from glassplat.kernels.maths.color import linear_from_srgb, srgb_from_linear

EXR, PNG = ".exr", ".png"


def read_equirect(path: Path | str) -> Tensor:
    """Reads a panorama, equirectangular with z up, as [H, 2H, 3] float32 sRGB in [0, 1].

    An EXR file holds linear radiance with Rec. 709 primaries, of which what is brighter than white is clipped; a PNG
    file holds sRGB. Where directions lie is said in docs/conventions.md.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another format, cut off, without colour, not twice as wide as high, or a value that is not finite.
    """
    path = Path(path)
    _check_suffix(path)
    if not isfile(path):
        raise FileNotFoundError(f"no panorama at {path}; expected an equirectangular image, {EXR} or {PNG}")
    if path.suffix.lower() == EXR:
        image = srgb_from_linear(torch.from_numpy(_read_exr(path)))
    else:
        image = torch.from_numpy(_color(read_image_float(path), path))
    height, width = image.shape[:2]
    if width != 2 * height:
        raise ValueError(
            f"{path} is {width} x {height} pixels; expected an equirectangular image, twice as wide as high"
        )
    if not bool(torch.isfinite(image).all()):
        raise ValueError(f"{path} holds values that are not finite; expected radiance of at least 0")
    return image.clamp(0, 1)


def write_equirect(path: Path | str, image: Tensor) -> None:
    """Writes a panorama [H, 2H, 3], sRGB in [0, 1], atomically: linear float32 radiance as EXR, sRGB in 8 bits as PNG.

    Raises:
        ValueError: another format, a wrong shape, or a value that is not finite.
        OSError: the file cannot be written; an older one is unchanged.
    """
    path = Path(path)
    _check_suffix(path)
    if image.ndim != 3 or tuple(image.shape[1:]) != (2 * image.shape[0], 3) or image.shape[0] == 0:
        raise ValueError(f"the panorama has shape {tuple(image.shape)}; expected (H, 2 H, 3)")
    if not bool(torch.isfinite(image).all()):
        raise ValueError("the panorama holds values that are not finite; expected sRGB in [0, 1]")
    if path.suffix.lower() == PNG:
        write_image(path, image)
        return
    import OpenEXR  # Only where there are such files.

    radiance = linear_from_srgb(image.detach().cpu().double()).float().contiguous().numpy()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_write(path) as temporary:
        try:
            OpenEXR.File(header, {"RGB": radiance}).write(str(temporary))
        except RuntimeError as error:
            raise OSError(str(error)) from error


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in (EXR, PNG):
        raise ValueError(f"cannot tell the format of the panorama {path}; use the suffix {EXR} or {PNG}")


def _read_exr(path: Path) -> NDArray[np.float32]:
    """Linear radiance [H, W, 3]."""
    import OpenEXR  # As above.

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: channel.pixels for name, channel in file.channels().items()}
    except (RuntimeError, ValueError) as error:
        raise ValueError(f"cannot read {path} as OpenEXR ({error}); replace the file or remove it") from error
    if not {"R", "G", "B"} <= channels.keys():
        raise ValueError(f"{path} has the channels {sorted(channels)}; expected R, G and B")
    return np.stack([channels[name] for name in "RGB"], axis=-1).astype(np.float32)


def _color(pixels: NDArray[np.float32], path: Path) -> NDArray[np.float32]:
    """Pixels without transparency."""
    if pixels.shape[2] < 3:
        raise ValueError(f"{path} is grey; expected a panorama in colour")
    return np.ascontiguousarray(pixels[:, :, :3])
