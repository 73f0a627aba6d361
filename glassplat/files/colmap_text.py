"""Cameras and points as a COLMAP model in text."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from glassplat.files.atomic import atomic_write
from glassplat.files.folders import make_folder
from glassplat.scene.camera import Camera


def write_colmap(
    folder: Path,
    cameras: Iterable[tuple[str, Camera]],
    positions: NDArray[np.floating],
    colors: NDArray[np.uint8],
) -> None:
    """Writes `cameras.txt`, `images.txt` and `points3D.txt`; points have no tracks.

    Args:
        folder: of the model, such as `sparse/0`; made where it is missing.
        cameras: image name and pinhole camera.
        positions: [P, 3] of the points, world units.
        colors: [P, 3] of the points, sRGB.
    """
    lenses: dict[str, int] = {}
    images = []
    for number, (name, camera) in enumerate(cameras, start=1):
        lens = f"PINHOLE {camera.width} {camera.height} {camera.fx!r} {camera.fy!r} {camera.cx!r} {camera.cy!r}"
        pose = " ".join(f"{value:.9f}" for value in (*quat_wxyz(camera), *camera.cam_from_world[:3, 3].tolist()))
        images.append(f"{number} {pose} {lenses.setdefault(lens, len(lenses) + 1)} {name}\n\n")
    points = [
        f"{number} {x:.9g} {y:.9g} {z:.9g} {r} {g} {b} 0\n"
        for number, ((x, y, z), (r, g, b)) in enumerate(zip(positions.tolist(), colors.tolist(), strict=True), start=1)
    ]
    make_folder(folder)
    _write(folder / "cameras.txt", [f"{number} {lens}\n" for lens, number in lenses.items()])
    _write(folder / "images.txt", images)
    _write(folder / "points3D.txt", points)


def quat_wxyz(camera: Camera) -> list[float]:
    """The camera's orientation, cam from world."""
    from scipy.spatial.transform import Rotation  # Slow to import, and few runs need it.

    x, y, z, w = Rotation.from_matrix(camera.cam_from_world[:3, :3].double().cpu().numpy()).as_quat().tolist()
    return [w, x, y, z]


def _write(path: Path, lines: list[str]) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")
