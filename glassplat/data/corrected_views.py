"""A capture whose cameras stand where training found them to be."""

from __future__ import annotations

from dataclasses import replace

import torch

from glassplat.data.dataset import Dataset
from glassplat.data.view import View
from glassplat.scene.camera import Camera
from glassplat.scene.scene import Scene


@torch.no_grad()
def with_corrected_cameras(dataset: Dataset, scene: Scene) -> Dataset:
    """The capture with the cameras of its photographs corrected as the scene says; itself where nothing is.

    Nobody has looked where the cameras of test views are: they move as those of the photographs before and after them.

    Args:
        dataset: as it was read.
        scene: whose `poses` were learned on it.
    """
    if not len(scene.poses):
        return dataset

    def corrected(view: View) -> View:
        camera = scene.poses.interpolated(view.name).corrected(view.camera, view.name, scene.extent)
        return view if camera is view.camera else view.with_camera(plain(camera))

    return replace(dataset, train=tuple(map(corrected, dataset.train)), test=tuple(map(corrected, dataset.test)))


def plain(camera: Camera) -> Camera:
    """The camera in memory, cut off from the autograd graph."""
    return replace(camera, cam_from_world=camera.cam_from_world.detach().cpu())
