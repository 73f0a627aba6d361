"""`transforms.json` captures, as written by instant-ngp, nerfstudio and Blender scripts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from glassplat.data.capture import Capture, Shot
from glassplat.data.errors import InputError, first_names
from glassplat.data.random_points import points_in_box
from glassplat.data.transforms_file import Settings, read_points, read_settings, shots_of

WHOLE, TRAIN, TEST = "transforms.json", "transforms_train.json", "transforms_test.json"
LOOKED_FOR = f"{WHOLE}, or {TRAIN} with or without {TEST}"


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
    settings = read_settings(root / WHOLE)
    shots = shots_of(root, settings, WHOLE)
    train, test, warnings = _own_split(shots, settings)
    if any("mask_path" in frame for frame in settings["frames"]):
        warnings.append("mask_path says which pixels are valid, not where panes are; it is not used.")
    return Capture(
        shots=train,
        test_shots=test,
        points=read_points(root, settings),
        format_name=WHOLE,
        warnings=tuple(warnings),
    )


def _load_split(root: Path) -> Capture:
    """Separate files for training and testing, as synthetic scenes have them."""
    settings = read_settings(root / TRAIN)
    test = shots_of(root, read_settings(root / TEST), TEST) if (root / TEST).is_file() else None
    return Capture(
        shots=tuple(shots_of(root, settings, TRAIN).values()),
        test_shots=None if test is None else tuple(test.values()),
        points=read_points(root, settings),
        format_name=TRAIN,
        random_points=points_in_box if _is_blender(settings) else None,
    )


def _is_blender(settings: Settings) -> bool:
    """Blender scripts write the opening angle and nothing else about the lens."""
    return "camera_angle_x" in settings and "fl_x" not in settings and "w" not in settings


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
