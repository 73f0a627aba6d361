"""A finished run of a hand-made scene on a tiny capture, without any training."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from glassplat.captures.dataset import Dataset, load_dataset
from glassplat.files.images import write_image
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model.run_directory import RunDirectory, RunSettings
from glassplat.render.planar import Planar
from glassplat.scene.scene import Scene
from tests.training.tiny_capture import tiny_capture, true_scene

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def write_capture(folder: Path) -> Dataset:
    """The six photographs of the tiny capture with their poses, as transforms.json."""
    frames = []
    views = tiny_capture().train
    for view in views:
        write_image(folder / "images" / view.name, view.photo)
        pose = np.linalg.inv(view.camera.cam_from_world.double().numpy()) @ OPENGL_FROM_OPENCV
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": pose.tolist()})
    camera = views[0].camera
    lens = {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
    }
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return load_dataset(folder)


def write_run(path: Path, *, planar: bool = True) -> Path:
    """A run directory of the scene from which the capture was rendered; the capture is stored next to it."""
    data = path.parent / "capture"
    dataset = load_dataset(data) if data.is_dir() else write_capture(data)
    recipe = PlanarRecipe() if planar else SplatRecipe()
    directory = RunDirectory(path)
    directory.begin(recipe, RunSettings(str(data), iterations=1), dataset)
    scene = true_scene()
    directory.export(scene if planar else Scene(scene.primary, scene.extent), step=1)
    return path


def rendered(scene: Scene, view_index: int) -> torch.Tensor:
    """A view of the tiny capture [H, W, 3] uint8, rendered from another scene."""
    camera = tiny_capture().train[view_index].camera
    with torch.no_grad():
        image = Planar()(replace(scene), camera).rgb
    return torch.round(image.clamp(0, 1) * 255).to(torch.uint8)
