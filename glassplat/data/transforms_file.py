"""The files of a `transforms.json` capture, whatever dialect: settings, posed photographs, points.

Their poses are camera-to-world in OpenGL axes (+y up, -z forward); they are converted here and nowhere else.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glassplat.data.capture import PointCloud, Shot
from glassplat.data.errors import InputError, first_names, input_checked
from glassplat.data.poses import rigid_pose
from glassplat.data.random_points import GREY
from glassplat.data.transforms_lens import lens_from_settings
from glassplat.files.images import IMAGE_SUFFIXES
from glassplat.files.ply_table import read_table

POINT_FILES = ("points3d.ply", "points3D.ply", "sparse_pc.ply")
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

Settings = Mapping[str, Any]


def read_settings(path: Path) -> dict[str, Any]:
    """The contents of one file, with at least one frame."""
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is no valid JSON ({error}); write it again") from error
    frames = settings.get("frames") if isinstance(settings, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{path} lists no frames; expected an object with a list `frames` of at least one photograph")
    return settings


def shots_of(root: Path, settings: Settings, file_name: str) -> dict[str, Shot]:
    """Every frame by its `file_path`, with an error that lists the photographs that are missing."""
    paths = [image_path(root, frame, file_name) for frame in settings["frames"]]
    missing = [path.name for path in paths if not path.is_file()]
    if missing:
        raise InputError(
            f"{len(missing)} of {len(paths)} photographs of {root / file_name} are missing: {first_names(missing)}; "
            "copy them to where file_path says, or delete their entries from `frames`"
        )
    shots = {}
    for frame, path in zip(settings["frames"], paths, strict=True):
        name = _name(root, path)
        lens = lens_from_settings({**settings, **frame}, path, name)
        if frame["file_path"] in shots:
            raise InputError(f"{root / file_name} has two frames for {frame['file_path']}; keep one")
        shots[frame["file_path"]] = Shot(name, path, lens, _cam_from_world(frame, name))
    return shots


def image_path(root: Path, frame: Settings, file_name: str) -> Path:
    """The photograph of one frame; Blender leaves its suffix out."""
    file_path = frame.get("file_path")
    if not isinstance(file_path, str) or not file_path:
        raise InputError(f"a frame of {root / file_name} has no file_path; expected the path of a photograph")
    path = Path(os.path.normpath(root / file_path.replace("\\", "/")))
    candidates = [path, *(path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES)]
    return next((candidate for candidate in candidates if candidate.is_file()), path)


def _name(root: Path, path: Path) -> str:
    """The photograph's name, relative to the folder of images, or to the capture, where it lies in there."""
    plain_root = Path(os.path.normpath(root))
    for folder in (plain_root / "images", plain_root):
        if path.is_relative_to(folder):
            return path.relative_to(folder).as_posix()
    return path.name


def _cam_from_world(frame: Settings, name: str) -> NDArray[np.float64]:
    """[4, 4] in OpenCV axes, from camera-to-world in OpenGL axes."""
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"the transform_matrix of {name} is no table of numbers ({error})") from error
    world_from_opengl = rigid_pose(matrix, name)
    rotation = (world_from_opengl[:3, :3] @ OPENCV_FROM_OPENGL[:3, :3]).T
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ world_from_opengl[:3, 3]
    return pose


def read_points(root: Path, settings: Settings) -> PointCloud | None:
    """The points of the file that the settings name, or of one that usually holds them."""
    named = settings.get("ply_file_path")
    if named is not None and not (root / str(named)).is_file():
        raise InputError(
            f"ply_file_path names {root / str(named)}, which does not exist; copy it there or delete the entry"
        )
    candidates = [named] if named is not None else [name for name in POINT_FILES if (root / name).is_file()]
    if not candidates:
        return None
    path = root / str(candidates[0])
    with input_checked():
        columns = read_table(path).columns
    lacking = [axis for axis in "xyz" if axis not in columns]
    if lacking:
        raise InputError(
            f"{path} has no vertex property {first_names(lacking)}; expected a point cloud with x, y and z"
        )
    positions = np.stack([columns[axis] for axis in "xyz"], axis=1)
    rgb = [columns.get(colour) for colour in ("red", "green", "blue")]
    colors = (
        np.full(positions.shape, GREY)
        if any(c is None for c in rgb)
        else np.stack([c for c in rgb if c is not None], 1)
    )
    return PointCloud.from_arrays(positions, colors) if len(positions) else None
