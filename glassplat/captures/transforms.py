"""`transforms.json` captures, as written by instant-ngp, nerfstudio and Blender scripts.

Their poses are camera-to-world in OpenGL axes (+y up, -z forward), and are converted only here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from os.path import abspath, commonpath, dirname, isfile, lexists, normpath, realpath
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from glassplat.captures.cameras import LARGEST_SIDE, Lens, make_lens, rigid_pose
from glassplat.captures.capture import Capture, RawPoints, Shot
from glassplat.errors import InputError, convert_to_input_error, count_noun, join_names
from glassplat.files import records
from glassplat.files.images import IMAGE_SUFFIXES, image_size
from glassplat.files.ply_table import point_colors, read_table

if TYPE_CHECKING:
    from glassplat.scene.camera import Camera

GREY, SEED = 128, 0
"""Colour and seed of random points."""
SPHERE_COUNT, BOX_COUNT, BOX_HALF_SIZE = 20_000, 100_000, 1.3
"""Numbers of random points in a sphere, and in the cube of synthetic scenes; half the side of this cube."""
MOST_HALF_SIZES = 10.0
"""Distance of cameras from which the cube is a small part of the picture; synthetic scenes have three half sizes."""
LEAST_CROSSING = 1e-2
"""Smallest eigenvalue of the mean of I - d d^T for which optical axes count as crossing (about 6 degrees apart)."""
MOST_CAMERAS = 0.8
"""Share of the cameras that must face the crossing; fewer do in a room photographed from its centre."""
AHEAD = 3.0
"""Distance ahead of the cameras at which points are placed otherwise, in radii of the camera path."""


def points_in_box(count: int = BOX_COUNT) -> RawPoints:
    """Uniform points in the cube about the origin that contains synthetic Blender scenes."""
    positions = np.random.default_rng(SEED).uniform(-BOX_HALF_SIZE, BOX_HALF_SIZE, (count, 3))
    return RawPoints.from_arrays(positions, np.full((count, 3), GREY))


def points_in_view(cameras: Sequence[Camera]) -> RawPoints:
    """Uniform points in a ball about the point that the cameras face; its radius is their median distance."""
    centers = np.stack([camera.center.double().numpy() for camera in cameras])
    forward = np.stack([camera.cam_from_world[2, :3].double().numpy() for camera in cameras])
    target, radius = _focus_ball(centers, forward)
    generator = np.random.default_rng(SEED)
    directions = generator.normal(size=(SPHERE_COUNT, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = radius * generator.uniform(size=(SPHERE_COUNT, 1)) ** (1 / 3)
    return RawPoints.from_arrays(target + distances * directions, np.full((SPHERE_COUNT, 3), GREY))


def _focus_ball(centers: NDArray[np.float64], forward: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Centre and radius: at the crossing of the optical axes, or ahead of the cameras if the axes do not cross."""
    projectors = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    mean = projectors.mean(axis=0)
    if np.linalg.eigvalsh(mean)[0] > LEAST_CROSSING:
        target = np.linalg.solve(mean, (projectors @ centers[:, :, None])[:, :, 0].mean(axis=0))
        ahead = ((target - centers) * forward).sum(axis=1)
        if np.mean(ahead > 0) > MOST_CAMERAS:
            return target, float(np.median(np.linalg.norm(centers - target, axis=1)))
    middle = centers.mean(axis=0)
    reach = AHEAD * float(np.linalg.norm(centers - middle, axis=1).max())
    return middle + reach * forward.mean(axis=0), reach


FISHEYE = "OPENCV_FISHEYE"
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
DISTORTION_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")
"""Order of `distortion_params`, as in nerfstudio."""
LENS: dict[str, records.Field] = {
    "camera_model": records.Optional(records.Choice((*PERSPECTIVE, FISHEYE))),
    "is_fisheye": records.Optional(records.Boolean(), default=False),
    **dict.fromkeys(("w", "h"), records.Optional(records.Number(1, LARGEST_SIDE))),
    **dict.fromkeys(("fl_x", "fl_y"), records.Optional(records.Number(above=0))),
    **dict.fromkeys(("camera_angle_x", "camera_angle_y"), records.Optional(records.Number(above=0, most=math.pi))),
    **dict.fromkeys(("cx", "cy"), records.Optional(records.Number())),
    **dict.fromkeys(COEFFICIENTS, records.Optional(records.Number(), default=0.0)),
    "distortion_params": records.Optional(records.ListOf(records.Number(), len(DISTORTION_PARAMS))),
}


MOST_AS_SHARE = 2.0
"""Focal length up to which it is a share of the image size, not pixels."""


