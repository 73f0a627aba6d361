"""COLMAP captures: a sparse model, binary or text, next to a folder of images.

With label images `panes/<stem of the photograph>.png` for annotated photographs only, this layout also suits captures
of transparent panes such as RTR's, whose own files were never published.

Models are parsed here, because COLMAP's own reader returns garbage or hangs on truncated files.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from os.path import isfile, lexists
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray

from glassplat.captures.cameras import MODEL_OF_ID, PARAMETER_COUNTS, Lens, make_lens
from glassplat.captures.capture import Capture, RawPoints, Shot
from glassplat.captures.transforms import SINGLE_FILE, TRAIN_FILE
from glassplat.errors import InputError, convert_to_input_error, join_names
from glassplat.files.images import files_below
from glassplat.files.records import wrap_read_errors
from glassplat.options import short_repr

UNIT_TOLERANCE = 1e-2
"""Largest deviation of a quaternion's length from one, as rounding in a text file."""

_OBSERVATION_BYTES, _TRACK_BYTES = 24, 8
"""Bytes of an observation (x, y as doubles, id of a point) and of its entry in a track (id of an image, index)."""


@dataclass(frozen=True)
class ModelImage:
    """One registered image: name, camera, rotation `wxyz` and translation of `cam_from_world`."""

    name: str
    camera_id: int
    quat: tuple[float, ...]
    translation: tuple[float, ...]


@dataclass(frozen=True)
class SparseModel:
    """A sparse reconstruction; `lenses` are keyed by camera id."""

    lenses: dict[int, Lens]
    images: tuple[ModelImage, ...]
    points: RawPoints


def model_suffix(folder: Path) -> str | None:
    """`.bin` or `.txt` if the folder holds a model of that kind; binary takes precedence, as in COLMAP."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in ("cameras", "images")):
            return suffix
    return None


def read_model(folder: Path) -> SparseModel:
    """Read cameras, images and points; points may be in the other format (binary or text), or missing."""
    suffix = model_suffix(folder) or ".txt"
    cameras = _read_records(folder / f"cameras{suffix}")
    lenses: dict[int, Lens] = dict(cameras)
    if len(lenses) < len(cameras):
        path = folder / f"cameras{suffix}"
        raise InputError(f"{path} has two cameras of one id; expected every id once: export the model again")
    images = tuple(_read_records(folder / f"images{suffix}"))
    if not images:
        raise InputError(f"{folder / f'images{suffix}'} registers no photograph; expected a finished reconstruction")
    candidates = [folder / f"points3D{kind}" for kind in (suffix, ".bin", ".txt")]
    points_path = next(filter(lexists, candidates), candidates[0])
    rows = _read_records(points_path) if lexists(points_path) else []
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    with convert_to_input_error(points_path):
        return SparseModel(lenses, images, RawPoints.from_arrays(table[:, :3], table[:, 3:]))


def pose_matrix(image: ModelImage) -> NDArray[np.float64]:
    """[4, 4] `cam_from_world`, OpenCV axes."""
    if not abs(math.hypot(*image.quat) - 1) < UNIT_TOLERANCE:
        quat = list(image.quat)
        raise InputError(f"the rotation of {image.name} is {quat}; expected a finite unit quaternion (w, x, y, z)")
    w, x, y, z = np.array(image.quat) / math.hypot(*image.quat)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = image.translation
    return pose


def _read_records(path: Path) -> list[Any]:
    """All records in one file of a model; errors name the file."""
    binary, text = PARSERS[path.stem]
    try:
        with wrap_read_errors(path):
            if path.suffix == ".bin":
                return list(binary(_ByteReader(path.read_bytes())))
            with path.open(encoding="utf-8-sig") as stream:
                return list(text(stream))
    except FileNotFoundError as error:
        raise InputError(str(error)) from error
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
    except UnicodeDecodeError as error:
        name = error.object[: error.start].rpartition(b" ")[2] + error.object[error.start :].partition(b"\n")[0]
        raise InputError(
            f"{path} holds the name {name[:80]!r}, which is not valid UTF-8; rename the photograph, there and in its "
            "folder, or export the COLMAP model again"
        ) from error
    except (struct.error, EOFError, ValueError, IndexError, OverflowError) as error:
        raise InputError(f"{path} is cut off or damaged ({error}); export the COLMAP model again") from error


class _ByteReader:
    """A cursor over a binary file."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.offset = 0

    def take(self, layout: str) -> tuple[Any, ...]:
        start = self.offset
        self.skip(struct.calcsize(f"<{layout}"))
        return struct.unpack_from(f"<{layout}", self.data, start)

    def skip(self, count: int) -> None:
        self.offset += count
        if self.offset > len(self.data):
            raise EOFError("it ends too early")

    def text(self) -> str:
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            raise EOFError("it ends within a name")
        start, self.offset = self.offset, end + 1
        return self.data[start:end].decode()


def _binary_cameras(data: _ByteReader) -> Iterator[tuple[int, Lens]]:
    (count,) = data.take("Q")
    for _ in range(count):
        camera_id, model_id, width, height = data.take("IiQQ")
        model = MODEL_OF_ID.get(model_id)
        if model is None:
            raise ValueError(f"it has a camera model of number {model_id}; expected 0 to {max(MODEL_OF_ID)}")
        parameters = data.take(f"{PARAMETER_COUNTS[model].total}d")
        yield camera_id, make_lens(model, list(parameters), (width, height))


def _binary_images(data: _ByteReader) -> Iterator[ModelImage]:
    (count,) = data.take("Q")
    for _ in range(count):
        values = data.take("I7dI")
        name = data.text()
        (observations,) = data.take("Q")
        data.skip(observations * _OBSERVATION_BYTES)
        yield ModelImage(name, values[8], values[1:5], values[5:8])


