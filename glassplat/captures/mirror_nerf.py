"""Mirror-NeRF captures: `transforms_train.json` and its siblings, with one mirror mask per photograph.

Public readers agree on the layout, but not on the axes:

```
transforms_{train,val,test}.json   an explicit split; transforms.json with all frames may lie next to them
masks/<name of the photograph>     real scenes; white is the mirror, one half is the threshold, some may be missing
masks/MirrorMask_0001.png          synthetic scenes, for the photograph Image_0001
```

The matrices are camera-to-world. The authors' reader treats them as OpenGL axes, like all other `transforms.json`
files; another reader treats them as OpenCV axes. OpenGL is assumed and checked against the mirror masks, because the
mirror must lie in front of the cameras; OpenCV axes are used if only they fit. Neither could be tested on the authors'
own files.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from glassplat.captures import transforms
from glassplat.captures.capture import Capture, RawPoints, Shot
from glassplat.captures.masks import MASK_FOLDER, PANE_FOLDER, Mask, read_pane_labels
from glassplat.errors import InputError, convert_to_input_error, count_noun, join_names
from glassplat.files.images import IMAGE_SUFFIXES, image_size

if TYPE_CHECKING:
    from glassplat.captures.axes import AxesEvidence

FORMAT_DESCRIPTION = f"a Mirror-NeRF scene ({transforms.TRAIN_FILE} and {MASK_FOLDER}/)"
SYNTHETIC_MASK = "MirrorMask_"
SAME_SIZE = 0.1
"""Relative deviation up to which twice the principal point counts as the size of the photograph."""


def load_mirror_nerf(root: Path) -> Capture | None:
    """Read a Mirror-NeRF scene; None if the folder holds another format.

    It differs from other `transforms_train.json` captures by a folder of masks and one of two features. Either the
    masks are named `MirrorMask_*`; or intrinsics are given as `fx` or as a matrix, and there is no folder of panes.
    Test views come from the test file, or else the validation file; photographs listed for both are used for testing
    only.
    """
    if not _is_mirror_nerf(root):
        return None
    settings = transforms.read_settings(root / transforms.TRAIN_FILE)
    train = _shots(root, settings, transforms.TRAIN_FILE)
    test_file = next((name for name in (transforms.TEST_FILE, transforms.VAL_FILE) if (root / name).is_file()), None)
    test = _shots(root, transforms.read_settings(root / test_file), test_file) if test_file else None
    tested = {shot.name for shot in test or ()}
    kept = tuple(shot for shot in train if shot.name not in tested)
    warnings = []
    if len(kept) < len(train):
        warnings.append(f"Not trained on: {count_noun(len(train) - len(kept), 'photograph')} of the test split, too.")
    masks = _masks(root, (*kept, *(test or ())))
    points = transforms.read_points(root, settings)
    capture = Capture(kept, test, points, "Mirror-NeRF", tuple(warnings), masks=masks)
    return _correct_axes(capture, _axes_evidence(kept, masks, points))


def _is_mirror_nerf(root: Path) -> bool:
    masks = root / MASK_FOLDER
    if not (root / transforms.TRAIN_FILE).is_file() or not masks.is_dir():
        return False
    if next(masks.glob(f"{SYNTHETIC_MASK}*"), None) is not None:
        return True
    if (root / PANE_FOLDER).is_dir():
        return False
    settings = transforms.read_settings(root / transforms.TRAIN_FILE)
    return "fx" in settings or "intrinsics" in settings["frames"][0]


def _shots(root: Path, settings: transforms.Settings, file_name: str) -> tuple[Shot, ...]:
    """The photographs of one split, with the intrinsics under the keys of `transforms.json`."""
    frames = [_normalise_frame(root, settings, frame) for frame in settings["frames"]]
    return tuple(transforms.make_shots(root, {**settings, "frames": frames}, file_name).values())


def _normalise_frame(root: Path, settings: transforms.Settings, frame: transforms.Settings) -> dict[str, Any]:
    """One frame with the actual path of its photograph, and `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h` in its pixels."""
    path = transforms.image_path(root, frame)
    in_images = root / "images" / path.name
    if not path.is_file() and in_images.is_file():
        path = in_images
        frame = {**frame, "file_path": os.path.relpath(path, root)}
    intrinsics = _intrinsics({**settings, **frame}, path.name)
    if intrinsics is None or not path.is_file():
        return dict(frame)
    return {**frame, **_scale_intrinsics(path, intrinsics)}


def _intrinsics(settings: transforms.Settings, name: str) -> tuple[float, float, float, float] | None:
    """fx, fy, cx, cy as stored, from `intrinsics` or `fx`; None if only opening angles are given."""
    try:
        if "intrinsics" in settings:
            matrix = np.array(settings["intrinsics"], dtype=np.float64)
            return float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
        if "fx" in settings:
            fx = float(settings["fx"])
            return fx, float(settings.get("fy", fx)), float(settings["cx"]), float(settings["cy"])
    except (TypeError, ValueError, IndexError, KeyError) as error:
        raise InputError(
            f"the intrinsics of {name} cannot be read ({error!r}); expected a 3x3 matrix `intrinsics`, or fx, fy, "
            "cx, cy"
        ) from error
    return None


def _scale_intrinsics(path: Path, intrinsics: tuple[float, float, float, float]) -> dict[str, float]:
    """Intrinsics in the pixels of a photograph that may have been reduced after calibration.

    The size at calibration is not stored. The principal point lies near the centre, so twice its position estimates
    that size; if this is close to the photograph's size, the principal point is used as it is.
    """
    with convert_to_input_error():
        width, height = image_size(path)
    fx, fy, cx, cy = intrinsics
    across, down = 2 * cx / width, 2 * cy / height
    if not (across > 0 and abs(down / across - 1) < SAME_SIZE):
        raise InputError(
            f"{path.name} is {width}x{height} pixels, but its principal point ({cx:g}, {cy:g}) is the middle of "
            "an image of another shape; photographs rotated or cropped after calibration cannot be used"
        )
    scale = 1.0 if abs(across - 1) < SAME_SIZE else across
    return {"fl_x": fx / scale, "fl_y": fy / scale, "cx": cx / scale, "cy": cy / scale, "w": width, "h": height}


def _masks(root: Path, shots: tuple[Shot, ...]) -> dict[str, Path]:
    """Mask path by name of the photograph, if it has one; masks of photographs outside the split are skipped."""
    present = {path.name: path for path in sorted((root / MASK_FOLDER).iterdir()) if path.is_file()}
    found = {}
    for shot in shots:
        name = next((name for name in _mask_names(shot.image_path) if name in present), None)
        if name is not None:
            found[shot.name] = present[name]
    if not found:
        raise InputError(
            f"none of the {len(present)} files in {root / MASK_FOLDER} has the name of a photograph "
            f"({join_names(sorted(present)) or 'the folder is empty'}); expected names such as "
            f"{shots[0].image_path.name}"
        )
    return found


def _mask_names(photograph: Path) -> list[str]:
    """Possible file names of a photograph's mask, the most specific first."""
    number = photograph.stem.rpartition("_")[2]
    stems = (photograph.stem, f"{SYNTHETIC_MASK}{number}")
    return [photograph.name, *(stem + suffix for stem in stems for suffix in IMAGE_SUFFIXES)]


