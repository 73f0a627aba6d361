"""Cameras as the `cameras.json` that splatting viewers open beside a PLY."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from glassplat.files.atomic import atomic_write
from glassplat.scene.camera import Camera


def write_cameras(path: Path | str, cameras: Iterable[tuple[str, Camera]]) -> None:
    """Writes named cameras in the layout of 3DGS's `cameras.json`, atomically.

    Each entry has id, img_name, width, height, position (camera centre), rotation (the rows of
    world_from_cam, OpenCV axes), fy and fx as other programs expect, and cx and cy in addition.

    Args:
        path: the file.
        cameras: image name and camera, in the order in which ids are given.
    """
    entries = [_entry(index, name, camera) for index, (name, camera) in enumerate(cameras)]
    with atomic_write(path) as temporary_path:
        temporary_path.write_text(json.dumps(entries, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _entry(index: int, name: str, camera: Camera) -> dict[str, Any]:
    return {
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
