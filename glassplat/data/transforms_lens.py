"""Intrinsics of `transforms.json` in all their spellings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from glassplat.data.errors import InputError
from glassplat.data.lens import make_lens
from glassplat.files.images import image_size

FISHEYE = "OPENCV_FISHEYE"
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")


def lens_from_settings(settings: Mapping[str, Any], image_path: Path, name: str) -> Any:
    """The `pycolmap.Camera` of one frame.

    Focal length: `fl_x`, `fl_y`, or the opening angles `camera_angle_x`, `camera_angle_y` in radians. Principal
    point: `cx`, `cy`, or the middle. Size: `w`, `h`, or that of the image. Distortion: `k1` ... `k6`, `p1`, `p2`, as
    in OpenCV.

    Raises:
        InputError: no focal length, a value that is no number, an unknown camera model; names the photograph.
    """
    model = settings.get("camera_model", FISHEYE if settings.get("is_fisheye") else "OPENCV")
    if model != FISHEYE and model not in PERSPECTIVE:
        raise InputError(f"camera_model of {name} is {model!r}; expected one of {', '.join((*PERSPECTIVE, FISHEYE))}")
    try:
        width, height = _size(settings, image_path)
        fx, fy = _focal_lengths(settings, width, height)
        middle = [float(settings.get("cx", width / 2)), float(settings.get("cy", height / 2))]
        k1, k2, k3, k4, k5, k6, p1, p2 = (float(settings.get(key, 0)) for key in _COEFFICIENTS)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"the intrinsics of {name} cannot be read: {error}") from error
    pinhole = [fx, fy, *middle]
    if model == FISHEYE:
        return make_lens(FISHEYE, [*pinhole, k1, k2, k3, k4], (width, height))
    if any((k3, k4, k5, k6)):
        return make_lens("FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, k4, k5, k6], (width, height))
    if any((k1, k2, p1, p2)):
        return make_lens("OPENCV", [*pinhole, k1, k2, p1, p2], (width, height))
    return make_lens("PINHOLE", pinhole, (width, height))


_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def _size(settings: Mapping[str, Any], image_path: Path) -> tuple[int, int]:
    """Width and height the intrinsics refer to."""
    if "w" in settings and "h" in settings:
        return round(float(settings["w"])), round(float(settings["h"]))
    return image_size(image_path)


def _focal_lengths(settings: Mapping[str, Any], width: int, height: int) -> tuple[float, float]:
    """fx and fy in pixels; one stands for both where only one is given."""
    along_x = _focal_length(settings, "fl_x", "camera_angle_x", width)
    along_y = _focal_length(settings, "fl_y", "camera_angle_y", height)
    fx, fy = along_x or along_y, along_y or along_x
    if not fx or not fy:
        raise ValueError("no focal length above zero; expected fl_x in pixels or camera_angle_x in radians")
    return fx, fy


def _focal_length(settings: Mapping[str, Any], length: str, angle: str, size: int) -> float | None:
    """From the length in pixels, or else from the opening angle."""
    if length in settings:
        return float(settings[length])
    if angle not in settings:
        return None
    angle_rad = float(settings[angle])
    if not 0 < angle_rad < math.pi:
        raise ValueError(f"{angle} is {angle_rad}; expected radians between 0 and pi")
    return 0.5 * size / math.tan(0.5 * angle_rad)
