"""What the readers of files are fuzzed with: small files of every kind, as this package and others write them."""

from __future__ import annotations

import gzip
import json
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gsply
import numpy as np
import torch

from glassplat.data.colmap_model import read_model
from glassplat.data.transforms import load_transforms
from glassplat.files.cameras_json import read_cameras, write_cameras
from glassplat.files.environment_file import read_environment, write_environment
from glassplat.files.exposures_json import read_exposures, write_exposures
from glassplat.files.glb import write_glb
from glassplat.files.planes_json import read_planes, write_planes
from glassplat.files.ply import write_gaussians
from glassplat.files.scene_folder import read_scene, write_scene
from glassplat.files.splat_files import drawable, read_splats
from glassplat.files.spz import HEADER, MAGIC, write_spz
from glassplat.scene.camera import Camera
from glassplat.scene.environment import Environment
from glassplat.scene.exposure import Exposures
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.scene import Scene


@dataclass(frozen=True)
class Reader:
    """A reader of files.

    Attributes:
        name: of the file that it is given, in a folder of its own.
        read: reads it; may raise ValueError or FileNotFoundError.
        seeds: writes files to begin with into a folder.
    """

    name: str
    read: Callable[[Path], Any]
    seeds: Callable[[Path], None]


def gaussians_of(coefficients: int, count: int = 3) -> Gaussians:
    """A few Gaussians; the same ones every time."""
    generator = torch.Generator().manual_seed(coefficients)

    def draw(*shape: int) -> torch.Tensor:
        return 0.3 * torch.randn(count, *shape, generator=generator)

    degree = round(coefficients**0.5) - 1
    return Gaussians(draw(3), draw(4), draw(3) - 3, draw(), draw(coefficients, 3), active_sh_degree=degree)


def planes_of() -> Planes:
    """One pane."""
    return Planes.rectangle((0, 0, 2), (0, 0.1, -1), (1, 0.5))


def camera_of() -> Camera:
    """One camera."""
    return Camera.look_at((0, 0, -3), (0, 0, 0), up=(0, -1, 0), width=64, height=48)


def _splats(path: Path) -> None:
    drawable(read_splats(path), path)


def _ply_seeds(folder: Path) -> None:
    for coefficients in (1, 4):
        write_gaussians(folder / f"{coefficients}.ply", gaussians_of(coefficients))
    names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()  # noqa: SIM905
    head = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {name}" for name in names), "end_header"]
    (folder / "ascii.ply").write_text("\n".join([*head, *["0.5 " * len(names)] * 2]) + "\n")


def _compressed_seeds(folder: Path) -> None:
    one = gaussians_of(4)
    values = (one.means, one.log_scales, one.quats, one.logit_opacities, one.sh[:, 0], one.sh[:, 1:])
    gsply.plywrite(str(folder / "a.ply"), *(value.contiguous().numpy() for value in values), compressed=True)


def _spz_seeds(folder: Path) -> None:
    for version in (3, 4):
        write_spz(folder / f"{version}.spz", gaussians_of(4), version)
    for version, size in ((1, 6 + 1 + 3 + 3 + 3), (2, 9 + 1 + 3 + 3 + 3)):
        head = HEADER.pack(MAGIC, version, 2, 0, 12, 0, 0)
        (folder / f"{version}.spz").write_bytes(gzip.compress(head + bytes(range(2 * size)), mtime=0))


def _splat_seeds(folder: Path) -> None:
    row = np.arange(6, dtype="<f4").tobytes() + bytes(range(100, 108))
    (folder / "a.splat").write_bytes(2 * row)


def _scene_seeds(folder: Path) -> None:
    write_scene(folder, Scene(gaussians_of(1), 1.0))
    for file in folder.iterdir():
        if file.name != "scene.json":
            file.unlink()


def _transforms_seeds(folder: Path) -> None:
    frames = [{"file_path": f"images/{index}.png", "transform_matrix": np.eye(4).tolist()} for index in range(2)]
    lens = {"fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48}
    (folder / "a.json").write_text(json.dumps({**lens, "camera_model": "OPENCV", "k1": 0.01, "frames": frames}))
    (folder / "b.json").write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))


COLMAP_PARTS = ("cameras.bin", "images.bin", "points3D.bin")


def _colmap_seeds(folder: Path) -> None:
    cameras = struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 50, 50, 32, 24)
    images = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1) + b"a.png\0" + struct.pack("<Q2dQ", 1, 1, 2, 3)
    points = struct.pack("<QQ3d3BdQ2I", 1, 1, 0, 0, 1, 9, 9, 9, 0.5, 1, 1, 0)
    (folder / "a.bin").write_bytes(b"".join(struct.pack("<I", len(part)) + part for part in (cameras, images, points)))


def _colmap(path: Path) -> None:
    """Three files in one: each with its length in front."""
    data = path.read_bytes()
    for name in COLMAP_PARTS:
        size = struct.unpack("<I", data[:4].ljust(4, b"\0"))[0]
        (path.parent / name).write_bytes(data[4 : 4 + size])
        data = data[4 + size :]
    read_model(path.parent)


def _environment(path: Path) -> None:
    read_environment(path)


def _transforms(path: Path) -> None:
    capture = load_transforms(path.parent)
    with suppress(FileNotFoundError):
        assert capture is None or capture.shots is not None


READERS: dict[str, Reader] = {
    "ply": Reader("a.ply", _splats, _ply_seeds),
    "compressed": Reader("a.ply", _splats, _compressed_seeds),
    "spz": Reader("a.spz", _splats, _spz_seeds),
    "glb": Reader("a.glb", _splats, lambda folder: write_glb(folder / "a.glb", gaussians_of(4))),
    "splat": Reader("a.splat", _splats, _splat_seeds),
    "planes": Reader("planes.json", read_planes, lambda folder: write_planes(folder / "a.json", planes_of())),
    "cameras": Reader(
        "cameras.json", read_cameras, lambda folder: write_cameras(folder / "a.json", [("a.png", camera_of())])
    ),
    "exposures": Reader(
        "exposures.json",
        read_exposures,
        lambda folder: write_exposures(folder / "a.json", Exposures.neutral(("a.png",))),
    ),
    "environment": Reader(
        "environment.safetensors",
        _environment,
        lambda folder: write_environment(folder / "a.safetensors", Environment(torch.zeros(6, 2, 2, 3))),
    ),
    "scene": Reader("scene.json", lambda path: read_scene(path.parent), _scene_seeds),
    "transforms": Reader("transforms.json", _transforms, _transforms_seeds),
    "colmap": Reader("model.bin", _colmap, _colmap_seeds),
}
