"""Lenses: from the pixels of a photograph, distorted or not, to the pixels of a pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.data.colmap_library import pycolmap
from glassplat.data.errors import InputError

Interpolation = Literal["BILINEAR", "NEAREST_NEIGHBOR"]

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE")
PERSPECTIVE = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Models that are a pinhole when all their distortion coefficients are zero; a fisheye never is."""


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics in pixels and the image size."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


@dataclass(frozen=True)
class PixelMap:
    """Turns a photograph, or its mask, into the pixel grid of its pinhole camera: undistorts, then reduces.

    Attributes:
        lens: `pycolmap.Camera` of the photograph, at the photograph's size; None when it is a pinhole already.
        width, height: size of the result.
    """

    lens: Any
    width: int
    height: int

    def photo(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """[H, W, 3] of the file to [height, width, 3]; bilinear undistortion, area-averaging reduction."""
        if self.lens is not None:
            pixels = _undistort(pixels, self.lens, "BILINEAR")
        return area_resize(pixels, self.width, self.height)

    def labels(self, labels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """[H, W] of the photograph's size to [height, width]; the nearest pixel's label, no label in between."""
        if self.lens is not None:
            labels = _undistort(labels, self.lens, "NEAREST_NEIGHBOR")
        return nearest_resize(labels, self.width, self.height)


def area_resize(pixels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """[H, W, 3] averaged over the area of each new pixel; rounded once, so that no bias builds up."""
    if pixels.shape[:2] == (height, width):
        return pixels
    channels = [Image.fromarray(channel.astype(np.float32)) for channel in np.moveaxis(pixels, 2, 0)]
    reduced = [np.asarray(channel.resize((width, height), Image.Resampling.BOX)) for channel in channels]
    return np.clip(np.round(np.stack(reduced, axis=2)), 0, 255).astype(np.uint8)


def nearest_resize(labels: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    """[H, W] labels on another grid over the same image, each pixel taking what lies under its centre."""
    rows = ((np.arange(height) + 0.5) * labels.shape[0] / height).astype(np.int64)
    columns = ((np.arange(width) + 0.5) * labels.shape[1] / width).astype(np.int64)
    return np.ascontiguousarray(labels[rows[:, None], columns[None, :]])


def make_lens(model: str, parameters: list[float], size: tuple[int, int]) -> Any:
    """A checked `pycolmap.Camera`.

    Args:
        model: COLMAP's name of the camera model.
        parameters: in COLMAP's order.
        size: width and height in pixels.

    Raises:
        InputError: unknown model, wrong number of parameters, a focal length that is not positive, or no pixels.
    """
    if model not in pycolmap.CameraModelId.__members__ or model == "INVALID":
        known = ", ".join(name for name in pycolmap.CameraModelId.__members__ if name != "INVALID")
        raise InputError(f"unknown camera model {model!r}; expected one of {known}")
    lens = pycolmap.Camera.create_from_model_id(0, getattr(pycolmap.CameraModelId, model), 1.0, *size)
    if len(parameters) != len(lens.params):
        raise InputError(f"camera model {model} takes {len(lens.params)} parameters, got {len(parameters)}")
    if min(size) < 1:
        raise InputError(f"the camera is {size[0]}x{size[1]} pixels large; expected a positive size")
    focal_lengths = [parameters[i] for i in lens.focal_length_idxs()]
    if not np.isfinite(parameters).all() or not all(focal > 0 for focal in focal_lengths):
        raise InputError(
            f"camera model {model} with parameters {parameters}; expected finite numbers, focal length > 0"
        )
    lens.params = parameters
    return lens


def lens_for_image(lens: Any, size: tuple[int, int], name: str) -> Any:
    """The lens at the size of the image file; images reduced after calibration rescale it.

    Raises:
        InputError: the two sizes differ in aspect by more than rounding.
    """
    width, height = size
    if (lens.width, lens.height) == (width, height):
        return lens
    scale = (width * lens.width + height * lens.height) / (lens.width**2 + lens.height**2)
    tolerance = max(1.0, scale)
    if abs(scale * lens.width - width) > tolerance or abs(scale * lens.height - height) > tolerance:
        raise InputError(
            f"{name} is {width}x{height} pixels large, but its camera {lens.width}x{lens.height}; expected the "
            "same size or a scaled copy; photographs rotated or cropped after calibration cannot be used"
        )
    rescaled = pycolmap.Camera(lens.todict())
    rescaled.rescale(width, height)
    return rescaled


def pinhole_of(lens: Any) -> tuple[Pinhole, bool]:
    """The pinhole camera that replaces a lens, and whether photographs have to be undistorted for it.

    Raises:
        InputError: the lens cannot be undistorted, such as a panorama.
    """
    key = (lens.model_name, tuple(float(value) for value in lens.params), lens.width, lens.height)
    return _pinhole(*key)


@lru_cache(maxsize=1024)
def _pinhole(model: str, parameters: tuple[float, ...], width: int, height: int) -> tuple[Pinhole, bool]:
    if _is_pinhole(model, parameters):
        lens = make_lens(model, list(parameters), (width, height))
        return _intrinsics(lens), False
    lens = make_lens(model, list(parameters), (width, height))
    try:
        undistorted = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), lens)
    except (ValueError, RuntimeError) as error:
        raise InputError(
            f"camera model {model} with parameters {parameters} cannot be undistorted ({error})"
        ) from error
    return _intrinsics(undistorted), True


def _is_pinhole(model: str, parameters: tuple[float, ...]) -> bool:
    if model in PINHOLES:
        return True
    first_extra = 3 if model in ("SIMPLE_RADIAL", "RADIAL") else 4
    return model in PERSPECTIVE and not any(parameters[first_extra:])


def _intrinsics(lens: Any) -> Pinhole:
    return Pinhole(
        fx=float(lens.focal_length_x),
        fy=float(lens.focal_length_y),
        cx=float(lens.principal_point_x),
        cy=float(lens.principal_point_y),
        width=lens.width,
        height=lens.height,
    )


def _undistort(pixels: NDArray[np.uint8], lens: Any, interpolation: Interpolation) -> NDArray[np.uint8]:
    options = pycolmap.UndistortCameraOptions()
    kinds = type(options.warp_options.interpolation)  # pycolmap gives this enumeration no public name.
    options.warp_options.interpolation = getattr(kinds, interpolation)
    image, _ = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(np.ascontiguousarray(pixels)), lens)
    return np.array(image.to_array())
