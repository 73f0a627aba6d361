"""A finished run on a COLMAP capture whose photographs have the names required by a test."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scipy.spatial.transform import Rotation

from glassplat.captures.dataset import load_dataset
from glassplat.files.images import write_image
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.model.run_directory import RunDirectory, RunSettings
from tests.training.tiny_capture import tiny_capture, true_scene


def write_colmap_capture(root: Path, names: Sequence[str]) -> list[Path]:
    """A text model of the tiny capture's first views with these names; returns the files of the photographs."""
    (root / "images").mkdir(parents=True)
    (root / "sparse" / "0").mkdir(parents=True)
    lines, files = [], []
    for index, (name, view) in enumerate(zip(names, tiny_capture().train, strict=False), start=1):
        pose = view.camera.cam_from_world.double().numpy()
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        translation = " ".join(map(str, pose[:3, 3]))
        lines.append(f"{index} {w} {x} {y} {z} {translation} 1 {name}\n\n")
        files.append(root / "images" / name)
        write_image(files[-1], view.photo)
    camera = tiny_capture().train[0].camera
    lens = f"{camera.width} {camera.height} {camera.fx} {camera.fy} {camera.cx} {camera.cy}"
    (root / "sparse" / "0" / "cameras.txt").write_text(f"1 PINHOLE {lens}\n")
    (root / "sparse" / "0" / "images.txt").write_text("".join(lines))
    return files


def write_colmap_run(path: Path, capture: Path) -> Path:
    """A run directory of the scene from which the capture was rendered."""
    directory = RunDirectory(path)
    directory.begin(PlanarRecipe(), RunSettings(str(capture), iterations=1), load_dataset(capture))
    directory.export(true_scene(), step=1)
    return path
