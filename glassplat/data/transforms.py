"""`transforms.json` captures, as written by instant-ngp, nerfstudio and Blender scripts.

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

from glassplat.data.capture import Capture, PointCloud, Shot
from glassplat.data.errors import InputError, first_names
from glassplat.data.poses import rigid_pose
from glassplat.data.random_points import GREY, points_in_box
from glassplat.data.transforms_lens import lens_from_settings
from glassplat.files.images import IMAGE_SUFFIXES
from glassplat.files.ply_table import read_table

WHOLE, TRAIN, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"
LOOKED_FOR = f"{WHOLE}, or {TRAIN} with or without {TEST}"
POINT_FILES = ("points3d.ply", "points3D.ply", "sparse_pc.ply")
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

Settings = Mapping[str, Any]


def load_transforms(root: Path) -> Capture | None:
    """Read `transforms.json`, or the train and test files of a synthetic scene; None when there is neither.

    Raises:
        InputError: no valid JSON, missing photographs, poses or intrinsics; names the file.
    """
    if (root / TRAIN).is_file():
        return _load_split(root)
    if (root / WHOLE).is_file():
        return _load_whole(root)
    return None


def _load_whole(root: Path) -> Capture:
    """One file for all photographs, which may name its own split."""
    settings = _read_settings(root / WHOLE)
    shots = _shots(root, settings, WHOLE)
    train, test, warnings = _own_split(shots, settings)
    if any("mask_path" in frame for frame in settings["frames"]):
        warnings.append("mask_path says which pixels are valid, not where panes are; it is not used.")
    return Capture(
        shots=train,
        test_shots=test,
        points=_read_points(root, settings),
        format_name=WHOLE,
        warnings=tuple(warnings),
    )


def _load_split(root: Path) -> Capture:
    """Separate files for training and testing, as synthetic scenes have them."""
    settings = _read_settings(root / TRAIN)
    test = _shots(root, _read_settings(root / TEST), TEST) if (root / TEST).is_file() else None
    return Capture(
        shots=tuple(_shots(root, settings, TRAIN).values()),
        test_shots=None if test is None else tuple(test.values()),
        points=_read_points(root, settings),
        format_name=TRAIN,
        random_points=points_in_box if _is_blender(settings) else None,
    )


def _is_blender(settings: Settings) -> bool:
    """Blender scripts write the opening angle and nothing else about the lens."""
    return "camera_angle_x" in settings and "fl_x" not in settings and "w" not in settings


def _read_settings(path: Path) -> dict[str, Any]:
    """The contents of one file, with at least one frame."""
    try:
        settings = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError(f"{path} is no valid JSON ({error}); write it again") from error
    frames = settings.get("frames") if isinstance(settings, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{path} lists no frames; expected an object with a list `frames` of at least one photograph")
    return settings


def _shots(root: Path, settings: Settings, file_name: str) -> dict[str, Shot]:
    """Every frame by its `file_path`, with an error that lists the photographs that are missing."""
    paths = [_image_path(root, frame, file_name) for frame in settings["frames"]]
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


def _image_path(root: Path, frame: Settings, file_name: str) -> Path:
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


def _own_split(
    shots: Mapping[str, Shot], settings: Settings
) -> tuple[tuple[Shot, ...], tuple[Shot, ...] | None, list[str]]:
    """Training and test photographs as nerfstudio lists them in the file, or all and None; and warnings."""
    train_names = settings.get("train_filenames")
    test_names = settings.get("test_filenames") or settings.get("val_filenames")
    if not train_names or not test_names:
        return tuple(shots.values()), None, []
    unknown = sorted({*train_names, *test_names} - set(shots))
    if unknown:
        raise InputError(f"the split of {WHOLE} names photographs that have no frame: {first_names(unknown)}")
    test = tuple(shots[name] for name in test_names)
    train = tuple(shots[name] for name in train_names if name not in set(test_names))
    left_out = len(shots) - len(train) - len(test)
    return train, test, [f"{left_out} photographs are in neither part of the split and left out."] if left_out else []


def _read_points(root: Path, settings: Settings) -> PointCloud | None:
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
    try:
        columns = read_table(path).columns
    except ValueError as error:
        raise InputError(str(error)) from error
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
