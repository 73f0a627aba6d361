"""Cameras of a capture: lens models, their conversion to pinholes, and checks that poses are rigid."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from glassplat.captures import colmap_library as library
from glassplat.errors import InputError
from glassplat.files.images import resize_by_area
from glassplat.files.records import LARGEST_COORDINATE

ORTHOGONALITY_TOLERANCE = 1e-2
"""Largest entry of R R^T - I that is accepted as rounding in the file."""


def rigid_pose(matrix: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """The pose [4, 4] with its rotation made exactly orthogonal and its translation column unchanged.

    Args:
        matrix: [4, 4] or [3, 4] rigid transform as read from a file.
        name: of the photograph, for messages.
    """
    if matrix.shape not in ((3, 4), (4, 4)):
        raise InputError(f"the pose of {name} has shape {list(matrix.shape)}; expected a 4x4 or 3x4 matrix")
    if not np.isfinite(matrix).all():
        raise InputError(f"the pose of {name} contains non-finite values; remove this photograph from the model")
    if not (np.abs(matrix) <= LARGEST_COORDINATE).all():
        raise InputError(
            f"the pose of {name} holds the value {np.abs(matrix).max():g}; expected world units of at most "
            f"{LARGEST_COORDINATE:g}"
        )
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise InputError(f"the last row of the pose of {name} is {matrix[3].tolist()}; expected [0, 0, 0, 1]")
    pose = np.eye(4)
    pose[:3, 3] = matrix[:3, 3]
    pose[:3, :3] = _nearest_rotation(matrix[:3, :3], name)
    return pose


def _nearest_rotation(linear: NDArray[np.float64], name: str) -> NDArray[np.float64]:
    """The closest rotation to a matrix that is a rotation up to rounding."""
    deviation = float(np.abs(linear @ linear.T - np.eye(3)).max())
    determinant = float(np.linalg.det(linear))
    if deviation > ORTHOGONALITY_TOLERANCE or determinant < 0:
        raise InputError(
            f"the pose of {name} is not rigid: its 3x3 block deviates from a rotation by {deviation:.3g} and has "
            f"determinant {determinant:.3g}; expected an orthogonal matrix of determinant 1, without scale or mirroring"
        )
    left, _, right = np.linalg.svd(linear)
    return left @ right


Interpolation = Literal["BILINEAR", "NEAREST_NEIGHBOR"]


class ParameterCounts(NamedTuple):
    """Numbers of parameters of a camera model, stored as focal lengths, principal point, extra coefficients."""

    focal: int
    extra: int
    principal_point: int = 2

    @property
    def total(self) -> int:
        """Number of all parameters."""
        return self.focal + self.principal_point + self.extra


PARAMETER_COUNTS = {
    "SIMPLE_PINHOLE": ParameterCounts(1, 0),
    "PINHOLE": ParameterCounts(2, 0),
    "SIMPLE_RADIAL": ParameterCounts(1, 1),
    "RADIAL": ParameterCounts(1, 2),
    "OPENCV": ParameterCounts(2, 4),
    "OPENCV_FISHEYE": ParameterCounts(2, 4),
    "FULL_OPENCV": ParameterCounts(2, 8),
    "FOV": ParameterCounts(2, 1),
    "SIMPLE_RADIAL_FISHEYE": ParameterCounts(1, 1),
    "RADIAL_FISHEYE": ParameterCounts(1, 2),
    "THIN_PRISM_FISHEYE": ParameterCounts(2, 8),
    "RAD_TAN_THIN_PRISM_FISHEYE": ParameterCounts(2, 12),
    "SIMPLE_DIVISION": ParameterCounts(1, 1),
    "DIVISION": ParameterCounts(2, 1),
    "SIMPLE_FISHEYE": ParameterCounts(1, 0),
    "FISHEYE": ParameterCounts(2, 0),
    "EUCM": ParameterCounts(2, 2),
    "EQUIRECTANGULAR": ParameterCounts(0, 2, principal_point=0),
}
"""COLMAP's camera models, in the order of their ids in binary files."""
MODEL_OF_ID = dict(enumerate(PARAMETER_COUNTS))

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
PERSPECTIVE = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Models that reduce to a pinhole when all distortion coefficients are zero; fisheye models never do."""
LARGEST_SIDE = 2**17
"""Largest side of an image, in pixels; no supported format exceeds it."""
SHORTEST_FOCAL, LONGEST_FOCAL = 1e-3, 1e5
"""Bounds of focal lengths in image sizes; no lens exceeds them, and float32 could not resolve the image."""
FARTHEST_CENTER = 1e3
"""Largest principal point, in image sizes; in cropped photographs it lies outside the image."""
LARGEST_COEFFICIENT = 1e6
"""Largest distortion coefficient; those of real calibrations are below 100."""
LEAST_SIDE = 8
"""Smallest side of a photograph, in pixels; smaller files come from failed downloads or exports, and smaller reductions
show neither pane edges nor details.
"""
LEAST_BLANK = 1e-3
"""Share of an undistorted image outside the photograph, below which it is rounding along the border."""
BLANK_SIDE = 128
"""Side of the image on which this share is measured, in pixels; full resolution would take seconds."""
MOST_SKEW = 0.05
"""Largest relative deviation of a photograph's side from that of a scaled copy, even if it is one pixel."""


