"""Intrinsics of `transforms.json` in all their spellings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from glassplat.data.errors import InputError, input_checked
from glassplat.data.lens import LARGEST_SIDE, make_lens
from glassplat.files.fields import Choice, Field, Flag, Number, Optional, checked
from glassplat.files.images import image_size

FISHEYE = "OPENCV_FISHEYE"
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
LENS: dict[str, Field] = {
    "camera_model": Optional(Choice((*PERSPECTIVE, FISHEYE))),
    "is_fisheye": Optional(Flag(), default=False),
    **dict.fromkeys(("w", "h"), Optional(Number(1, LARGEST_SIDE))),
    **dict.fromkeys(("fl_x", "fl_y"), Optional(Number(above=0))),
    **dict.fromkeys(("camera_angle_x", "camera_angle_y"), Optional(Number(above=0, most=math.pi))),
    **dict.fromkeys(("cx", "cy"), Optional(Number())),
    **dict.fromkeys(COEFFICIENTS, Optional(Number(), default=0.0)),
}


def lens_from_settings(settings: Mapping[str, Any], image_path: Path, name: str) -> Any:
    """The `pycolmap.Camera` of one frame.

    Focal length: `fl_x`, `fl_y`, or the opening angles `camera_angle_x`, `camera_angle_y` in radians. Principal
    point: `cx`, `cy`, or the middle. Size: `w`, `h`, or that of the image. Distortion: `k1` ... `k6`, `p1`, `p2`, as
    in OpenCV.

    Raises:
        InputError: no focal length, a value that is no number, an unknown camera model; names the photograph.
    """
    with input_checked():
        found = checked(settings, LENS, f"the lens of {name}")
        width, height = _size(found, image_path)
        fx, fy = _focal_lengths(found, width, height, name)
    model = found["camera_model"] or (FISHEYE if found["is_fisheye"] else "OPENCV")
    middle = [half if at is None else at for at, half in ((found["cx"], width / 2), (found["cy"], height / 2))]
    try:
        return _lens(str(model), [fx, fy, *middle], [found[key] for key in COEFFICIENTS], (width, height))
    except InputError as error:
        raise InputError(f"the lens of {name}: {error}") from error


def _lens(model: str, pinhole: list[float], coefficients: list[float], size: tuple[int, int]) -> Any:
    """The simplest of COLMAP's models that has all coefficients that are not zero."""
    k1, k2, k3, k4, k5, k6, p1, p2 = coefficients
    if model == FISHEYE:
        return make_lens(FISHEYE, [*pinhole, k1, k2, k3, k4], size)
    if any((k3, k4, k5, k6)):
        return make_lens("FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, k4, k5, k6], size)
    if any((k1, k2, p1, p2)):
        return make_lens("OPENCV", [*pinhole, k1, k2, p1, p2], size)
    return make_lens("PINHOLE", pinhole, size)


def _size(found: Mapping[str, Any], image_path: Path) -> tuple[int, int]:
    """Width and height the intrinsics refer to."""
    if found["w"] is None or found["h"] is None:
        return image_size(image_path)
    return round(found["w"]), round(found["h"])


def _focal_lengths(found: Mapping[str, Any], width: int, height: int, name: str) -> tuple[float, float]:
    """fx and fy in pixels; one stands for both where only one is given."""
    along_x = _focal_length(found["fl_x"], found["camera_angle_x"], width)
    along_y = _focal_length(found["fl_y"], found["camera_angle_y"], height)
    fx, fy = along_x or along_y, along_y or along_x
    if not fx or not fy:
        raise ValueError(
            f"the lens of {name} has no focal length; expected fl_x in pixels or camera_angle_x in radians"
        )
    return fx, fy


def _focal_length(length: float | None, angle_rad: float | None, size: int) -> float | None:
    """From the length in pixels, or else from the opening angle."""
    if length is not None or angle_rad is None:
        return length
    return 0.5 * size / math.tan(0.5 * angle_rad)
