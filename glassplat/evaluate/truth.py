"""Ground truth of synthetic captures: layers, panes, normals and reflectivity.

Normals and reflectivity are stored next to a test photograph:

```
r_0.png            the photograph
r_0_normal.png     (n + 1) / 2 of the unit normals in world axes; alpha is the coverage
r_0_strength.png   grey of 8 or 16 bits: the share of mirror-like reflection
```

Shiny Blender has the normals, this project's own captures have both; Shiny Blender's own files could not be tested. The
camera must be a pinhole: files next to a photograph are downscaled with it, but not undistorted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.captures.cameras import LEAST_SHARE, area_resize, check_proportions
from glassplat.captures.view import View
from glassplat.errors import InputError, convert_to_input_error
from glassplat.files.images import image_size, read_colors, read_image, read_image_float, resize_by_area
from glassplat.files.records import COORDINATE, Boolean, Field, Integer, ListOf, Number, check_fields, read_json
from glassplat.options import short_repr


@dataclass(frozen=True)
class TrueView:
    """The true layers of one test view.

    Attributes:
        transmission: [H, W, 3] uint8 sRGB, light transmitted by the first pane on each ray: tinted by it, and including
            reflections of panes behind it.
        reflection: [H, W, 3] uint8 sRGB, light reflected by the panes, at full strength.
        strength: [H, W] float32, true Fresnel strength in [0, 1].
        labels: [H, W] uint8, pane label of pixels that a pane covers completely, else 0.
    """

    transmission: Tensor
    reflection: Tensor
    strength: Tensor
    labels: Tensor


@dataclass(frozen=True)
class TruePlane:
    """A true pane; vectors in world units, reflectance at normal incidence."""

    label: int
    center: tuple[float, ...]
    normal: tuple[float, ...]
    half_u: tuple[float, ...]
    half_v: tuple[float, ...]
    mirror: bool
    base_reflectance: float


VECTOR = ListOf(COORDINATE, 3)
TRUE_PLANE: dict[str, Field] = {
    "label": Integer(1, 255),
    **dict.fromkeys(("center", "normal", "half_u", "half_v"), VECTOR),
    "mirror": Boolean(),
    "base_reflectance": Number(0, 1),
}


@dataclass(frozen=True)
class GroundTruth:
    """The folder `gt/` of a scene; views are read on demand."""

    folder: Path
    planes: tuple[TruePlane, ...]

    def view(self, image_name: str, width: int, height: int) -> TrueView | None:
        """The true layers for a photograph, downsampled by area averaging to the given size.

        Args:
            image_name: the photograph's name, after which the files are named, with its folder or without.
            width: of the rendered view, pixels.
            height: of the rendered view, pixels.

        Returns:
            None if the folder has no files for this view.

        Raises:
            InputError: only some of the view's files exist, or a file is broken or has other proportions.
        """
        in_folder = self._paths(Path(image_name).with_suffix(""))
        without_folder = self._paths(Path(Path(image_name).stem))
        paths = in_folder if any(path.is_file() for path in in_folder.values()) else without_folder
        missing = [str(path) for path in paths.values() if not path.is_file()]
        if len(missing) == len(paths):
            return None
        if missing:
            raise InputError(
                f"ground truth for {image_name} is incomplete: {', '.join(missing)} missing; add or remove all"
            )
        size = (width, height)
        with convert_to_input_error():
            for path in paths.values():
                check_proportions(path, image_size(path), size)
            return TrueView(
                transmission=torch.from_numpy(_resized_color(read_colors(paths["transmission"]), size)),
                reflection=torch.from_numpy(_resized_color(read_colors(paths["reflection"]), size)),
                strength=torch.from_numpy(resize_by_area(read_image_float(paths["strength"])[..., 0], *size)),
                labels=torch.from_numpy(_resized_labels(read_image(paths["labels"])[..., 0], size)),
            )

    def _paths(self, name: Path) -> dict[str, Path]:
        """The files of a photograph of this name, without its suffix."""
        return {
            "transmission": _png_or_jpeg(self.folder / "trans" / name),
            "reflection": _png_or_jpeg(self.folder / "refl" / name),
            "strength": self.folder / "strength" / f"{name}.png",
            "labels": self.folder / "strength" / f"{name}_pane.png",
        }


def _png_or_jpeg(stem: Path) -> Path:
    """Path of an image: the JPEG of that name if there is one, else the PNG."""
    jpeg = stem.with_name(f"{stem.name}.jpg")
    return jpeg if jpeg.is_file() else stem.with_name(f"{stem.name}.png")


def load_truth(folder: Path | None) -> GroundTruth | None:
    """Opens a data set's folder of true layers and panes; None for None.

    Raises:
        InputError: its `planes.json` is invalid.
    """
    if folder is None:
        return None
    path = folder / "planes.json"
    if not path.is_file():
        return GroundTruth(folder, ())
    with convert_to_input_error():
        entries = read_json(path)
        if not isinstance(entries, list):
            raise ValueError(f"{path} holds {short_repr(entries)}; expected a list with one object per plane")
        planes = tuple(_true_plane(entry, f"plane {i} in {path}") for i, entry in enumerate(entries, start=1))
        return GroundTruth(folder, planes)


def _true_plane(entry: Any, where: str) -> TruePlane:
    plane = TruePlane(**check_fields(entry, TRUE_PLANE, where))
    if not math.hypot(*plane.normal) > 0:
        raise ValueError(f"normal of {where} has length 0; expected a direction")
    return plane


def _resized_color(pixels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    colors = np.repeat(pixels, 3, axis=2) if pixels.shape[2] == 1 else np.ascontiguousarray(pixels[..., :3])
    return area_resize(colors, *size)


def _resized_labels(labels: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Downsampled labels; a label remains only where it covers the whole of the larger pixel."""
    result = np.zeros(size[::-1], dtype=np.uint8)
    for label in np.unique(labels[labels > 0]):
        result[resize_by_area(labels == label, *size) > 1 - LEAST_SHARE] = label
    return result


