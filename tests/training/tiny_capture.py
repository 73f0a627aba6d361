"""A tiny rendered capture with one pane, for the training tests."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import torch
from PIL import Image

from glassplat.captures.dataset import Dataset
from glassplat.captures.view import PointCloud, View
from glassplat.files.ply_table import write_table
from glassplat.render.planar import Planar
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene
from glassplat.training.stage import TrainState
from tests.render.tiny_scene import camera_at, in_single_precision, pane, showcase, shown_panes


def true_scene() -> Scene:
    return in_single_precision(showcase(pane(2.0, half=0.8)))


def place_true_planes(state: TrainState, dataset: object) -> None:
    """Stands in for the plane fit, which needs more masks than the tiny capture has."""
    truth = true_scene()
    state.scene = replace(state.scene, planes=truth.planes, glass=truth.glass)


@cache
def tiny_capture() -> Dataset:
    """Six views of the tiny showcase, two of them annotated."""
    scene, views = true_scene(), []
    for index in range(6):
        camera = camera_at(0.4 * (index - 2.5), 0.1 * (-1) ** index, -0.4)
        camera = replace(camera, cam_from_world=camera.cam_from_world.float())
        with torch.no_grad():
            photo = (255 * Planar()(scene, camera).rgb.clamp(0, 1)).to(torch.uint8)
            labels = shown_panes(scene.planes, camera)[0].to(torch.uint8)
        views.append(
            View.in_memory(f"{index}.png", camera, photo=photo, pane_labels=labels if index % 3 == 0 else None)
        )
    colors = torch.rand(len(scene.primary), 3, generator=torch.Generator().manual_seed(0))
    points = PointCloud(scene.primary.means, (255 * colors).to(torch.uint8))
    return Dataset(Path("tiny"), tuple(views), tuple(views[:1]), points, scene.extent, pane_labels=(1,))


def pane_frame(planes: Planes) -> torch.Tensor:
    """[80, 3] points along the frame of the first pane, on which a plane can be fitted."""
    normal, tangent = planes.normals[0], planes.tangents[0]
    tangent = torch.nn.functional.normalize(tangent - (tangent @ normal) * normal, dim=0)
    axes = torch.stack([tangent, torch.linalg.cross(normal, tangent)]) * planes.half_sizes[0][:, None]
    along, side = torch.linspace(-1, 1, 20), torch.ones(20)
    corners = torch.cat(
        [torch.stack(pair, 1) for pair in ((along, side), (along, -side), (side, along), (-side, along))]
    )
    return planes.centers[0] + corners @ axes


def write_tiny_capture(root: Path) -> Path:
    """The same capture written as a `transforms.json` capture, all views annotated; returns its folder."""
    dataset, frames = tiny_capture(), []
    for folder in ("images", "panes"):
        (root / folder).mkdir(parents=True)
    for view in dataset.train:
        camera = view.camera
        Image.fromarray(view.photo.numpy()).save(root / "images" / view.name)
        labels = shown_panes(true_scene().planes, camera)[0].to(torch.uint8)
        Image.fromarray(labels.numpy()).save(root / "panes" / view.name)
        world_from_opengl = camera.cam_from_world.inverse() * torch.tensor([1, -1, -1, 1])
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": world_from_opengl.tolist()})
    first = dataset.train[0].camera
    lens = {"fl_x": first.fx, "fl_y": first.fy, "cx": first.cx, "cy": first.cy, "w": first.width, "h": first.height}
    (root / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    positions = torch.cat([dataset.points.positions, pane_frame(true_scene().planes)])
    rows = torch.cat([positions, torch.full_like(positions, 128)], dim=1).numpy()
    write_table(root / "points3d.ply", ["x", "y", "z", "red", "green", "blue"], rows)
    return root
