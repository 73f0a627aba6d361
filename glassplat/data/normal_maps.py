"""Estimated normals that lie beside photographs: `normals/<photograph's name>.png` or `.npy`, in the camera's axes.

As networks for single photographs write them: x to the right, y up, z towards the camera; in a PNG of 8 or 16 bits
(n + 1) / 2, in an NPY file [H, W, 3] of floats the vectors themselves.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.data.errors import InputError, input_checked
from glassplat.data.view import View
from glassplat.files.images import read_image_float

FOLDER = "normals"
SUFFIXES = (".png", ".npy")
CAMERA_FROM_PICTURE = (1.0, -1.0, -1.0)
"""Turns y up and z towards the camera into y down and z forward."""
LEAST_LENGTH = 0.5
"""Shorter vectors, such as those of grey or black pixels, are no normals."""


def estimated_normals(view: View) -> Tensor | None:
    """[H, W, 3] unit normals of a view in world axes, zero where none is known; None where there is no file.

    The photograph's lens must be a pinhole: normals are reduced with it, but not undistorted.

    Raises:
        InputError: a file cannot be read, or has not the proportions of the photograph.
    """
    path = normals_path(view.image_path)
    if path is None:
        return None
    with input_checked():
        vectors = _vectors(path)
    camera = view.camera
    height, width = vectors.shape[:2]
    if abs(width * camera.height - height * camera.width) > max(width, height, camera.width, camera.height):
        raise InputError(
            f"{path} is {width}x{height} pixels large, its photograph {camera.width}x{camera.height} here; expected "
            "the same proportions"
        )
    in_picture = torch.from_numpy(vectors).permute(2, 0, 1)[None]
    small = torch.nn.functional.interpolate(in_picture, (camera.height, camera.width), mode="area")[0].permute(1, 2, 0)
    known = small.norm(dim=-1, keepdim=True) > LEAST_LENGTH
    unit = torch.nn.functional.normalize(small, dim=-1) * torch.tensor(CAMERA_FROM_PICTURE)
    return torch.where(known, unit @ camera.cam_from_world[:3, :3].to(unit), 0)


def normals_path(image_path: Path) -> Path | None:
    """The file of normals in a folder `normals` beside a photograph or beside its folder; None where there is none."""
    for folder in (image_path.parent / FOLDER, image_path.parent.parent / FOLDER):
        for name in (image_path.stem, image_path.name):
            for suffix in SUFFIXES:
                path = folder / f"{name}{suffix}"
                if path.is_file():
                    return path
    return None


def _vectors(path: Path) -> NDArray[np.float32]:
    """[H, W, 3] as stored, zero where not finite."""
    if path.suffix == ".png":
        pixels = read_image_float(path)
        if pixels.shape[2] < 3:
            raise ValueError(f"{path} is grey; expected normals as colours")
        vectors = 2 * pixels[..., :3] - 1
        return vectors * (pixels[..., 3:] > LEAST_LENGTH) if pixels.shape[2] == 4 else vectors
    try:
        vectors = np.load(path, allow_pickle=False)
    except Exception as error:  # It evaluates the head of the file, and damaged ones raise what tokens do.
        raise ValueError(f"{path} is no array that NumPy can read: {error}") from error
    if vectors.ndim != 3 or vectors.shape[2] != 3 or vectors.dtype.kind != "f" or 0 in vectors.shape:
        raise ValueError(f"{path} holds {vectors.dtype} of shape {list(vectors.shape)}; expected floats [H, W, 3]")
    return np.nan_to_num(vectors.astype(np.float32), nan=0.0, posinf=0.0, neginf=0.0)
