"""Sidecar files of a PLY: panes, cameras, per-photograph corrections, environments and panoramas."""

from __future__ import annotations

import errno
import json
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from os.path import isfile
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from glassplat.files import records
from glassplat.files.images import image_size, read_image_float, write_image
from glassplat.files.writing import atomic_write, make_folder, write_text
from glassplat.kernels.maths.images import linear_from_srgb, srgb_from_linear
from glassplat.options import CLEAR_GLASS, short_repr
from glassplat.scene.camera import Camera, quat_from_rotation
from glassplat.scene.corrections import Exposures, PerPhotograph, PoseCorrections
from glassplat.scene.panes import HIGHEST_LABEL, Planes
from glassplat.scene.scene import Environment

HEADER_KEY = "glassplat"
LONGEST_REASON = 200
"""Maximum number of characters of a library's message that are repeated."""


class TensorsFile(NamedTuple):
    """An open file: its header, and the library's object for reading tensors."""

    header: dict[str, Any]
    file: Any

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by name, copied: memory-mapped ones would keep Windows from replacing the file."""
        return {name: self.file.get_tensor(name).clone() for name in self.file.keys()}  # noqa: SIM118


def write_tensors(path: Path | str, tensors: Mapping[str, Tensor], header: Mapping[str, Any]) -> None:
    """Writes tensors and a header atomically.

    Raises:
        OSError: the disk is full or not writable; an older file at `path` is unchanged.
    """
    owned = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    with atomic_write(path) as temporary:
        temporary.touch()
        usual_mode = temporary.stat().st_mode  # The library restricts files to the owner, whatever the umask.
        try:
            save_file(owned, temporary, metadata={HEADER_KEY: json.dumps(header)})
        except SafetensorError as error:  # The library wraps errors of the operating system.
            raise system_error(str(error)) from error
        temporary.chmod(usual_mode)


def system_error(text: str) -> OSError:
    """The operating system's error with its errno, recovered from the text of a library's error."""
    # As written by libraries in Rust; on Windows with its own numbers.
    if match := re.search(r"\(os error (\d+)\)", text):
        return OSError(int(match[1]), text, None, int(match[1]))
    number = next((number for number in errno.errorcode if os.strerror(number) in text), None)
    return OSError(text) if number is None else OSError(number, text)


@contextmanager
def open_tensors(path: Path, file_format: str, what: str) -> Iterator[TensorsFile]:
    """Opens a file of `write_tensors`, and checks the format in its header.

    Args:
        path: the file.
        file_format: expected `format` in the header.
        what: kind of the file for messages, such as "an environment".
    """
    try:
        with records.wrap_read_errors(path), _unicode_name(path) as name, _open_safetensors(name) as file:
            header = records.parse_json((file.metadata() or {}).get(HEADER_KEY, "{}"), f"the header of {path}")
            if not isinstance(header, dict) or header.get("format") != file_format:
                found = header.get("format") if isinstance(header, dict) else header
                raise ValueError(f"{path} has format {found!r}; expected {file_format!r}, as glassplat writes it")
            yield TensorsFile(header, file)
    except SafetensorError as error:
        reason = str(error)[:LONGEST_REASON]  # It may contain the whole header.
        raise ValueError(f"{path} is truncated or not {what} ({reason}); expected a complete file") from error


@contextmanager
def _open_safetensors(path: Path) -> Iterator[Any]:
    """Opens a file with the library; retries if the file was replaced, because the library opens the path twice."""
    while True:
        before = _file_identity(path)
        try:
            file = safe_open(path, framework="pt")
        except (OSError, RuntimeError, SafetensorError):
            if _file_identity(path) == before:
                raise
            continue
        with file:
            if _file_identity(path) == before:
                yield file
                return


def _file_identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


@contextmanager
def _unicode_name(path: Path) -> Iterator[Path]:
    """A path that the library accepts: a temporary link if the name is not valid text."""
    if records.is_encodable(str(path)):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "link.safetensors"
        link.symlink_to(path.absolute())
        yield link


EDIT_TOLERANCE = 1e-5
"""Difference above which the readable value was edited by hand, and takes precedence over the raw one."""
Conversion = Callable[[Tensor], Tensor]
UNIT: Conversion = partial(torch.nn.functional.normalize, dim=0)
LOGIT_OF: Conversion = partial(torch.logit, eps=1e-6)
"""Logit of a reflectance, clamped because it may be 0 or 1."""
LEAST_LENGTH, LEAST_ANGLE = 1e-6, 1e-3
"""Smallest length of tangent and normal, and smallest angle between them, radians; below, the rectangle's sides are
undefined."""
LEAST_HALF_SIZE, LEAST_TRANSMITTANCE, LARGEST_TRANSMITTANCE = 1e-9, 1e-6, 1.0
"""Smallest half side, and range of the readable transmittance."""
VECTOR = records.ListOf(records.COORDINATE, 3)
LOGIT = records.Number(-1e3, 1e3)
PLANE: dict[str, records.Field] = {
    "label": records.Integer(1, HIGHEST_LABEL),
    "mirror": records.Optional(records.Boolean(), default=False),
    "center": VECTOR,
    "normal": VECTOR,
    "tangent": VECTOR,
    "half_sizes": records.ListOf(records.Number(LEAST_HALF_SIZE, records.LARGEST_COORDINATE), 2),
    "base_reflectance": records.Optional(records.Number(0, 1), default=CLEAR_GLASS),
    "raw_normal": records.Optional(VECTOR),
    "logit_reflectance": records.Optional(LOGIT),
    "transmittance": records.Optional(records.ListOf(records.Number(LEAST_TRANSMITTANCE, LARGEST_TRANSMITTANCE), 3)),
    "log_transmittance": records.Optional(records.ListOf(LOGIT, 3)),
}


def write_planes(path: Path | str, planes: Planes) -> None:
    """Writes `planes_json`, atomically; `read_planes` returns the same float32 bits.

    Raises:
        ValueError: a plane holds a value that is not finite.
    """
    write_text(path, planes_json(planes))


def planes_json(planes: Planes) -> str:
    """Planes as a JSON list.

    Each entry has label, mirror, center, normal (unit), tangent, half_sizes and base_reflectance for people and other
    programs (world units, the capture's frame), and the raw values raw_normal and logit_reflectance for continued
    training. If glass may be tinted, it also has the RGB transmittance and its raw log_transmittance (see `Planes`).
    """
    columns = {
        "center": planes.centers,
        "normal": planes.normals,
        "tangent": planes.tangents,
        "half_sizes": planes.half_sizes,
        "base_reflectance": planes.base_reflectances,
        "raw_normal": planes.raw_normals,
        "logit_reflectance": planes.logit_reflectances,
    }
    if planes.transmittances is not None and planes.log_transmittances is not None:
        columns["transmittance"] = planes.transmittances.clamp(LEAST_TRANSMITTANCE, LARGEST_TRANSMITTANCE)
        columns["log_transmittance"] = planes.log_transmittances
    entries = []
    for row, label in enumerate(planes.labels):
        broken = [key for key, values in columns.items() if not bool(values[row].isfinite().all())]
        if broken:
            raise ValueError(f"plane {label} cannot be written: {', '.join(broken)} must be finite, but is not")
        # Values of float32 survive the round trip through decimal doubles.
        values = {key: column[row].tolist() for key, column in columns.items()}
        entries.append({"label": int(label), "mirror": label in planes.mirrors, **values})
    return json.dumps(entries, indent=1, allow_nan=False) + "\n"


def read_planes(path: Path | str) -> Planes:
    """Reads planes as float32 tensors.

    Files may be edited by hand: if `normal`, `base_reflectance` or `transmittance` no longer agrees with its raw value,
    or the raw value is missing, the readable one is used.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not a list of planes, a missing or malformed value, or a repeated label.
    """
    path = Path(path)
    if not isfile(path):
        raise FileNotFoundError(f"no planes file at {path}; expected the planes.json of a run")
    entries = [_checked_entry(entry, where) for entry, where in _read_list(path, "plane")]
    if not entries:
        return Planes.empty()
    labels = tuple(entry["label"] for entry in entries)
    if len(set(labels)) != len(labels):
        raise ValueError(f"{path} has plane labels {list(labels)}; expected every label once")
    return Planes(
        centers=_column(entries, "center"),
        raw_normals=torch.stack([_raw(one["normal"], one["raw_normal"], UNIT, torch.clone) for one in entries]),
        logit_reflectances=torch.stack(
            [_raw(one["base_reflectance"], one["logit_reflectance"], torch.sigmoid, LOGIT_OF) for one in entries]
        ),
        tangents=_column(entries, "tangent"),
        half_sizes=_column(entries, "half_sizes"),
        labels=labels,
        mirrors=tuple(entry["label"] for entry in entries if entry["mirror"]),
        log_transmittances=_log_transmittances(entries),
    )


def _read_list(path: Path, what: str) -> list[tuple[Any, str]]:
    """The objects listed in a file, each with its name for messages, such as "plane 1 in planes.json"."""
    entries = records.read_json(path)
    if not isinstance(entries, list):
        raise ValueError(f"{path} holds {short_repr(entries)}; expected a list with one object per {what}")
    return [(entry, f"{what} {index} in {path}") for index, entry in enumerate(entries, start=1)]


def _checked_entry(entry: Any, where: str) -> dict[str, Any]:
    """One plane; checks its fields, and that its rectangle is not degenerate."""
    plane = records.check_fields(entry, PLANE, where)
    normal, tangent = (torch.tensor(plane[key], dtype=torch.float64) for key in ("normal", "tangent"))
    for key, vector in (("normal", normal), ("tangent", tangent)):
        if float(vector.norm()) < LEAST_LENGTH:
            raise ValueError(f"{key} of {where} has length 0; expected a direction")
    if float(torch.linalg.cross(normal, tangent).norm() / (normal.norm() * tangent.norm())) < LEAST_ANGLE:
        raise ValueError(f"tangent of {where} lies along its normal; expected the direction of a side of the rectangle")
    return plane


def _column(entries: list[dict[str, Any]], key: str) -> Tensor:
    return torch.tensor([entry[key] for entry in entries], dtype=torch.float32)


def _raw(readable: Any, raw: Any, activate: Conversion, invert: Conversion) -> Tensor:
    """A raw value, computed from the readable one if that was edited or is alone."""
    computed = invert(torch.tensor(readable, dtype=torch.float32))
    given = computed if raw is None else torch.tensor(raw, dtype=torch.float32)
    return given if (activate(given) - activate(computed)).abs().max() <= EDIT_TOLERANCE else computed


def _log_transmittances(entries: list[dict[str, Any]]) -> Tensor | None:
    """[K, 3], zeros for panes without transmittance; None if all lack it."""
    values = [(entry["transmittance"], entry["log_transmittance"]) for entry in entries]
    if all(readable is None for readable, _ in values):
        return None
    return torch.stack([_raw(readable or (1.0, 1.0, 1.0), raw, torch.exp, torch.log) for readable, raw in values])


LARGEST_SIDE = 2**17
"""Largest side of a camera's image, pixels."""
FOCAL = records.Number(above=0, most=1e9)
CAMERA: dict[str, records.Field] = {
    "img_name": records.Text(),
    "width": records.Integer(1, LARGEST_SIDE),
    "height": records.Integer(1, LARGEST_SIDE),
    "position": records.ListOf(records.COORDINATE, 3),
    "rotation": records.ListOf(records.ListOf(records.Number(-1.01, 1.01), 3), 3),
    "fx": FOCAL,
    "fy": FOCAL,
    "cx": records.Optional(records.COORDINATE),
    "cy": records.Optional(records.COORDINATE),
}
LARGEST_SHEAR = 1e-3
"""Largest entry of R R^T - I that is accepted for a rotation."""


def write_cameras(path: Path | str, cameras: Iterable[tuple[str, Camera]]) -> None:
    """Writes named cameras in the layout of 3DGS's `cameras.json`, atomically.

    Each entry has id, img_name, width, height, position (camera centre), rotation (the rows of
    world_from_cam, OpenCV axes), fy and fx as other programs expect, and cx and cy in addition.

    Args:
        path: the file.
        cameras: image name and camera, in the order of ids.
    """
    entries = [
        {
            "id": index,
            "img_name": name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.center.tolist(),
            "rotation": camera.cam_from_world[:3, :3].T.tolist(),
            "fy": camera.fy,
            "fx": camera.fx,
            "cx": camera.cx,
            "cy": camera.cy,
        }
        for index, (name, camera) in enumerate(cameras)
    ]
    write_text(path, json.dumps(entries, indent=1, allow_nan=False) + "\n")


def read_cameras(path: Path | str) -> list[tuple[str, Camera]]:
    """Reads names and float32 cameras, in order, from a file of `write_cameras` or another 3DGS program."""
    return [_camera(entry, where) for entry, where in _read_list(Path(path), "camera")]


def _camera(entry: Any, where: str) -> tuple[str, Camera]:
    values = records.check_fields(entry, CAMERA, where)
    rotation = torch.tensor(values["rotation"], dtype=torch.float64).T
    shear = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
    if float(shear) > LARGEST_SHEAR or float(torch.linalg.det(rotation)) < 0:
        raise ValueError(f"rotation of {where} is not a rotation; expected three orthogonal unit vectors, right-handed")
    cam_from_world = torch.eye(4, dtype=torch.float64)
    cam_from_world[:3, :3] = rotation
    cam_from_world[:3, 3] = -rotation @ torch.tensor(values["position"], dtype=torch.float64)
    width, height = values["width"], values["height"]
    cx, cy = (side / 2 if values[key] is None else values[key] for key, side in (("cx", width), ("cy", height)))
    return values["img_name"], Camera(cam_from_world.float(), values["fx"], values["fy"], cx, cy, width, height)


TRANSFORM = records.ListOf(records.ListOf(records.Number(-1e3, 1e3), 4), 3)
TWIST = records.ListOf(records.Number(-1e2, 1e2), 6)
Correction = TypeVar("Correction", bound=PerPhotograph)
ENTRIES: dict[type[PerPhotograph], records.Field] = {Exposures: TRANSFORM, PoseCorrections: TWIST}
"""Required values of a photograph, by kind of correction."""


def write_corrections(path: Path, corrections: PerPhotograph) -> None:
    """Writes the values of each photograph; `read_corrections` returns them exactly."""
    entries = dict(zip(corrections.names, corrections.values.detach().cpu().tolist(), strict=True))
    write_text(path, json.dumps(entries, indent=1) + "\n")


def read_corrections(path: Path, kind: type[Correction]) -> Correction:
    """Reads the exposures or poses that `write_corrections` wrote, as float32."""
    entries = records.DictOf(ENTRIES[kind]).read(records.read_json(path), str(path))
    values = torch.tensor(list(entries.values()), dtype=torch.float32).reshape(len(entries), *kind.SHAPE)
    return kind(values, tuple(entries))


def write_colmap(
    folder: Path, cameras: Iterable[tuple[str, Camera]], positions: NDArray[np.floating], colors: NDArray[np.uint8]
) -> None:
    """Writes `cameras.txt`, `images.txt` and `points3D.txt`; points have no tracks.

    Args:
        folder: of the model, such as `sparse/0`; created if missing.
        cameras: image name and pinhole camera.
        positions: [P, 3] of the points, world units.
        colors: [P, 3] of the points, sRGB.
    """
    lenses: dict[str, int] = {}
    images = []
    for number, (name, camera) in enumerate(cameras, start=1):
        lens = f"PINHOLE {camera.width} {camera.height} {camera.fx!r} {camera.fy!r} {camera.cx!r} {camera.cy!r}"
        quat = quat_from_rotation(camera.cam_from_world[:3, :3])
        pose = " ".join(f"{value:.9g}" for value in (*quat.tolist(), *camera.cam_from_world[:3, 3].tolist()))
        images.append(f"{number} {pose} {lenses.setdefault(lens, len(lenses) + 1)} {name}\n\n")
    points = [
        f"{number} {x:.9g} {y:.9g} {z:.9g} {r} {g} {b} 0\n"
        for number, ((x, y, z), (r, g, b)) in enumerate(zip(positions.tolist(), colors.tolist(), strict=True), start=1)
    ]
    make_folder(folder)
    write_text(folder / "cameras.txt", "".join(f"{number} {lens}\n" for lens, number in lenses.items()))
    write_text(folder / "images.txt", "".join(images))
    write_text(folder / "points3D.txt", "".join(points))


FORMAT = "glassplat-environment-1"
REGION = records.Nullable(records.ListOf(records.COORDINATE, 4))
"""Centre and radius of the sphere that contains everything that reflects the environment."""


def write_environment(path: Path | str, environment: Environment) -> None:
    """Writes an environment, atomically; `read_environment` returns the same bits.

    Raises:
        OSError: the file cannot be written; an older one is unchanged.
    """
    write_tensors(path, environment.tensors(), {"format": FORMAT, "region": environment.region})


def read_environment(path: Path | str) -> Environment:
    """Reads an environment that `write_environment` wrote."""
    path = Path(path)
    if not isfile(path):
        raise FileNotFoundError(f"no environment at {path}; expected the environment.safetensors of a run")
    with open_tensors(path, FORMAT, "an environment") as file:
        header = records.check_fields(file.header, {"region": records.Optional(REGION)}, f"the header of {path}")
        raw = file.tensors().get("raw")
    if raw is None or not (raw.is_floating_point() and bool(torch.isfinite(raw).all())):
        raise ValueError(f"{path} holds no tensor `raw` of finite numbers; expected the texels of an environment")
    try:
        return Environment(raw, header["region"])
    except ValueError as error:
        raise ValueError(f"{path} holds no environment: {error}") from error


EXR, PNG = ".exr", ".png"
MOST_PIXELS = 2**25
"""Largest panorama, 8192 x 4096: as floats it takes ten photographs' memory, and no environment is finer."""


def read_equirect(path: Path | str) -> Tensor:
    """Reads a panorama, equirectangular with z up, as [H, 2H, 3] float32 sRGB in [0, 1].

    An EXR file holds linear radiance with Rec. 709 primaries, clipped at white; a PNG file holds sRGB. The directions
    of pixels are defined in docs/conventions.md.
    """
    path = Path(path)
    _check_suffix(path)
    if not isfile(path):
        raise FileNotFoundError(f"no panorama at {path}; expected an equirectangular image, {EXR} or {PNG}")
    if path.suffix.lower() == EXR:
        image = srgb_from_linear(torch.from_numpy(_read_exr(path)))
    else:
        _check_size(path, *image_size(path))
        pixels = read_image_float(path)
        if pixels.shape[2] < 3:
            raise ValueError(f"{path} is grey; expected a panorama in colour")
        image = torch.from_numpy(np.ascontiguousarray(pixels[:, :, :3]))
    if not bool(torch.isfinite(image).all()):
        raise ValueError(f"{path} contains non-finite values; expected radiance of at least 0")
    return image.clamp(0, 1)


def write_equirect(path: Path | str, image: Tensor) -> None:
    """Writes a panorama [H, 2H, 3], sRGB in [0, 1], atomically: linear float32 radiance as EXR, sRGB in 8 bits as PNG.

    Raises:
        ValueError: unknown format, wrong shape, or a non-finite value.
        OSError: the file cannot be written; an older one is unchanged.
    """
    path = Path(path)
    _check_suffix(path)
    if image.ndim != 3 or tuple(image.shape[1:]) != (2 * image.shape[0], 3) or image.shape[0] == 0:
        raise ValueError(f"the panorama has shape {tuple(image.shape)}; expected (H, 2 H, 3)")
    if not bool(torch.isfinite(image).all()):
        raise ValueError("the panorama contains non-finite values; expected sRGB in [0, 1]")
    if path.suffix.lower() == PNG:
        write_image(path, image)
        return
    import OpenEXR  # Imported only for such files.

    radiance = linear_from_srgb(image.detach().cpu().double()).float().contiguous().numpy()
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with atomic_write(path) as temporary:
        try:
            OpenEXR.File(header, {"RGB": radiance}).write(str(temporary))
        except RuntimeError as error:
            raise system_error(str(error)) from error


def _check_suffix(path: Path) -> None:
    if path.suffix.lower() not in (EXR, PNG):
        raise ValueError(f"unknown format of the panorama {path}; use the suffix {EXR} or {PNG}")


def _check_size(path: Path, width: int, height: int) -> None:
    """Checks the size in a header before pixels are allocated, because an EXR file may declare any size."""
    if width != 2 * height or width * height > MOST_PIXELS:
        raise ValueError(
            f"{path} is {width} x {height} pixels; expected an equirectangular image, twice as wide as high, of at "
            f"most {MOST_PIXELS / 1e6:.0f} megapixels"
        )


def _read_exr(path: Path) -> NDArray[np.float32]:
    """Linear radiance [H, W, 3]."""
    (left, top), (right, bottom) = _read_from_exr(path, lambda file: file.header()["dataWindow"], header_only=True)
    _check_size(path, int(right) - int(left) + 1, int(bottom) - int(top) + 1)
    channels = _read_from_exr(
        path, lambda file: {name: one.pixels for name, one in file.channels().items()}, separate_channels=True
    )
    if not {"R", "G", "B"} <= channels.keys():
        raise ValueError(f"{path} has the channels {sorted(channels)}; expected R, G and B")
    return np.stack([channels[name] for name in "RGB"], axis=-1).astype(np.float32)


def _read_from_exr(path: Path, read: Callable[[Any], Any], **options: bool) -> Any:
    """Reads from an EXR file; errors of the library become one that names the file."""
    import OpenEXR  # As above.

    try:
        with OpenEXR.File(str(path), **options) as file:
            return read(file)
    except (RuntimeError, ValueError, KeyError) as error:
        raise ValueError(f"cannot read {path} as OpenEXR ({error}); replace the file or remove it") from error
