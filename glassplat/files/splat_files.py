"""Trained splats of other programs: PLY as everybody writes it, compressed PLY, SPZ, GLB, and .splat."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch

from glassplat.files.compressed_ply import is_compressed, read_compressed
from glassplat.files.fields import LARGEST_COORDINATE
from glassplat.files.glb import read_glb
from glassplat.files.glb_container import MAGIC
from glassplat.files.ply import read_gaussians
from glassplat.files.ply_table import read_table
from glassplat.files.reading import reading
from glassplat.files.scene_folder import LARGEST_COLOR, LARGEST_LOG
from glassplat.files.splat_suffixes import SPLAT_SUFFIXES
from glassplat.files.spz import GZIP, read_spz
from glassplat.scene.activations import SH_ZERO
from glassplat.scene.gaussians import Gaussians

SPLAT_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("quat", "u1", 4)])
LEAST_SCALE = 1e-12


def read_splats(path: Path | str) -> Gaussians:
    """Reads the Gaussians of a file in the frame of a PLY (y down, z forward), as they are stored.

    What kind of file it is, its first bytes say; a .splat, which begins with anything, its name.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: another kind of file, or one that is damaged or cut off.
    """
    path = Path(path)
    with reading(path), path.open("rb") as stream:
        head = stream.read(4)
    if head[:3] == b"ply":
        table = read_table(path)
        return read_compressed(path, table) if is_compressed(table) else read_gaussians(path)
    if head[:2] == GZIP or head == b"NGSP":
        return read_spz(path)
    if head == MAGIC:
        return read_glb(path)
    if path.suffix.lower() == ".splat":
        return _read_rows(path)
    raise ValueError(f"{path} is no splat file that can be read; expected one of {', '.join(SPLAT_SUFFIXES)}")


def drawable(gaussians: Gaussians, path: Path | str) -> tuple[Gaussians, int]:
    """Those that can be drawn, and how many cannot: values that are not finite or absurd, rotations without direction.

    Raises:
        ValueError: none of them can.
    """
    bounds = {"means": LARGEST_COORDINATE, "log_scales": LARGEST_LOG, "sh": LARGEST_COLOR, "quats": LARGEST_COLOR}
    good = ~torch.isnan(gaussians.logit_opacities) & (gaussians.quats.square().sum(1) > 0)
    for name, most in bounds.items():
        values = gaussians.tensors()[name].flatten(1)
        # A scale may be as small as it likes.
        good &= ((values if name == "log_scales" else values.abs()) <= most).all(dim=1) & ~values.isnan().any(dim=1)
    for name, values in gaussians.channels.items():
        good &= values.abs() <= (LARGEST_LOG if name.startswith("log_") else LARGEST_COLOR)
    lost = len(gaussians) - int(good.sum())
    if lost and lost == len(gaussians):
        raise ValueError(
            f"none of the {lost} Gaussians in {path} can be drawn: values that are no numbers or too large"
        )
    kept = gaussians.select(good) if lost else gaussians
    held = {
        "logit_opacities": kept.logit_opacities.clamp(-LARGEST_LOG, LARGEST_LOG),
        "log_scales": kept.log_scales.clamp(min=-LARGEST_LOG),
    }
    return kept.with_tensors(held), lost


def _read_rows(path: Path) -> Gaussians:
    """A .splat: 32 bytes per Gaussian, colour and opacity as seen, scales not logarithmic."""
    size = os.stat(path).st_size
    if size == 0 or size % SPLAT_ROW.itemsize:
        raise ValueError(
            f"{path} has {size} bytes; expected {SPLAT_ROW.itemsize} per Gaussian: it is cut off, or no .splat"
        )
    with reading(path):
        rows = np.fromfile(path, dtype=SPLAT_ROW)
    shares = torch.from_numpy(rows["color"].astype(np.float32) / 255)
    scales = torch.from_numpy(rows["scale"].astype(np.float32))
    return Gaussians(
        means=torch.from_numpy(rows["mean"].astype(np.float32)),
        quats=torch.from_numpy((rows["quat"].astype(np.float32) - 128) / 128),
        log_scales=scales.clamp(min=LEAST_SCALE).log(),
        logit_opacities=torch.logit(shares[:, 3].clamp(0.5 / 255, 1 - 0.5 / 255)),
        sh=((shares[:, None, :3] - 0.5) / SH_ZERO).contiguous(),
    )