def _axes_evidence(shots: tuple[Shot, ...], masks: Mapping[str, Path], points: RawPoints | None) -> AxesEvidence | None:
    """Evidence for the axes of the poses, from some masks or else the points."""
    from glassplat.captures.axes import axes_evidence  # Needs PyTorch, unlike the other formats.
    from glassplat.captures.view import PointCloud, prepare_view

    read = partial(read_pane_labels, at_threshold=True)
    views = [prepare_view(s, Mask(masks[s.name], read) if s.name in masks else None)[0] for s in shots]
    return axes_evidence(views, None if points is None else PointCloud.of(points).positions)


def _correct_axes(capture: Capture, evidence: AxesEvidence | None) -> Capture:
    """The capture in the axes that fit the evidence."""
    if evidence is None:
        warning = "The axes of the poses cannot be determined; OpenGL is assumed, as in the authors' reader."
        return replace(capture, warnings=(*capture.warnings, warning))
    if evidence.fits_neither:
        raise InputError(
            f"the {evidence.source} lie in front of the cameras neither with OpenGL nor with OpenCV axes (shares "
            f"{evidence.as_read:.0%} and {evidence.flipped:.0%}); expected camera-to-world matrices, and masks that "
            "belong to the photographs of the same name"
        )
    if not evidence.contradicts:
        return capture
    warning = (
        f"The poses are read in OpenCV axes: with OpenGL axes {evidence.as_read:.0%} of the {evidence.source} lie in "
        f"front of the cameras, with OpenCV axes {evidence.flipped:.0%}."
    )

    def flip(shots: tuple[Shot, ...]) -> tuple[Shot, ...]:
        return tuple(replace(s, cam_from_world=transforms.OPENCV_FROM_OPENGL @ s.cam_from_world) for s in shots)

    test_shots = None if capture.test_shots is None else flip(capture.test_shots)
    warnings = (*capture.warnings, warning)
    return replace(capture, shots=flip(capture.shots), test_shots=test_shots, warnings=warnings)