@dataclass(frozen=True)
class Lens:
    """A camera model with its parameters, in COLMAP's names and order, and the image size in pixels."""

    model: str
    parameters: tuple[float, ...]
    width: int
    height: int

    def focal_lengths(self) -> tuple[float, float]:
        """Focal lengths along x and y, pixels; undefined for equirectangular panoramas."""
        return self.parameters[0], self.parameters[PARAMETER_COUNTS[self.model].focal - 1]

    def rescale(self, width: int, height: int) -> Lens:
        """The lens of the same photograph resized."""
        scale_x, scale_y = width / self.width, height / self.height
        counts, scaled = PARAMETER_COUNTS[self.model], list(self.parameters)
        if counts.focal == 1:
            scaled[0] *= (scale_x + scale_y) / 2
        elif counts.focal == 2:
            scaled[:2] = scaled[0] * scale_x, scaled[1] * scale_y
        if counts.principal_point:
            middle = slice(counts.focal, counts.focal + 2)
            scaled[middle] = scaled[middle][0] * scale_x, scaled[middle][1] * scale_y
        return Lens(self.model, tuple(scaled), width, height)

    def as_colmap(self) -> Any:
        """The `pycolmap.Camera`."""
        return library.pycolmap.Camera(
            model=self.model, width=self.width, height=self.height, params=list(self.parameters)
        )


LEAST_SHARE = 1e-4
"""Covered share of a pixel below which the coverage is rounding."""


