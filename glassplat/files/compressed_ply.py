"""The compressed PLY of PlayCanvas and SuperSplat: four words per Gaussian, relative to the bounds of its chunk."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from glassplat.files.ply_table import PlyTable, read_table
from glassplat.scene.activations import SH_ZERO
from glassplat.scene.gaussians import Gaussians

CHUNK = 256
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
BOUNDS = tuple(f"{end}_{name}" for end in ("min", "max") for name in ("x", "y", "z", "scale_x", "scale_y", "scale_z"))
COLOR_BOUNDS = tuple(f"{end}_{name}" for end in ("min", "max") for name in "rgb")
HARMONICS = (9, 24, 45)
HARMONIC_RANGE = 8.0
ELEVEN_TEN_ELEVEN = ((21, 11), (11, 10), (0, 11))
BYTES = ((24, 8), (16, 8), (8, 8), (0, 8))
TENS = ((20, 10), (10, 10), (0, 10))

Floats = NDArray[np.float32]


def is_compressed(table: PlyTable) -> bool:
    """Whether a PLY is of this kind."""
    return set(PACKED) <= table.columns.keys()


def read_compressed(path: Path, table: PlyTable) -> Gaussians:
    """The Gaussians of a compressed PLY, whose `vertex` table has been read.

    Raises:
        ValueError: it lacks its chunks, or their number or the harmonics do not fit.
    """
    words = [table.columns[name] for name in PACKED]
    if any(word.dtype != np.uint32 for word in words):
        raise ValueError(f"{path} stores packed values in {[str(word.dtype) for word in words]}; expected uint")
    position, rotation, scale, color = words
    count = len(position)
    bounds = _bounds(path, count)
    means = _between(_unit(position, ELEVEN_TEN_ELEVEN), bounds, ("x", "y", "z"))
    scales = _between(_unit(scale, ELEVEN_TEN_ELEVEN), bounds, ("scale_x", "scale_y", "scale_z"))
    shares = _unit(color, BYTES)
    colors = _between(shares[:, :3], bounds, ("r", "g", "b")) if "min_r" in bounds else shares[:, :3]
    constant = (colors[:, None] - 0.5) / SH_ZERO
    rest = _harmonics(path, table, count)
    opacities = torch.from_numpy(shares[:, 3].clip(0.5 / 255, 1 - 0.5 / 255))
    return Gaussians(
        means=torch.from_numpy(means),
        quats=torch.from_numpy(_rotations(rotation)),
        log_scales=torch.from_numpy(scales),
        logit_opacities=torch.logit(opacities),
        sh=torch.from_numpy(np.concatenate([constant, rest], axis=1).astype(np.float32)),
        active_sh_degree=round((1 + rest.shape[1]) ** 0.5) - 1,
    )


def _bounds(path: Path, count: int) -> dict[str, Floats]:
    """The bounds [N] of each Gaussian's chunk by name."""
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


def _between(shares: Floats, bounds: dict[str, Floats], names: tuple[str, ...]) -> Floats:
    low, high = (np.stack([bounds[f"{end}_{name}"] for name in names], axis=1) for end in ("min", "max"))
    # What is out of range is told by the caller; here it must not warn.
    with np.errstate(over="ignore", invalid="ignore"):
        between: Floats = low * (1 - shares) + high * shares
    return between


def _unit(words: NDArray[np.uint32], fields: tuple[tuple[int, int], ...]) -> Floats:
    """Bit fields (shift, width) as shares [N, F] in [0, 1]."""
    parts = [((words >> np.uint32(shift)) & np.uint32(2**width - 1)) / (2**width - 1) for shift, width in fields]
    return np.stack(parts, axis=1).astype(np.float32)


def _rotations(words: NDArray[np.uint32]) -> Floats:
    """Quaternions [N, 4] `wxyz`: the largest component is left out, two bits say which."""
    three = (_unit(words, TENS) - np.float32(0.5)) * np.float32(np.sqrt(2))
    largest = np.sqrt((1 - (three**2).sum(axis=1)).clip(min=0))
    which = words >> np.uint32(30)
    quats = np.zeros((len(words), 4), dtype=np.float32)
    place = np.zeros(len(words), dtype=np.int64)
    rows = np.arange(len(words))
    for component in range(4):
        left_out = which == component
        quats[:, component] = np.where(left_out, largest, three[rows, np.minimum(place, 2)])
        place += ~left_out
    return quats


def _harmonics(path: Path, table: PlyTable, count: int) -> Floats:
    """Coefficients [N, K, 3] beyond the constant one; a byte each, in a table of their own where there are any."""
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
