"""True surfaces that synthetic captures ship beside a test photograph: normals, and how mirror-like they reflect.

```
r_0.png            the photograph
r_0_normal.png     (n + 1) / 2 of the unit normals in world axes; alpha is the coverage
r_0_strength.png   grey of 8 or 16 bits: the share of mirror-like reflection
```

Shiny Blender has the normals, this project's own captures have both; it could not be tried on Shiny Blender's own
files. The lens must be a pinhole: what lies beside a photograph is reduced with it, but not undistorted.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.data.errors import InputError, input_checked
from glassplat.data.view import View
from glassplat.evaluate.truth import resized_float
from glassplat.files.images import image_size, read_image_float

NORMAL_MARK, STRENGTH_MARK = "_normal", "_strength"
COVERED = 0.5
"""Above this coverage a pixel shows the surface."""
NEARLY_UNIT = 0.25
"""How far from 1 the length of a stored vector may be for it to be a normal and not the colour of a background."""


@dataclass(frozen=True)
class TrueSurface:
    """What one view really shows.

    Attributes:
        covered: [H, W] bool, where there is a surface.
        normals: [H, W, 3] float32 unit vectors in world axes, zero where not covered; None where they are not known.
        strength: [H, W] float32 share of mirror-like reflection in [0, 1]; None where it is not known.
    """

    covered: Tensor
    normals: Tensor | None
    strength: Tensor | None


NOTHING_KNOWN = TrueSurface(torch.zeros(0, 0, dtype=torch.bool), None, None)


def true_surface(view: View) -> TrueSurface | None:
    """The true surface of a view at its size, from the files beside its photograph; None where there are none.

    Coverage is the alpha of the normals, else that of the photograph, else all that holds a normal.

    Raises:
        InputError: a file is no image, or is not as large as the photograph.
    """
    size = (view.camera.width, view.camera.height)
    vectors, strength = _read_beside(view, NORMAL_MARK), _read_beside(view, STRENGTH_MARK)
    if vectors is None and strength is None:
        return None
    coverage = _coverage(view, vectors)
    covered = torch.from_numpy(resized_float(coverage, size) > COVERED)
    return TrueSurface(
        covered=covered,
        normals=None if vectors is None else _normals(vectors, coverage, size) * covered[..., None],
        strength=None if strength is None else torch.from_numpy(resized_float(strength[..., 0], size)),
    )


def _read_beside(view: View, mark: str) -> NDArray[np.float32] | None:
    """[H, W, C] in [0, 1] of the file beside a photograph, None where there is none."""
    path = view.image_path.with_name(f"{view.image_path.stem}{mark}.png")
    if not path.is_file():
        return None
    photo_size = image_size(view.image_path)
    pixels = _read(path)
    if pixels.shape[1::-1] != photo_size:
        raise InputError(
            f"{path} is {pixels.shape[1]}x{pixels.shape[0]} pixels large, its photograph {photo_size[0]}x"
            f"{photo_size[1]}; expected the same size"
        )
    return pixels


def _read(path: Path) -> NDArray[np.float32]:
    with input_checked():
        return read_image_float(path)


def _coverage(view: View, vectors: NDArray[np.float32] | None) -> NDArray[np.float32]:
    """[H, W] share of each pixel of the photograph's file that shows the surface."""
    if vectors is not None and vectors.shape[2] == 4:
        return vectors[..., 3]
    photo = _read(view.image_path)
    if photo.shape[2] == 4:
        return photo[..., 3]
    if vectors is None:
        return np.ones(photo.shape[:2], dtype=np.float32)
    lengths = np.linalg.norm(_decoded(vectors), axis=-1)
    return (np.abs(lengths - 1) < NEARLY_UNIT).astype(np.float32)


def _normals(vectors: NDArray[np.float32], coverage: NDArray[np.float32], size: tuple[int, int]) -> Tensor:
    """[H, W, 3] unit vectors: means over the covered parts of the smaller pixels."""
    weighted = _decoded(vectors) * coverage[..., None]
    means = np.stack([resized_float(weighted[..., axis], size) for axis in range(3)], axis=-1)
    return torch.nn.functional.normalize(torch.from_numpy(means), dim=-1)


def _decoded(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    return 2 * vectors[..., :3] - 1