def lens_from_settings(settings: Mapping[str, Any], image_path: Path, name: str) -> Lens:
    """The lens of one frame.

    Focal length: `fl_x`, `fl_y`, or the opening angles `camera_angle_x`, `camera_angle_y` in radians. Principal
    point: `cx`, `cy`, or the image centre. Size: `w`, `h`, or that of the image. Distortion: `k1` ... `k6`, `p1`, `p2`,
    as in OpenCV; or `distortion_params`, a list of k1 to k4, p1 and p2, which takes precedence.
    """
    with convert_to_input_error():
        found = records.check_fields(settings, LENS, f"the lens of {name}")
        given = found["w"] is not None and found["h"] is not None
        width, height = (round(found["w"]), round(found["h"])) if given else image_size(image_path)
        fx, fy = _focal_lengths(found, width, height, name)
    found |= zip(DISTORTION_PARAMS, found["distortion_params"] or (), strict=False)
    model = found["camera_model"] or (FISHEYE if found["is_fisheye"] else "OPENCV")
    middle = [half if at is None else at for at, half in ((found["cx"], width / 2), (found["cy"], height / 2))]
    if max(fx, fy) <= MOST_AS_SHARE or all(0 <= at <= 1 for at in middle):
        raise InputError(
            f"the lens of {name} has the focal length {fx:g}, {fy:g} and the principal point {middle[0]:g}, "
            f"{middle[1]:g}; expected pixels of an image of {width}x{height}, and these look like shares of its sides: "
            "multiply fl_x and cx by the width, fl_y and cy by the height"
        )
    try:
        return _lens(str(model), [fx, fy, *middle], [found[key] for key in COEFFICIENTS], (width, height))
    except InputError as error:
        raise InputError(f"the lens of {name}: {error}") from error


