"""Tiny captures on disk: a ring of cameras about a few coloured points."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

WIDTH, HEIGHT, FOCAL = 32, 24, 30.0


def look_at(center: np.ndarray, target: np.ndarray) -> np.ndarray:
    """[4, 4] `cam_from_world` in OpenCV axes; world up is +z."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ center
    return pose


@dataclass
class TinyCapture:
    """Contents of a capture; every field may be changed before writing."""

    root: Path
    names: list[str]
    poses: list[np.ndarray]
    points: np.ndarray
    colors: np.ndarray
    lenses: list[tuple[str, list[float]]] = field(
        default_factory=lambda: [("PINHOLE", [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])]
    )
    size: tuple[int, int] = (WIDTH, HEIGHT)

    def write_images(self, mode: str = "RGB", folder: str = "images") -> None:
        """One noise image per name."""
        generator = np.random.default_rng(1)
        channels = {"RGB": (3,), "RGBA": (4,), "L": ()}[mode]
        for name in self.names:
            path = self.root / folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            pixels = generator.integers(0, 255, (self.size[1], self.size[0], *channels), dtype=np.uint8)
            Image.fromarray(pixels).save(path)

    def reconstruction(self) -> Any:
        """The capture as COLMAP's own data structure; images use the lenses in turn."""
        pycolmap = pytest.importorskip("pycolmap")
        model = pycolmap.Reconstruction()
        for index, (name, parameters) in enumerate(self.lenses):
            model.add_camera_with_trivial_rig(
                pycolmap.Camera(
                    camera_id=index + 1, model=name, width=self.size[0], height=self.size[1], params=parameters
                )
            )
        for index, (name, pose) in enumerate(zip(self.names, self.poses, strict=True)):
            camera_id = index % len(self.lenses) + 1
            image = pycolmap.Image(name=name, camera_id=camera_id, image_id=index + 1, points2D=[])
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
        for position, color in zip(self.points, self.colors, strict=True):
            model.add_point3D(position, pycolmap.Track(), color)
        return model

    def write_colmap(self, *, binary: bool = True, folder: str = "sparse/0") -> Path:
        """Images and the model; returns the model's folder."""
        self.write_images()
        target = self.root / folder
        target.mkdir(parents=True, exist_ok=True)
        model = self.reconstruction()
        if binary:
            model.write_binary(target)
        else:
            model.write_text(target)
        return target

    def frames(self, prefix: str = "images/") -> list[dict[str, Any]]:
        """Frames of a `transforms.json`: camera-to-world, +y up and looking along -z."""
        matrices = [np.linalg.inv(pose) * [1, -1, -1, 1] for pose in self.poses]
        return [
            {"file_path": f"{prefix}{name}", "transform_matrix": matrix.tolist()}
            for name, matrix in zip(self.names, matrices, strict=True)
        ]

    def write_transforms(self, settings: dict[str, Any], *, file_name: str = "transforms.json") -> None:
        """The JSON file alone."""
        self.root.mkdir(parents=True, exist_ok=True)
        (self.root / file_name).write_text(json.dumps(settings))

    def write_mask(self, path: str, pixels: np.ndarray | Sequence[Any], **options: Any) -> Path:
        """One mask, uint8 or uint16, grey or RGB."""
        target = self.root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.asarray(pixels)).save(target, **options)
        return target


@pytest.fixture
def capture(tmp_path: Path) -> TinyCapture:
    """Ten cameras on a ring of radius 2 about the origin, looking at it from slightly above."""
    generator = np.random.default_rng(0)
    angles = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    centers = [np.array([2 * np.cos(a), 2 * np.sin(a), 0.5]) for a in angles]
    return TinyCapture(
        root=tmp_path / "capture",
        names=[f"{index:04d}.png" for index in range(len(centers))],
        poses=[look_at(center, np.zeros(3)) for center in centers],
        points=generator.uniform(-0.5, 0.5, (7, 3)),
        colors=generator.integers(0, 255, (7, 3), dtype=np.uint8),
    )
