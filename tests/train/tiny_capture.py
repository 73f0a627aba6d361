"""A tiny rendered capture with one pane, for the training tests."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import torch

from glassplat.data.dataset import Dataset, PointCloud, View
from glassplat.render.planar import Planar
from glassplat.scene.scene import Scene
from tests.render.tiny_scene import camera_at, in_single_precision, nearest_hits, pane, showcase


def true_scene() -> Scene:
    return in_single_precision(showcase(pane(2.0, half=0.8)))


@cache
def tiny_capture() -> Dataset:
    """Six views of the tiny showcase, two of them annotated."""
    scene, views = true_scene(), []
    for index in range(6):
        camera = camera_at(0.4 * (index - 2.5), 0.1 * (-1) ** index, -0.4)
        camera = replace(camera, cam_from_world=camera.cam_from_world.float())
        with torch.no_grad():
            photo = (255 * Planar()(scene, camera).rgb.clamp(0, 1)).to(torch.uint8)
            labels = nearest_hits(scene.planes, camera)[0].to(torch.uint8)
        views.append(
            View.in_memory(f"{index}.png", camera, photo=photo, pane_labels=labels if index % 3 == 0 else None)
        )
    points = PointCloud(scene.primary.means, (255 * torch.rand(len(scene.primary), 3)).to(torch.uint8))
    return Dataset(Path("tiny"), tuple(views), tuple(views[:1]), points, scene.extent, pane_labels=(1,))