def _lens(model: str, pinhole: list[float], coefficients: list[float], size: tuple[int, int]) -> Lens:
    """The simplest of COLMAP's models that has all non-zero coefficients."""
    k1, k2, k3, k4, k5, k6, p1, p2 = coefficients
    if model == FISHEYE:
        return make_lens(FISHEYE, [*pinhole, k1, k2, k3, k4], size)
    if any((k3, k4, k5, k6)):
        return make_lens("FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, k4, k5, k6], size)
    if any((k1, k2, p1, p2)):
        return make_lens("OPENCV", [*pinhole, k1, k2, p1, p2], size)
    return make_lens("PINHOLE", pinhole, size)


def _focal_lengths(found: Mapping[str, Any], width: int, height: int, name: str) -> tuple[float, float]:
    """fx and fy in pixels, from lengths or else from opening angles; if only one is given, it is used for both."""
    along_x, along_y = (
        0.5 * size / math.tan(0.5 * angle_rad) if length is None and angle_rad is not None else length
        for length, angle_rad, size in (
            (found["fl_x"], found["camera_angle_x"], width),
            (found["fl_y"], found["camera_angle_y"], height),
        )
    )
    fx, fy = along_x or along_y, along_y or along_x
    if not fx or not fy:
        raise ValueError(
            f"the lens of {name} has no focal length; expected fl_x in pixels or camera_angle_x in radians"
        )
    return fx, fy


POINT_FILES = ("points3d.ply", "points3D.ply", "sparse_pc.ply")
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

Settings = Mapping[str, Any]
FRAME: dict[str, records.Field] = {
    "file_path": records.Text(),
    "transform_matrix": records.ListOf(records.ListOf(records.COORDINATE, 4)),
    "mask_path": records.Optional(records.Text()),
}
FILE: dict[str, records.Field] = {
    "ply_file_path": records.Optional(records.Text()),
    "train_filenames": records.Optional(records.ListOf(records.Text())),
    "val_filenames": records.Optional(records.ListOf(records.Text())),
    "test_filenames": records.Optional(records.ListOf(records.Text())),
}
"""Fields read in addition to the lens (`LENS`); other fields of the file are ignored."""


def _without_nulls(value: Any) -> Any:
    """An object without its optional fields that are null, as some programs write what is absent."""
    if not isinstance(value, dict):
        return value
    required = {name for name, field in FRAME.items() if not isinstance(field, records.Optional)}
    return {key: one for key, one in value.items() if one is not None or key in required}


def read_settings(path: Path) -> dict[str, Any]:
    """Contents of one file; checks that there are frames, each with a photograph and a matrix."""
    with convert_to_input_error():
        settings = _without_nulls(records.read_json(path))
        frames = settings.get("frames") if isinstance(settings, dict) else None
        if not isinstance(frames, list) or not frames:
            raise ValueError(f"{path} lists no frames; expected a list `frames` of at least one photograph")
        settings["frames"] = [_without_nulls(frame) for frame in frames]
        for index, frame in enumerate(settings["frames"], start=1):
            records.check_fields(frame, FRAME, f"frame {index} of {path}")
        records.check_fields(settings, FILE, str(path))
    return settings


def make_shots(root: Path, settings: Settings, file_name: str) -> dict[str, Shot]:
    """All frames by their `file_path`; the error for missing photographs lists them."""
    paths = [image_path(root, frame) for frame in settings["frames"]]
    missing = [path.name for path in paths if not isfile(path)]
    if missing:
        raise InputError(
            f"{root} lacks {len(missing)} of the {len(paths)} photographs of {file_name}: {join_names(missing)}; copy "
            "them to file_path, or delete their entries from `frames`"
        )
    shots = {}
    for frame, path, name in zip(settings["frames"], paths, _photograph_names(root, paths), strict=True):
        lens = lens_from_settings(_merge_frame_settings(settings, frame), path, name)
        if frame["file_path"] in shots:
            raise InputError(f"{root / file_name} has two frames for {frame['file_path']}; keep one")
        shots[frame["file_path"]] = Shot(name, path, lens, _cam_from_world(frame, name))
    return shots


def _merge_frame_settings(settings: Settings, frame: Settings) -> Settings:
    """Settings of a frame: its own override the file's, and its opening angle overrides the file's focal length."""
    lengths, angles = {"fl_x", "fl_y"}, {"camera_angle_x", "camera_angle_y"}
    overridden = lengths | angles if angles & frame.keys() and not lengths & frame.keys() else set()
    return {**{key: value for key, value in settings.items() if key not in overridden}, **frame}


def image_path(root: Path, frame: Settings) -> Path:
    """Path of the photograph of one frame; Blender omits the suffix."""
    path = normpath(root / _normalise_path(frame["file_path"]))
    candidates = [path, *(path + suffix for suffix in IMAGE_SUFFIXES)]
    return Path(next((candidate for candidate in candidates if isfile(candidate)), path))


def _photograph_names(root: Path, paths: Sequence[Path]) -> list[str]:
    """Names of the photographs; if they are ambiguous, relative to the folder that contains all of them."""
    names = [_photograph_name(root, path) for path in paths]
    if len(set(names)) == len(set(paths)):
        return names
    whole = [abspath(path) for path in paths]
    return [Path(path).relative_to(commonpath(map(dirname, whole))).as_posix() for path in whole]


def _photograph_name(root: Path, path: Path) -> str:
    """Name of a photograph: its path relative to `images/` or the capture, or else its file name.

    Both paths may be relative, absolute, or contain links.
    """
    for spelled in (normpath, abspath, realpath):
        folder, photograph = Path(spelled(root)), Path(spelled(path))
        for above in (folder / "images", folder):
            if photograph.is_relative_to(above):
                return photograph.relative_to(above).as_posix()
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
    """Points from the file named in the settings, or from one with a customary name; None if there is none."""
    named = settings.get("ply_file_path")
    if named is not None and not isfile(root / named):
        raise InputError(f"ply_file_path names {root / named}, which does not exist; copy it there or delete the entry")
    candidates = [named] if named is not None else [name for name in POINT_FILES if lexists(root / name)]
    if not candidates:
        return None
    path = root / candidates[0]
    if not isfile(path):
        raise InputError(f"{path} is not a readable file; replace or remove it")
    with convert_to_input_error():
        columns = read_table(path).columns
    lacking = [axis for axis in "xyz" if axis not in columns]
    if lacking:
        raise InputError(f"{path} has no vertex property {join_names(lacking)}; expected a point cloud with x, y and z")
    positions = np.stack([columns[axis] for axis in "xyz"], axis=1)
    colors = point_colors(columns)
    if colors is None:
        colors = np.full(positions.shape, GREY)
    with convert_to_input_error(path):
        return RawPoints.from_arrays(positions, colors) if len(positions) else None


SINGLE_FILE = "transforms.json"
TRAIN_FILE, VAL_FILE, TEST_FILE = (f"transforms_{part}.json" for part in ("train", "val", "test"))
FORMAT_DESCRIPTION = f"{SINGLE_FILE}, or {TRAIN_FILE} with or without {TEST_FILE} or {VAL_FILE}"


def load_transforms(root: Path) -> Capture | None:
    """Read `transforms.json`, or the train and test files of a synthetic scene; None if there is neither."""
    if (root / TRAIN_FILE).is_file():
        return _load_split(root)
    if (root / SINGLE_FILE).is_file():
        return _load_whole(root)
    return None


def _load_whole(root: Path) -> Capture:
    """Capture from one file for all photographs, which may define its own split."""
    settings = read_settings(root / SINGLE_FILE)
    shots = make_shots(root, settings, SINGLE_FILE)
    train, test, warnings = _listed_split(shots, settings)
    return Capture(
        shots=train,
        test_shots=test,
        points=read_points(root, settings),
        format_name=SINGLE_FILE,
        warnings=(*warnings, *_unused_priors(settings)),
        keep_masks=_mask_paths(root, SINGLE_FILE, settings, shots),
    )


def _load_split(root: Path) -> Capture:
    """Capture from separate files for training and testing (or else validation), as in synthetic scenes."""
    tested = TEST_FILE if (root / TEST_FILE).is_file() else VAL_FILE
    files = {name: read_settings(root / name) for name in (TRAIN_FILE, tested) if (root / name).is_file()}
    if VAL_FILE in files and not all(image_path(root, frame).is_file() for frame in files[VAL_FILE]["frames"]):
        del files[VAL_FILE]  # Its photographs are often left out of a copy.
    shots = {name: make_shots(root, settings, name) for name, settings in files.items()}
    kept: dict[str, Path] = {}
    for name, settings in files.items():
        kept |= _mask_paths(root, name, settings, shots[name])
    held_out = {shot.image_path for shot in shots.get(VAL_FILE, {}).values()}
    return Capture(
        shots=tuple(shot for shot in shots[TRAIN_FILE].values() if shot.image_path not in held_out),
        test_shots=tuple(shots[tested].values()) if tested in shots else None,
        points=read_points(root, files[TRAIN_FILE]),
        format_name=TRAIN_FILE,
        random_points=points_in_box if _surrounds_box(files[TRAIN_FILE], shots[TRAIN_FILE]) else None,
        warnings=(*_unused_priors(files[TRAIN_FILE]), *([NO_TEST_FILE_WARNING] if VAL_FILE in shots else ())),
        keep_masks=kept,
    )


NO_TEST_FILE_WARNING = (
    f"There is no {TEST_FILE}; the test views are those of {VAL_FILE}, and are not used for training. Move it away to "
    "continue a run that was started without it."
)


def _mask_paths(root: Path, file: str, settings: Settings, shots: Mapping[str, Shot]) -> dict[str, Path]:
    """Masks named by the frames of a file, by name of the photograph."""
    paths = {
        shots[frame["file_path"]].name: Path(normpath(root / _normalise_path(frame["mask_path"])))
        for frame in settings["frames"]
        if frame.get("mask_path")
    }
    missing = [str(path) for path in paths.values() if not isfile(path)]
    if missing:
        raise InputError(
            f"mask_path of {file} names masks that are missing: {join_names(missing)}; copy them "
            "there, or delete the entries"
        )
    return paths


PRIORS = {
    "depth_file_path": "depths are not used",
    "normal_file_path": "estimated normals are read from a folder normals/ next to the photographs",
}
"""Further files that frames of nerfstudio and related programs name, and their treatment here."""


def _unused_priors(settings: Settings) -> list[str]:
    """Warnings about files that frames name and that are not read."""
    counts = {key: sum(bool(frame.get(key)) for frame in settings["frames"]) for key in PRIORS}
    return [
        f"{key} of {count_noun(count, 'frame')} is left out: {PRIORS[key]}." for key, count in counts.items() if count
    ]


def _surrounds_box(settings: Settings, shots: Mapping[str, Shot]) -> bool:
    """Return whether a Blender script wrote the file, and the cameras are as far from the cube as in synthetic scenes.

    The lens of such a file has nothing but the opening angle; half of the cameras decide. The cube is that of
    `points_in_box`.
    """
    is_blender = "camera_angle_x" in settings and "fl_x" not in settings and "w" not in settings
    distance = float(np.median([np.linalg.norm(shot.cam_from_world[:3, 3]) for shot in shots.values()]))
    return is_blender and BOX_HALF_SIZE < distance < MOST_HALF_SIZES * BOX_HALF_SIZE


def _listed_split(
    shots: Mapping[str, Shot], settings: Settings
) -> tuple[tuple[Shot, ...], tuple[Shot, ...] | None, list[str]]:
    """Training and test photographs as listed by nerfstudio, or all and None without a list; and warnings.

    Without a training list, all photographs outside the test list are used; without a test list, none are tested.
    """
    listed = settings.get("train_filenames"), settings.get("test_filenames") or settings.get("val_filenames")
    train_names, test_names = ([_normalise_path(name) for name in names or ()] for names in listed)
    if not train_names and not test_names:
        return tuple(shots.values()), None, []
    by_path = {_normalise_path(name): shot for name, shot in shots.items()}
    unknown = sorted({*train_names, *test_names} - set(by_path))
    if unknown:
        raise InputError(f"the split of {SINGLE_FILE} names photographs that have no frame: {join_names(unknown)}")
    test = tuple(by_path[name] for name in test_names)
    train = tuple(by_path[name] for name in train_names or by_path if name not in set(test_names))
    left_out = len(shots) - len(train) - len(test)
    warning = f"Ignored: {count_noun(left_out, 'photograph')} in neither part of the split."
    return train, test, [warning] if left_out else []


def _normalise_path(name: str) -> str:
    """A normalised path: `./images/1.png` becomes `images/1.png`."""
    return normpath(name.replace("\\", "/"))
