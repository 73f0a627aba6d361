"""What the stored values of one mask file mean: labels of panes, or black and white."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.data.errors import InputError, first_names, input_checked
from glassplat.files.images import SHADES_16, open_image

HIGHEST_LABEL = 64
"""Grey values up to this one are labels when nothing brighter occurs; no one paints masks for the eye that dark."""
THRESHOLD = 128
WHITE = 255
SOFT_SHARE = 0.05
"""Largest share of grey pixels at the edges of a black-and-white mask."""
FEW_SHADES = 4
"""An antialiased edge has more shades of grey than this; fewer are labels somebody meant."""
LOSSY_SUFFIXES = (".jpg", ".jpeg", ".webp")
LOSSY_NOISE = 24
SIXTEEN_TO_EIGHT = 257


@dataclass(frozen=True)
class MaskValues:
    """One understood mask.

    Attributes:
        kind: `labels` for pane labels, `binary` for black (0) and white (1), `empty` for all black.
        pixels: [H, W] uint8.
    """

    kind: Literal["labels", "binary", "empty"]
    pixels: NDArray[np.uint8]


def read_mask_values(path: Path) -> MaskValues:
    """Read one mask file.

    Raises:
        InputError: the file is no image, or its values are neither labels nor black and white.
    """
    shades = _read_shades(path)
    counts = np.bincount(shades.ravel(), minlength=WHITE + 1)
    lossy = path.suffix.lower() in LOSSY_SUFFIXES
    if not lossy and not counts[HIGHEST_LABEL + 1 :].any():
        return MaskValues("labels" if counts[1:].any() else "empty", shades)
    _check_black_and_white(counts, path, lossy)
    pixels = (shades >= THRESHOLD).astype(np.uint8)
    return MaskValues("binary" if pixels.any() else "empty", pixels)


def read_mask_at_threshold(path: Path) -> MaskValues:
    """Read one mask file of a format that is known to split its greys at one half; label images stay as they are.

    Raises:
        InputError: the file is no image.
    """
    shades = _read_shades(path)
    if path.suffix.lower() not in LOSSY_SUFFIXES and not (shades > HIGHEST_LABEL).any():
        return MaskValues("labels" if shades.any() else "empty", shades)
    pixels = (shades >= THRESHOLD).astype(np.uint8)
    return MaskValues("binary" if pixels.any() else "empty", pixels)


def _read_shades(path: Path) -> NDArray[np.uint8]:
    """[H, W] grey values, or the indices of a palette."""
    with input_checked():
        image = open_image(path)
    image.info.pop("transparency", None)  # It says nothing about panes, and Pillow warns of some ways to store it.
    if image.mode == "1" or (image.mode == "P" and not _is_black_and_white(image)):
        return np.array(image).astype(np.uint8)
    if image.mode in SHADES_16:
        return _in_eight_bits(np.array(image), path)
    if image.mode in ("L", "LA", "P"):
        return np.array(image.convert("L"))
    return _one_colour(np.array(image.convert("RGB")), path)


def _in_eight_bits(values: NDArray[np.integer], path: Path) -> NDArray[np.uint8]:
    """Labels as they are, and shades of sixteen bits as those of eight that they stand for."""
    most = int(values.max())
    if most <= WHITE:
        return values.astype(np.uint8)
    if most // SIXTEEN_TO_EIGHT <= HIGHEST_LABEL and (values % SIXTEEN_TO_EIGHT).any():
        raise InputError(
            f"{path} holds the value {most}, which is neither a pane label (0..{HIGHEST_LABEL}) nor white of 16 bits "
            "(65535); write 0 for no pane and 1..K for the panes"
        )
    return (values // SIXTEEN_TO_EIGHT).astype(np.uint8)


def _is_black_and_white(image: Image.Image) -> bool:
    """Whether a palette shows nothing but black and white, so that its colours count and not its indices."""
    colours = {colour for _, colour in image.convert("RGB").getcolors(image.width * image.height) or []}
    return colours <= {(0, 0, 0), (WHITE, WHITE, WHITE)}


def _one_colour(pixels: NDArray[np.uint8], path: Path) -> NDArray[np.uint8]:
    """Grey values of an RGB mask: black against one colour."""
    bright = pixels >= THRESHOLD
    mixtures = np.bincount((bright[..., 0] * 4 + bright[..., 1] * 2 + bright[..., 2]).ravel(), minlength=8)
    if np.count_nonzero(mixtures[1:]) > 1:
        raise InputError(
            f"{path} is painted in several colours; expected a label image (grey, 0 no pane, 1..K the pane)"
        )
    return pixels.max(axis=2)


def _check_black_and_white(counts: NDArray[np.int64], path: Path, lossy: bool) -> None:
    """Refuse greys that could be labels or a photograph; `counts` holds the pixels of each value."""
    tolerance = LOSSY_NOISE if lossy else 0
    grey = counts[tolerance + 1 : WHITE - tolerance]
    few = not lossy and 0 < np.count_nonzero(grey) < FEW_SHADES
    if few or grey.sum() > SOFT_SHARE * counts.sum():
        present = first_names([str(value) for value in np.flatnonzero(counts)])
        raise InputError(
            f"{path} holds the grey values {present}, which are neither pane labels (0..{HIGHEST_LABEL}) nor black and "
            "white (0 and 255); write 0 for no pane and 1..K for the panes"
        )