def _binary_points(data: _ByteReader) -> Iterator[tuple[float, ...]]:
    (count,) = data.take("Q")
    for _ in range(count):
        values = data.take("Q3d3BdQ")
        data.skip(values[8] * _TRACK_BYTES)
        yield values[1:7]


def _record_lines(stream: Iterator[str]) -> Iterator[str]:
    """Lines that are neither empty nor comments."""
    stripped = (line.strip() for line in stream)
    return (line for line in stripped if line and not line.startswith("#"))


def _require_fields(count: int, fields: list[str]) -> list[str]:
    """The fields of a line; checks their minimum number."""
    if len(fields) < count:
        line = " ".join(fields)
        raise ValueError(f"the line {short_repr(line)}; expected at least {count} values, separated by spaces")
    return fields


def _text_cameras(stream: Iterator[str]) -> Iterator[tuple[int, Lens]]:
    for line in _record_lines(stream):
        camera_id, model, width, height, *parameters = _require_fields(4, line.split())
        yield int(camera_id), make_lens(model, [float(value) for value in parameters], (int(width), int(height)))


def _text_images(stream: Iterator[str]) -> Iterator[ModelImage]:
    for line in _record_lines(stream):
        fields = _require_fields(10, line.split(maxsplit=9))
        numbers = tuple(float(value) for value in fields[1:8])
        name = fields[9]
        _check_observations(next(stream, ""), name)
        yield ModelImage(name, int(fields[8]), numbers[:4], numbers[4:])


def _check_observations(line: str, name: str) -> None:
    """Check the line after an image: x, y and point id of each observation; empty if there are none.

    If it were missing, the next image would be read as the list, and be lost.
    """
    words = line.split()
    if len(words) % 3 or not (not words or words[-1].lstrip("-").isdigit()):
        raise InputError(
            f"the line after {name} is not a list of observations; expected one after every image, even if it is empty"
        )


def _text_points(stream: Iterator[str]) -> Iterator[tuple[float, ...]]:
    for line in _record_lines(stream):
        _, x, y, z, red, green, blue = _require_fields(7, line.split(maxsplit=7))[:7]
        yield (float(x), float(y), float(z), float(int(red)), float(int(green)), float(int(blue)))


PARSERS: dict[str, tuple[Callable[[_ByteReader], Iterator[Any]], Callable[[Iterator[str]], Iterator[Any]]]] = {
    "cameras": (_binary_cameras, _text_cameras),
    "images": (_binary_images, _text_images),
    "points3D": (_binary_points, _text_points),
}

MODEL_FOLDERS = ("sparse/0", "sparse", ".")
FORMAT_DESCRIPTION = "a COLMAP model (cameras and images as .bin or .txt in sparse/0, sparse or the folder itself)"


def load_colmap(root: Path) -> Capture | None:
    """Read a COLMAP capture with photographs in `images/`; None if there is no model."""
    folder = next((root / name for name in MODEL_FOLDERS if model_suffix(root / name)), None)
    if folder is None:
        return None
    model = read_model(folder)
    shots = _shots(root, model)
    return Capture(
        shots=shots,
        test_shots=None,
        points=model.points if len(model.points) else None,
        format_name="COLMAP",
        warnings=tuple(_unread_warnings(root, folder)),
        ignores_transparent=True,
    )


def _shots(root: Path, model: SparseModel) -> tuple[Shot, ...]:
    """All registered images; the error for missing photographs counts them."""
    images = root / "images"
    if not images.is_dir():
        raise InputError(
            f"no folder {images} next to the COLMAP model; expected the {len(model.images)} photographs there"
        )
    names = _names_on_disk(images, [image.name for image in model.images])
    missing = sorted(name for name in names if not isfile(images / name))
    if missing:
        raise InputError(
            f"{images} lacks {len(missing)} of the {len(model.images)} photographs of the COLMAP model: "
            f"{join_names(missing)}; copy them there, or remove them from the model"
        )
    orphans = sorted(image.name for image in model.images if image.camera_id not in model.lenses)
    if orphans:
        raise InputError(f"photographs whose camera is not in the COLMAP model: {join_names(orphans)}; export it again")
    return tuple(
        Shot(name, images / name, model.lenses[image.camera_id], pose_matrix(image))
        for name, image in zip(names, model.images, strict=True)
    )


def _names_on_disk(images: Path, names: list[str]) -> list[str]:
    """The names as spelled on disk, where masks follow them; some macOS programs decompose accented letters."""
    if all(isfile(images / name) for name in names):
        return names
    spelled = {normalize("NFC", name): name for name in (p.relative_to(images).as_posix() for p in files_below(images))}
    return [name if isfile(images / name) else spelled.get(normalize("NFC", name), name) for name in names]


def _unread_warnings(root: Path, used: Path) -> Iterator[str]:
    """Warnings of further models, because COLMAP splits what it cannot connect, and of a `transforms.json`.

    Only one model can be trained at a time; a `transforms.json` may define another split.
    """
    sparse = root / "sparse"
    folders = [path for path in sparse.iterdir() if path.is_dir()] if sparse.is_dir() else []
    others = sorted(folder.name for folder in folders if folder != used and model_suffix(folder))
    if others:
        yield f"{used} is used; there are more models in {sparse} ({join_names(others)}), which are ignored."
    unread = [name for name in (SINGLE_FILE, TRAIN_FILE) if (root / name).is_file()]
    if unread:
        yield (
            f"The COLMAP model of {root} is read, and not {join_names(unread)}: neither its poses, nor its split, nor "
            "its masks. Move one of them away."
        )