@dataclass(frozen=True)
class PixelMap:
    """Maps a photograph, or its mask, to the pixel grid of its pinhole camera: undistorts, then downscales.

    Attributes:
        lens: lens of the photograph, at the photograph's size; None if it is a pinhole already.
        width, height: size of the result.
    """

    lens: Lens | None
    width: int
    height: int

    def map_photo(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Maps [H, W, 3] of the file to [height, width, 3]: bilinear undistortion, then area averaging."""
        if self.lens is not None:
            pixels = undistort(pixels, self.lens.as_colmap())
        return area_resize(pixels, self.width, self.height)

    def map_labels(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Maps [H, W] at the photograph's size to [height, width] by the nearest pixel; labels are not blended."""
        return nearest_resize(self._undistort_labels(labels), self.width, self.height)

    def map_ignored(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Maps [H, W] at the photograph's size to [height, width]; 1 where any averaged pixel has a label."""
        return self.reduce_labels(self._undistort_labels(labels))

    def _undistort_labels(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return labels if self.lens is None else undistort(labels, self.lens.as_colmap(), "NEAREST_NEIGHBOR")

    def reduce_labels(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Maps [H, W] at the undistorted size to [height, width]; 1 where any averaged pixel has a label."""
        if labels.shape == (self.height, self.width):
            return labels
        return (resize_by_area(labels > 0, self.width, self.height) > LEAST_SHARE).astype(np.uint8)


def area_resize(pixels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """[H, W, 3] averaged over the area of each new pixel; rounded once, so that no bias accumulates."""
    if pixels.shape[:2] == (height, width):
        return pixels
    return np.clip(np.round(resize_by_area(pixels, width, height)), 0, 255).astype(np.uint8)


def check_proportions(path: Path, size: tuple[int, int], photograph: tuple[int, int]) -> None:
    """Check that a file has the proportions of an undistorted photograph (width, height).

    Raises:
        InputError: they differ by more than rounding.
    """
    if abs(size[0] * photograph[1] - size[1] * photograph[0]) > max(*size, *photograph):
        raise InputError(
            f"{path} is {size[0]}x{size[1]} pixels, its photograph {photograph[0]}x{photograph[1]} here, without "
            "the distortion of its lens; expected the same proportions, so make it again at the photograph's size"
        )


def nearest_resize(labels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """[H, W] labels resampled to another grid; each pixel takes the label under its centre."""
    rows = ((np.arange(height) + 0.5) * labels.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * labels.shape[1] / width).astype(np.int64)
    return np.ascontiguousarray(labels[rows[:, None], columns[None, :]])


def make_lens(model: str, parameters: list[float], size: tuple[int, int]) -> Lens:
    """A checked lens.

    Args:
        model: COLMAP's name of the camera model.
        parameters: in COLMAP's order.
        size: width and height in pixels.
    """
    if model not in PARAMETER_COUNTS:
        raise InputError(f"unknown camera model {model!r}; expected one of {', '.join(PARAMETER_COUNTS)}")
    if not all(1 <= side <= LARGEST_SIDE for side in size):
        # Text files may hold sizes of thousands of digits, which cannot be printed.
        shown = "x".join(str(side) if abs(side) < 10**9 else "huge" for side in size)
        raise InputError(f"the camera is {shown} pixels; expected sides from 1 to {LARGEST_SIDE}")
    total = PARAMETER_COUNTS[model].total
    if len(parameters) != total:
        raise InputError(f"camera model {model} takes {total} parameters, got {len(parameters)}")
    lens = Lens(model, tuple(parameters), *size)
    _check_parameters(lens)
    return lens


def _check_parameters(lens: Lens) -> None:
    """Refuse implausible parameters, including NaN, for which comparisons are false."""
    longer, counts = max(lens.width, lens.height), PARAMETER_COUNTS[lens.model]
    bounds = [
        *[(SHORTEST_FOCAL * longer, LONGEST_FOCAL * longer)] * counts.focal,
        *[(-FARTHEST_CENTER * longer, FARTHEST_CENTER * longer)] * counts.principal_point,
        *[(-LARGEST_COEFFICIENT, LARGEST_COEFFICIENT)] * counts.extra,
    ]
    for value, (least, most) in zip(lens.parameters, bounds, strict=True):
        if not least <= value <= most:
            found = ", ".join(f"{one:g}" for one in lens.parameters)
            raise InputError(
                f"camera model {lens.model} of {lens.width}x{lens.height} pixels has the parameters {found}; expected "
                f"a finite number from {least:g} to {most:g} instead of {value:g}"
            )


def lens_for_image(lens: Lens, size: tuple[int, int], name: str) -> Lens:
    """The lens at the size of the image file; rescaled if the image was resized after calibration."""
    width, height = size
    if min(size) < LEAST_SIDE:
        raise InputError(f"{name} is {width}x{height} pixels; expected at least {LEAST_SIDE} pixels along each side")
    if (lens.width, lens.height) == (width, height):
        return lens
    scale = (width * lens.width + height * lens.height) / (lens.width**2 + lens.height**2)
    rounding = max(1.0, scale)
    skew = max(_skew(scale * lens.width, width, rounding), _skew(scale * lens.height, height, rounding))
    if skew > MOST_SKEW:
        raise InputError(
            f"{name} is {width}x{height} pixels, but its camera {lens.width}x{lens.height}; expected the "
            "same size or a scaled copy; photographs rotated or cropped after calibration cannot be used"
        )
    return lens.rescale(width, height)


def _skew(expected: float, side: int, rounding: float) -> float:
    """Relative deviation of a side of the photograph; infinite if it exceeds rounding."""
    deviation = abs(expected - side)
    return math.inf if deviation > rounding else deviation / side


@lru_cache(maxsize=1024)
def pinhole_of(lens: Lens) -> tuple[Lens, bool]:
    """The `PINHOLE` that replaces a lens, and whether photographs must be undistorted for it."""
    if _is_pinhole(lens.model, lens.parameters):
        first = PARAMETER_COUNTS[lens.model].focal
        middle = lens.parameters[first : first + 2]
        return Lens("PINHOLE", (*lens.focal_lengths(), *middle), lens.width, lens.height), False
    pycolmap = library.pycolmap
    try:
        found = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens.as_colmap())
    except (ValueError, RuntimeError) as error:
        raise InputError(
            f"camera model {lens.model} with parameters {lens.parameters} cannot be undistorted ({error})"
        ) from error
    return Lens("PINHOLE", tuple(map(float, found.params)), found.width, found.height), True


@lru_cache(maxsize=1024)
def blank_share(lens: Lens) -> float:
    """Share of the undistorted image outside the photograph; 0 if it is only rounding along the border.

    Strong barrel distortion leaves blank parts, because COLMAP enlarges an image to at most twice its size.
    """
    if not pinhole_of(lens)[1]:
        return 0.0
    scale = min(1.0, BLANK_SIDE / max(lens.width, lens.height))
    small = lens.rescale(max(1, round(scale * lens.width)), max(1, round(scale * lens.height)))
    share = float(blank_pixels(small).mean())
    return share if share > LEAST_BLANK else 0.0


@lru_cache(maxsize=8)  # Making it is as slow as undistorting a photograph, and the same for all of a lens.
def blank_mask(pixel_map: PixelMap) -> NDArray[np.uint8]:
    """[height, width], 1 where any averaged pixel lies outside the distorted photograph."""
    shape = (pixel_map.height, pixel_map.width)
    return pixel_map.reduce_labels(blank_pixels(pixel_map.lens)) if pixel_map.lens else np.zeros(shape, np.uint8)


def blank_pixels(lens: Lens) -> NDArray[np.uint8]:
    """[H, W] of the undistorted image, 1 at pixels outside the photograph."""
    return (undistort(np.full((lens.height, lens.width), 255, np.uint8), lens.as_colmap()) < 255).astype(np.uint8)


def _is_pinhole(model: str, parameters: tuple[float, ...]) -> bool:
    if model in PINHOLES:
        return True
    counts = PARAMETER_COUNTS[model]
    return model in PERSPECTIVE and not any(parameters[counts.focal + counts.principal_point :])


def undistort(pixels: NDArray[np.uint8], lens: Any, interpolation: Interpolation = "BILINEAR") -> NDArray[np.uint8]:
    """A photograph as seen by the pinhole camera of `pycolmap.undistort_camera`, whose size may differ.

    Args:
        pixels: [H, W, 3] of the photograph, or [H, W].
        lens: its `pycolmap.Camera`.
        interpolation: between pixels; nearest neighbour for labels.
    """
    options = library.pycolmap.UndistortCameraOptions()
    kinds = type(options.warp_options.interpolation)  # pycolmap gives this enumeration no public name.
    options.warp_options.interpolation = getattr(kinds, interpolation)
    image, _ = library.pycolmap.undistort_image(
        options, library.pycolmap.Bitmap.from_array(np.ascontiguousarray(pixels)), lens
    )
    return np.array(image.to_array())
