"""Camera paths: an orbit around the subject, or a smooth path through the cameras of photographs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from glassplat.errors import count_noun
from glassplat.publish.web_page import least_aligned_axis, survey_capture
from glassplat.scene.camera import Camera, look_at, rigid_transform

MOST_KEYFRAMES = 12
"""Maximum number of photographs on a path; more would reproduce the shake of a hand-held camera."""
ALL_AROUND = 0.4
"""Length of the mean of unit directions to the photographs, below which they are taken to surround the subject."""
SHARE_OF_SPREAD = 1.2
LEAST_LOOP = 0.08
"""Minimum radius of a loop, as a share of the distance to the subject."""


def orbit(cameras: Sequence[Camera], extent: float, frames: int) -> list[Camera]:
    """A closed path once around the subject of the cameras, or a loop in front of it if all are on one side.

    Args:
        cameras: of the photographs; the first one defines the intrinsics.
        extent: of the scene.
        frames: how many cameras to return.
    """
    survey = survey_capture(cameras, extent)
    centers = torch.stack([camera.center.double().cpu() for camera in cameras])
    arms = centers - survey.focus
    heights = arms @ survey.up
    flat = arms - heights[:, None] * survey.up
    facing = torch.nn.functional.normalize(flat, dim=1).mean(0)
    angles = [2 * math.pi * index / frames for index in range(frames)]
    radius, height = float(flat.norm(dim=1).median()), float(heights.median())
    least = LEAST_LOOP * survey.distance
    if float(facing.norm()) < ALL_AROUND or radius < least:
        is_long = float(flat[0].norm()) > least
        first = flat[0] if is_long else torch.linalg.cross(survey.up, least_aligned_axis(survey.up))
        aside = torch.nn.functional.normalize(first, dim=0)
        ahead, radius = torch.linalg.cross(survey.up, aside), max(radius, least)
        offsets = [radius * (math.cos(a) * aside + math.sin(a) * ahead) + height * survey.up for a in angles]
    else:
        arm = arms.median(dim=0).values
        right = torch.nn.functional.normalize(torch.linalg.cross(survey.up, arm), dim=0)
        wide, tall = (_loop_radius(arms @ axis, survey.distance) for axis in (right, survey.up))
        offsets = [arm + wide * math.sin(a) * right + tall * math.cos(a) * survey.up for a in angles]
    poses = [look_at(survey.focus + offset, survey.focus, survey.up) for offset in offsets]
    return [replace(cameras[0], cam_from_world=pose) for pose in poses]


def interpolate_cameras(cameras: Sequence[Camera], frames: int) -> list[Camera]:
    """A smooth path from the first camera through all others to the last, with equal time between neighbours.

    Args:
        cameras: at least two; intrinsics are interpolated, too. The size is that of the first one, to which the others
            are scaled and cropped.
        frames: how many cameras to return.

    Raises:
        ValueError: fewer than two cameras.
    """
    from scipy.interpolate import CubicSpline
    from scipy.spatial.transform import Rotation, RotationSpline

    if len(cameras) < 2:
        raise ValueError(f"no path leads through {count_noun(len(cameras), 'camera')}; expected at least two")
    knots = np.arange(len(cameras), dtype=np.float64)
    times = np.linspace(0, knots[-1], frames)
    poses = [camera.cam_from_world.double().cpu().numpy() for camera in cameras]
    rotations = Rotation.from_matrix(np.stack([pose[:3, :3] for pose in poses]))
    path_rotations = RotationSpline(knots, rotations)(times).as_matrix()
    positions = CubicSpline(knots, np.stack([camera.center.double().cpu().numpy() for camera in cameras]))(times)
    first = cameras[0]
    lenses = np.array([_intrinsics_for_size(camera, first.width, first.height) for camera in cameras])
    lens = np.stack([np.interp(times, knots, column) for column in lenses.T], axis=1)
    path = []
    for rotation, position, (fx, fy, cx, cy) in zip(path_rotations, positions, lens.tolist(), strict=True):
        path.append(Camera(rigid_transform(rotation, position), fx, fy, cx, cy, first.width, first.height))
    return path


def select_keyframes(cameras: Sequence[Camera]) -> list[Camera]:
    """At most `MOST_KEYFRAMES` of the cameras, evenly spaced, including the first and the last one."""
    count = min(len(cameras), MOST_KEYFRAMES)
    return [cameras[round(index * (len(cameras) - 1) / max(count - 1, 1))] for index in range(count)]


def fit_to_width(camera: Camera, width: int) -> Camera:
    """The camera resized to this width, and to the nearest even height; encoders require even sizes."""
    height = max(2, 2 * round(width * camera.height / camera.width / 2))
    return camera.resize(width, height)


def _intrinsics_for_size(camera: Camera, width: int, height: int) -> tuple[float, float, float, float]:
    """(fx, fy, cx, cy) of a camera for another image size, filled by the centre of its own image."""
    scale = max(width / camera.width, height / camera.height)
    cx, cy = width / 2 + scale * (camera.cx - camera.width / 2), height / 2 + scale * (camera.cy - camera.height / 2)
    return scale * camera.fx, scale * camera.fy, cx, cy


def _loop_radius(spread: Tensor, distance: float) -> float:
    return max(SHARE_OF_SPREAD * float(spread.std(correction=0)), LEAST_LOOP * distance)