NORMAL_SUFFIX, STRENGTH_SUFFIX = "_normal", "_strength"
LEAST_COVERAGE = 0.5
"""Coverage above which a pixel shows the surface."""
MOST_LENGTH_DEVIATION = 0.25
"""Maximum deviation from 1 of the length of a stored vector that is a normal, and not the colour of a background."""


@dataclass(frozen=True)
class TrueSurface:
    """True surface of one view.

    Attributes:
        covered: [H, W] bool, where there is a surface.
        normals: [H, W, 3] float32 unit vectors in world axes, zero where not covered; None if unknown.
        strength: [H, W] float32 share of mirror-like reflection in [0, 1]; None if unknown.
    """

    covered: Tensor
    normals: Tensor | None
    strength: Tensor | None


UNKNOWN_SURFACE = TrueSurface(torch.zeros(0, 0, dtype=torch.bool), None, None)


def true_surface(view: View) -> TrueSurface | None:
    """The true surface of a view at its size, from the files next to its photograph; None if there are none.

    Coverage is the alpha of the normals, else that of the photograph, else all pixels with a normal.

    Raises:
        InputError: a file is not an image, or differs in size from the photograph.
    """
    size = (view.camera.width, view.camera.height)
    vectors, strength = _read_companion(view, NORMAL_SUFFIX), _read_companion(view, STRENGTH_SUFFIX)
    if vectors is None and strength is None:
        return None
    coverage = _coverage(view, vectors)
    covered = torch.from_numpy(resize_by_area(coverage, *size) > LEAST_COVERAGE)
    return TrueSurface(
        covered=covered,
        normals=None if vectors is None else _normals(vectors, coverage, size) * covered[..., None],
        strength=None if strength is None else torch.from_numpy(resize_by_area(strength[..., 0], *size)),
    )


def _read_companion(view: View, suffix: str) -> NDArray[np.float32] | None:
    """[H, W, C] in [0, 1] of the file next to a photograph; None if there is none."""
    path = view.image_path.with_name(f"{view.image_path.stem}{suffix}.png")
    if not path.is_file():
        return None
    photo_size = image_size(view.image_path)
    with convert_to_input_error():
        pixels = read_image_float(path)
    if pixels.shape[1::-1] != photo_size:
        raise InputError(
            f"{path} is {pixels.shape[1]}x{pixels.shape[0]} pixels, its photograph {photo_size[0]}x"
            f"{photo_size[1]}; expected the same size"
        )
    return pixels


def _coverage(view: View, vectors: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """[H, W] share of each pixel of the photograph's file that shows the surface."""
    if vectors is not None and vectors.shape[2] == 4:
        return vectors[..., 3]
    with convert_to_input_error():
        photo = read_image_float(view.image_path)
    if photo.shape[2] == 4:
        return photo[..., 3]
    if vectors is None:
        return np.ones(photo.shape[:2], dtype=np.float32)
    lengths = np.linalg.norm(_decode_normals(vectors), axis=-1)
    return (np.abs(lengths - 1) < MOST_LENGTH_DEVIATION).astype(np.float32)


def _normals(vectors: NDArray[np.float32], coverage: NDArray[np.float32], size: tuple[int, int]) -> Tensor:
    """[H, W, 3] unit vectors: means over the covered parts of the smaller pixels."""
    weighted = _decode_normals(vectors) * coverage[..., None]
    return torch.nn.functional.normalize(torch.from_numpy(resize_by_area(weighted, *size)), dim=-1)


def _decode_normals(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    return 2 * vectors[..., :3] - 1
