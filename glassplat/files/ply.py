"""Gaussians as PLY: the standard format of splat viewers and trainers, and the compressed one (reading only)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.files.ply_table import PlyTable, point_colors, read_table, write_table
from glassplat.scene import SH_ZERO
from glassplat.scene.gaussians import DISC_SCALES, PER_GAUSSIAN, Gaussians

CHUNK = 256
"""Number of consecutive Gaussians with common bounds in a compressed PLY."""
PACKED_COLUMNS = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
BOUNDS = tuple(f"{end}_{name}" for end in ("min", "max") for name in ("x", "y", "z", "scale_x", "scale_y", "scale_z"))
COLOR_BOUNDS = tuple(f"{end}_{name}" for end in ("min", "max") for name in "rgb")
HARMONICS, HARMONIC_RANGE = (9, 24, 45), 8.0
"""Numbers of values beyond SH degree 0 for the degrees 1 to 3, and the range of these values, centred at 0."""
ELEVEN_TEN_ELEVEN, TEN_BITS = ((21, 11), (11, 10), (0, 11)), ((20, 10), (10, 10), (0, 10))
"""Lowest bit and number of bits of each part of a packed word with three parts."""
EIGHT_BITS = ((24, 8), (16, 8), (8, 8), (0, 8))
"""The same for four parts."""

Floats = NDArray[np.float32]


@np.errstate(over="ignore", invalid="ignore")  # The caller reports values out of range; NumPy must not warn.
def _read_compressed(path: Path, table: PlyTable) -> Gaussians:
    """The Gaussians of a compressed PLY whose `vertex` table has been read."""
    words = [table.columns[name] for name in PACKED_COLUMNS]
    if any(word.dtype != np.uint32 for word in words):
        raise ValueError(f"{path} stores packed values in {[str(word.dtype) for word in words]}; expected uint")
    position, rotation, scale, color = words
    count = len(position)
    bounds = _bounds(path, count)
    means = _dequantise(_bit_fields(position, ELEVEN_TEN_ELEVEN), bounds, ("x", "y", "z"))
    scales = _dequantise(_bit_fields(scale, ELEVEN_TEN_ELEVEN), bounds, ("scale_x", "scale_y", "scale_z"))
    shares = _bit_fields(color, EIGHT_BITS)
    colors = _dequantise(shares[:, :3], bounds, ("r", "g", "b")) if "min_r" in bounds else shares[:, :3]
    constant = (colors[:, None] - 0.5) / SH_ZERO
    rest = _harmonics(path, table, count)
    opacities = torch.from_numpy(shares[:, 3].clip(0.5 / 255, 1 - 0.5 / 255))
    return Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(_rotations(rotation)),
        log_scales=torch.from_numpy(scales),
        logit_opacities=torch.logit(opacities),
        sh=torch.from_numpy(np.concatenate([constant, rest], axis=1).astype(np.float32)),
    )


def _bounds(path: Path, count: int) -> dict[str, Floats]:
    """Bounds [N] of the chunk of each Gaussian, by name."""
    columns = read_table(path, "chunk").columns
    missing = [name for name in BOUNDS if name not in columns]
    chunks = len(next(iter(columns.values())))
    if missing or chunks != -(-count // CHUNK):
        raise ValueError(
            f"{path} has {chunks} chunks that lack {missing}; expected {-(-count // CHUNK)} with all bounds for its "
            f"{count} Gaussians: the file is damaged"
        )
    names = [*BOUNDS, *(COLOR_BOUNDS if set(COLOR_BOUNDS) <= columns.keys() else ())]
    return {name: np.repeat(columns[name].astype(np.float32), CHUNK)[:count] for name in names}


def _dequantise(shares: Floats, bounds: dict[str, Floats], names: tuple[str, ...]) -> Floats:
    low, high = (np.stack([bounds[f"{end}_{name}"] for name in names], axis=1) for end in ("min", "max"))
    values: Floats = low * (1 - shares) + high * shares
    return values


def _bit_fields(words: NDArray[np.uint32], fields: tuple[tuple[int, int], ...]) -> Floats:
    """Bit fields (shift, width) normalised to [0, 1], [N, F]."""
    parts = [((words >> np.uint32(shift)) & np.uint32(2**width - 1)) / (2**width - 1) for shift, width in fields]
    return np.stack(parts, axis=1).astype(np.float32)


def _rotations(words: NDArray[np.uint32]) -> Floats:
    """Quaternions [N, 4] `wxyz`; two bits hold the index of the largest component, which is not stored."""
    stored = (_bit_fields(words, TEN_BITS) - np.float32(0.5)) * np.float32(np.sqrt(2))
    largest = np.sqrt((1 - (stored**2).sum(axis=1)).clip(min=0))
    largest_index = words >> np.uint32(30)
    quats = np.zeros((len(words), 4), dtype=np.float32)
    position = np.zeros(len(words), dtype=np.int64)
    rows = np.arange(len(words))
    for component in range(4):
        is_largest = largest_index == component
        quats[:, component] = np.where(is_largest, largest, stored[rows, np.minimum(position, 2)])
        position += ~is_largest
    return quats


def _harmonics(path: Path, table: PlyTable, count: int) -> Floats:
    """SH coefficients [N, K, 3] beyond degree 0: a byte each, in a separate table if there are any."""
    element = table.header.element("sh")
    if element is None:
        return np.zeros((count, 0, 3), dtype=np.float32)
    columns = read_table(path, "sh").columns
    names = [f"f_rest_{index}" for index in range(len(columns))]
    if element.count != count or len(names) not in HARMONICS or set(names) != columns.keys():
        raise ValueError(
            f"{path} has {element.count} rows of {len(columns)} harmonics for {count} Gaussians; expected one each, "
            f"of {', '.join(map(str, HARMONICS))}"
        )
    codes = np.stack([columns[name] for name in names], axis=1).astype(np.float32)
    values = (
        np.where(codes <= 0, 0, np.where(codes >= 255, 1, (codes + 0.5) / 256)) * HARMONIC_RANGE - HARMONIC_RANGE / 2
    )
    by_channel: Floats = values.reshape(count, 3, -1).transpose(0, 2, 1).astype(np.float32)
    return by_channel


POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
COLOR = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
DISC_SCALE = SCALE[:DISC_SCALES]
REQUIRED = (*POSITION, "opacity", *DISC_SCALE, *ROTATION)
"""A file without the third scale holds discs, as in 2DGS."""
CHANNEL_PREFIXES = ("log_", "logit_", "raw_")
"""Raw values are named after their activation; these prefixes distinguish channels from foreign properties."""
SH_COEFFICIENTS = (1, 4, 9, 16)
"""Number of SH coefficients, by degree."""


def is_channel(name: str) -> bool:
    """Return whether a property is a channel, not one of another program or a tensor that all Gaussians have."""
    return name.startswith(CHANNEL_PREFIXES) and name not in PER_GAUSSIAN


def write_gaussians(path: Path | str, gaussians: Gaussians) -> None:
    """Writes Gaussians as a standard 3DGS PLY, or discs as 2DGS PLY: float32, binary little endian, atomically.

    The properties are x y z, nx ny nz (zero), f_dc_*, f_rest_* (channel-major), opacity (logit),
    scale_* (log; two for discs), rot_* (`wxyz`), then one property per channel, which other readers skip. Gaussians
    without colour (K = 0) have neither f_dc nor f_rest.
    """
    unreadable = [name for name in gaussians.channels if not is_channel(name)]
    if unreadable:
        raise ValueError(
            f"cannot store channels {unreadable}: a raw channel's name begins with one of {CHANNEL_PREFIXES}"
        )
    constant, bands = gaussians.sh[:, :1].flatten(1), gaussians.sh[:, 1:].transpose(1, 2).flatten(1)
    color_names = [*COLOR[: constant.shape[1]], *(f"f_rest_{i}" for i in range(bands.shape[1]))]
    scale_names = DISC_SCALE if gaussians.are_discs else SCALE
    names = [*POSITION, *NORMAL, *color_names, "opacity", *scale_names, *ROTATION, *gaussians.channels]
    normals = torch.zeros_like(gaussians.means)
    columns = [gaussians.means, normals, constant, bands, gaussians.logit_opacities[:, None], gaussians.log_scales]
    columns += [gaussians.quats, *(channel[:, None] for channel in gaussians.channels.values())]
    rows = torch.cat([column.detach().to("cpu", torch.float32) for column in columns], dim=1)
    write_table(Path(path), names, rows.numpy())


def read_gaussians(path: Path | str) -> Gaussians:
    """Reads a 3DGS PLY, or a 2DGS PLY with two scales, as raw float32 tensors, bit for bit as stored.

    Properties may be in any order, ascii or either byte order, with SH degree 0 to 3, with red, green and blue in place
    of SH, or without colour. Properties whose names start with `log_`, `logit_` or `raw_` become channels; normals and
    other foreign properties are ignored. `active_sh_degree` is the highest degree stored.
    """
    path = Path(path)
    return _read_plain(path, read_table(path))


def read_ply(path: Path) -> Gaussians:
    """Reads a PLY as `read_gaussians` does, or a compressed one of PlayCanvas/SuperSplat."""
    table = read_table(path)
    is_compressed = set(PACKED_COLUMNS) <= table.columns.keys()
    return _read_compressed(path, table) if is_compressed else _read_plain(path, table)


def _read_plain(path: Path, table: PlyTable) -> Gaussians:
    """The Gaussians of a PLY that is not compressed, whose `vertex` table has been read."""
    _check_is_splat(table, path)
    columns = {name: as_tensor(values) for name, values in table.columns.items()}
    plain = point_colors(table.columns)
    sh = _read_sh(columns, path)
    if plain is not None and sh.shape[1] == 0:
        sh = (as_tensor(plain)[:, None] / 255 - 0.5) / SH_ZERO
    return Gaussians(
        means=_stack_columns(columns, POSITION),
        quats=_stack_columns(columns, ROTATION),
        log_scales=_stack_columns(columns, SCALE if SCALE[-1] in columns else DISC_SCALE),
        logit_opacities=columns["opacity"],
        sh=sh,
        channels={name: column for name, column in columns.items() if is_channel(name)},
    )


def _read_sh(columns: Mapping[str, Tensor], path: Path) -> Tensor:
    """Coefficients [N, K, 3] from the f_dc and f_rest properties."""
    rest_count = sum(name.startswith("f_rest_") for name in columns)
    rest_names = [f"f_rest_{i}" for i in range(rest_count)]
    has_color = any(name in columns for name in COLOR)
    if not has_color and rest_count == 0:
        return torch.zeros(columns["x"].shape[0], 0, 3, dtype=torch.float32)
    missing = [name for name in (*COLOR, *rest_names) if name not in columns]
    if missing:
        raise ValueError(f"{path} lacks the colour properties {missing}; expected f_dc_0..2 and f_rest_* without gaps")
    if rest_count not in [3 * (count - 1) for count in SH_COEFFICIENTS]:
        raise ValueError(f"{path} has {rest_count} f_rest properties; expected 0, 9, 24 or 45 (SH degree 0 to 3)")
    band_zero = _stack_columns(columns, COLOR)[:, None]
    if rest_count == 0:
        return band_zero
    rest = _stack_columns(columns, tuple(rest_names)).reshape(-1, 3, rest_count // 3).transpose(1, 2)
    return torch.cat([band_zero, rest], dim=1).contiguous()


def _check_is_splat(table: PlyTable, path: Path) -> None:
    """Raises an error with the likely kind of file, if it does not hold Gaussians."""
    missing = [name for name in REQUIRED if name not in table.columns]
    if not missing:
        return
    expected = f"expected a 3D Gaussian splat with the properties {' '.join(REQUIRED)}"
    if "packed_position" in table.columns:
        raise ValueError(
            f"{path} is a compressed PlayCanvas/SuperSplat PLY; {expected}. "
            "`glassplat export` reads it and writes an uncompressed one"
        )
    if len(missing) < len(REQUIRED) - len(POSITION):
        raise ValueError(f"{path} lacks {' '.join(missing)}; {expected}. Was it made by another kind of method?")
    faces = table.header.element("face")
    kind = "a mesh" if faces is not None and faces.count > 0 else "a point cloud"
    raise ValueError(f"{path} looks like {kind} and lacks {' '.join(missing)}; {expected}. Give a trained splat")


def _stack_columns(columns: Mapping[str, Tensor], names: tuple[str, ...]) -> Tensor:
    return torch.stack([columns[name] for name in names], dim=1)


def as_numpy(tensor: Tensor) -> NDArray[np.float32]:
    """A tensor as a float32 array on the CPU."""
    return tensor.detach().to("cpu", torch.float32).numpy()


def as_tensor(values: NDArray) -> Tensor:
    """An array as a float32 tensor."""
    with np.errstate(over="ignore"):  # Doubles that exceed float32 become infinite.
        return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
