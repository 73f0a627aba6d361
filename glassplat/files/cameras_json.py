"""Cameras as the `cameras.json` that splatting viewers open beside a PLY."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import torch

from glassplat.files.atomic import atomic_write
from glassplat.files.fields import COORDINATE, Field, Items, Number, Optional, Text, Whole, checked, shown
from glassplat.files.json_text import read_json
from glassplat.scene.camera import Camera

LARGEST_SIDE = 2**17
FOCAL = Number(above=0, most=1e9)
CAMERA: dict[str, Field] = {
    "img_name": Text(),
    "width": Whole(1, LARGEST_SIDE),
    "height": Whole(1, LARGEST_SIDE),
    "position": Items(COORDINATE, 3),
    "rotation": Items(Items(Number(-1.01, 1.01), 3), 3),
    "fx": FOCAL,
    "fy": FOCAL,
    "cx": Optional(COORDINATE),
    "cy": Optional(COORDINATE),
}
LARGEST_SHEAR = 1e-3
"""Of a rotation: how far its rows may be from unit vectors at right angles."""


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


def read_cameras(path: Path | str) -> list[tuple[str, Camera]]:
    """Reads what `write_cameras`, or another program in that layout, wrote: names and float32 cameras, in file order.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: not a list of cameras, a missing or malformed value, or a matrix that is no rotation.
    """
    path = Path(path)
    entries = read_json(path)
    if not isinstance(entries, list):
        raise ValueError(f"{path} holds {shown(entries)}; expected a list with one object per camera")
    return [_camera(entry, f"camera {index} in {path}") for index, entry in enumerate(entries, start=1)]


def _camera(entry: Any, where: str) -> tuple[str, Camera]:
    values = checked(entry, CAMERA, where)
    rotation = torch.tensor(values["rotation"], dtype=torch.float64).T
    shear = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
    if float(shear) > LARGEST_SHEAR or float(torch.linalg.det(rotation)) < 0:
        raise ValueError(f"rotation of {where} is none; expected three unit vectors at right angles, right-handed")
    cam_from_world = torch.eye(4, dtype=torch.float64)
    cam_from_world[:3, :3] = rotation
    cam_from_world[:3, 3] = -rotation @ torch.tensor(values["position"], dtype=torch.float64)
    width, height = values["width"], values["height"]
    cx, cy = (side / 2 if values[key] is None else values[key] for key, side in (("cx", width), ("cy", height)))
    return values["img_name"], Camera(cam_from_world.float(), values["fx"], values["fy"], cx, cy, width, height)


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
