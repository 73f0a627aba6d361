"""The files of a `transforms.json` capture, whatever dialect: settings, posed photographs, points.

Their poses are camera-to-world in OpenGL axes (+y up, -z forward); they are converted here and nowhere else.
"""

from __future__ import annotations

from collections.abc import Mapping
from os.path import isfile, lexists, normpath
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glassplat.data.capture import RawPoints, Shot
from glassplat.data.errors import InputError, first_names, input_checked
from glassplat.data.poses import rigid_pose
from glassplat.data.random_points import GREY
from glassplat.data.transforms_lens import lens_from_settings
from glassplat.files.fields import COORDINATE, Field, Items, Optional, Text, checked
from glassplat.files.images import IMAGE_SUFFIXES
from glassplat.files.json_text import read_json
from glassplat.files.ply_table import read_table

POINT_FILES = ("points3d.ply", "points3D.ply", "sparse_pc.ply")
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

Settings = Mapping[str, Any]
FRAME: dict[str, Field] = {"file_path": Text(), "transform_matrix": Items(Items(COORDINATE, 4))}
FILE: dict[str, Field] = {
    "ply_file_path": Optional(Text()),
    "train_filenames": Optional(Items(Text())),
    "val_filenames": Optional(Items(Text())),
    "test_filenames": Optional(Items(Text())),
}
"""What is read beside the lens (`transforms_lens`); more may be in the file."""


def read_settings(path: Path) -> dict[str, Any]:
    """The contents of one file, with at least one frame; every frame names a photograph and has a matrix.

    Raises:
        InputError: no valid JSON, no frames, or one that is not as `FRAME` says; names the file.
    """
    with input_checked():
        settings = read_json(path)
        frames = settings.get("frames") if isinstance(settings, dict) else None
        if not isinstance(frames, list) or not frames:
            raise ValueError(f"{path} lists no frames; expected a list `frames` of at least one photograph")
        for index, frame in enumerate(frames, start=1):
            checked(frame, FRAME, f"frame {index} of {path}")
        checked(settings, FILE, str(path))
    return settings


def shots_of(root: Path, settings: Settings, file_name: str) -> dict[str, Shot]:
    """Every frame by its `file_path`, with an error that lists the photographs that are missing."""
    paths = [image_path(root, frame) for frame in settings["frames"]]
    missing = [path.name for path in paths if not isfile(path)]
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


def image_path(root: Path, frame: Settings) -> Path:
    """The photograph of one frame; Blender leaves its suffix out."""
    path = normpath(root / frame["file_path"].replace("\\", "/"))
    candidates = [path, *(path + suffix for suffix in IMAGE_SUFFIXES)]
    return Path(next((candidate for candidate in candidates if isfile(candidate)), path))


def _name(root: Path, path: Path) -> str:
    """The photograph's name, relative to the folder of images, or to the capture, where it lies in there."""
    plain_root = Path(normpath(root))
    for folder in (plain_root / "images", plain_root):
        if path.is_relative_to(folder):
            return path.relative_to(folder).as_posix()
    return path.name


def _cam_from_world(frame: Settings, name: str) -> NDArray[np.float64]:
    """[4, 4] in OpenCV axes, from camera-to-world in OpenGL axes."""
    world_from_opengl = rigid_pose(np.array(frame["transform_matrix"], dtype=np.float64), name)
    rotation = (world_from_opengl[:3, :3] @ OPENCV_FROM_OPENGL[:3, :3]).T
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ world_from_opengl[:3, 3]
    return pose


def read_points(root: Path, settings: Settings) -> RawPoints | None:
    """The points of the file that the settings name, or of one that usually holds them."""
    named = settings.get("ply_file_path")
    if named is not None and not isfile(root / named):
        raise InputError(f"ply_file_path names {root / named}, which does not exist; copy it there or delete the entry")
    candidates = [named] if named is not None else [name for name in POINT_FILES if lexists(root / name)]
    if not candidates:
        return None
    path = root / candidates[0]
    if not isfile(path):
        raise InputError(f"{path} is no file that can be read; replace or remove it")
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
    with input_checked(path):
        return RawPoints.from_arrays(positions, colors) if len(positions) else None
