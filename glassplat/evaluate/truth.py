"""Ground truth that ships with synthetic scenes: layers of the test views, and the panes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from glassplat.data.errors import InputError, input_checked
from glassplat.files.fields import COORDINATE, Field, Flag, Items, Number, Whole, checked, shown
from glassplat.files.images import read_image, read_image_float
from glassplat.files.json_text import read_json


@dataclass(frozen=True)
class TrueView:
    """The true layers of one test view.

    Attributes:
        transmission: [H, W, 3] uint8 sRGB, what the view shows without the panes.
        reflection: [H, W, 3] uint8 sRGB, what the panes reflect, at full strength.
        strength: [H, W] float32, true Fresnel strength in [0, 1].
        labels: [H, W] uint8, pane label of pixels that a pane covers fully, else 0.
    """

    transmission: Tensor
    reflection: Tensor
    strength: Tensor
    labels: Tensor


@dataclass(frozen=True)
class TruePlane:
    """A pane as it really is; vectors in world units, reflectance at normal incidence."""

    label: int
    center: tuple[float, ...]
    normal: tuple[float, ...]
    half_u: tuple[float, ...]
    half_v: tuple[float, ...]
    mirror: bool
    base_reflectance: float


VECTOR = Items(COORDINATE, 3)
TRUE_PLANE: dict[str, Field] = {
    "label": Whole(1, 255),
    **dict.fromkeys(("center", "normal", "half_u", "half_v"), VECTOR),
    "mirror": Flag(),
    "base_reflectance": Number(0, 1),
}


@dataclass(frozen=True)
class GroundTruth:
    """The folder `gt/` of a scene; views are read when asked for."""

    folder: Path
    planes: tuple[TruePlane, ...]

    def view(self, image_name: str, width: int, height: int) -> TrueView | None:
        """The true layers for a photograph, averaged down to the given size.

        Args:
            image_name: the photograph's name; its stem names the files.
            width: of the rendered view, pixels.
            height: of the rendered view, pixels.

        Returns:
            None where the folder holds nothing for this view.

        Raises:
            InputError: only some of the view's files are there, or a file is broken.
        """
        stem = Path(image_name).stem
        paths = {
            "transmission": self.folder / "trans" / f"{stem}.png",
            "reflection": self.folder / "refl" / f"{stem}.png",
            "strength": self.folder / "strength" / f"{stem}.png",
            "labels": self.folder / "strength" / f"{stem}_pane.png",
        }
        missing = [str(path) for path in paths.values() if not path.is_file()]
        if len(missing) == len(paths):
            return None
        if missing:
            raise InputError(
                f"ground truth for {image_name} is incomplete: {', '.join(missing)} missing; add or remove all"
            )
        size = (width, height)
        with input_checked():
            return TrueView(
                transmission=torch.from_numpy(_resized_color(read_image(paths["transmission"]), size)),
                reflection=torch.from_numpy(_resized_color(read_image(paths["reflection"]), size)),
                strength=torch.from_numpy(resized_float(read_image_float(paths["strength"])[..., 0], size)),
                labels=torch.from_numpy(_resized_labels(read_image(paths["labels"])[..., 0], size)),
            )


def load_truth(folder: Path | None) -> GroundTruth | None:
    """Opens a data set's folder of known layers and panes; None for None.

    Raises:
        InputError: its `planes.json` cannot be understood.
    """
    if folder is None:
        return None
    path = folder / "planes.json"
    if not path.is_file():
        return GroundTruth(folder, ())
    with input_checked():
        entries = read_json(path)
        if not isinstance(entries, list):
            raise ValueError(f"{path} holds {shown(entries)}; expected a list with one object per plane")
        planes = tuple(_true_plane(entry, f"plane {i} in {path}") for i, entry in enumerate(entries, start=1))
        return GroundTruth(folder, planes)


def _true_plane(entry: Any, where: str) -> TruePlane:
    plane = TruePlane(**checked(entry, TRUE_PLANE, where))
    if not math.hypot(*plane.normal) > 0:
        raise ValueError(f"normal of {where} has length 0; expected a direction")
    return plane


def _resized_color(pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    colors = np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else np.ascontiguousarray(pixels[..., :3])
    return np.array(Image.fromarray(colors).resize(size, Image.Resampling.BOX))


def resized_float(pixels: NDArray[np.float32], size: tuple[int, int]) -> NDArray[np.float32]:
    """[H, W] averaged down to a size, which is width and height."""
    return np.array(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))


def _resized_labels(labels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """A label survives only where it covers the whole of the larger pixel."""
    result = np.zeros(size[::-1], dtype=np.uint8)
    for label in np.unique(labels[labels > 0]):
        share = resized_float((labels == label).astype(np.float32), size)
        result[share > 1 - 1e-4] = label
    return result
