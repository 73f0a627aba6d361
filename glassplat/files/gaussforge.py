"""SOG (PlayCanvas) and KSPLAT (GaussianSplats3D) by way of gaussforge, an extra: both are lossy, and hold no panes."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from glassplat.files.ply import read_gaussians, write_gaussians
from glassplat.files.records import reading
from glassplat.files.writing import FORGED_SUFFIXES, atomic_write
from glassplat.scene.gaussians import Gaussians


def read_forged(path: Path) -> Gaussians:
    """Reads a .sog or .ksplat in the frame of a PLY.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: gaussforge is not installed, or cannot read it.
    """
    forge, kind = _forge(path), path.suffix.lower()[1:]
    with reading(path):
        data = path.read_bytes()
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "scene.ply"
        plain.write_bytes(_converted(forge, data, kind, "ply", path))
        return read_gaussians(plain)


def write_forged(path: Path, gaussians: Gaussians) -> None:
    """Writes a .sog or .ksplat.

    Raises:
        ValueError: gaussforge is not installed, or cannot write these Gaussians.
        OSError: the file cannot be written; an older one is unchanged.
    """
    forge = _forge(path)
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "scene.ply"
        write_gaussians(plain, gaussians)
        data = _converted(forge, plain.read_bytes(), "ply", path.suffix.lower()[1:], path)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def _forge(path: Path) -> Any:
    try:
        from gaussforge import GaussForge
    except ImportError as error:
        raise ValueError(
            f"{path}: {' and '.join(FORGED_SUFFIXES)} need gaussforge ({error}); pip install 'glassplat[formats]'"
        ) from error
    return GaussForge()


def _converted(forge: Any, data: bytes, source: str, target: str, path: Path) -> bytes:
    result = forge.convert(data, source, target)
    if "data" not in result:
        raise ValueError(f"gaussforge cannot convert {path} from {source} to {target}: {result.get('error')}")
    converted: bytes = result["data"]
    return converted
