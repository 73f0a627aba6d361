"""Where the cameras of test views really are: the pose from which a trained scene looks most like the photograph."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from glassplat.data.corrected_views import plain
from glassplat.data.dataset import Dataset
from glassplat.data.ignored import with_ignored_right
from glassplat.data.view import View
from glassplat.kernels.photometric import photometric
from glassplat.render.frame import Renderer
from glassplat.scene.camera import Camera
from glassplat.scene.pose_correction import moved_camera
from glassplat.scene.scene import Scene

STEPS = 40
FIRST_STEP, LAST_STEP = 1.5e-3, 5e-5
"""Radians, and extents; steps shrink from the one to the other."""
SSIM_SHARE = 0.2
Listener = Callable[[int, int], None]


def with_aligned_test_views(
    scene: Scene, renderer: Renderer, dataset: Dataset, listen: Listener = lambda done, count: None
) -> Dataset:
    """The capture with each test camera moved to where its photograph agrees best with the scene.

    Poses from structure from motion are off, and a scene whose training cameras were refined is at odds with those of
    the test views through no fault of its own (as is done for NeRF--, BARF and nerfstudio).

    Args:
        scene: trained; not changed.
        renderer: how photographs show it.
        dataset: whose test views are aligned.
        listen: is told how many views are done.
    """
    test = []
    for done, view in enumerate(dataset.test):
        listen(done, len(dataset.test))
        test.append(view.with_camera(aligned_camera(scene, renderer, view)))
    return replace(dataset, test=tuple(test))


def aligned_camera(scene: Scene, renderer: Renderer, view: View, *, steps: int = STEPS) -> Camera:
    """The camera from which the scene looks most like the view's photograph, starting from the view's own.

    Args:
        scene: trained; gets no gradient.
        renderer: how photographs show it.
        view: photograph and camera.
        steps: of Adam.
    """
    device = scene.primary.means.device
    still = scene.with_parameters({name: tensor.detach() for name, tensor in scene.parameters().items()})
    camera, photo = view.camera.to(device), view.photo.to(device)
    twist = torch.zeros(6, device=device, requires_grad=True)
    optimizer = torch.optim.Adam([twist], lr=FIRST_STEP, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, (LAST_STEP / FIRST_STEP) ** (1 / max(steps, 1)))
    best, lowest = torch.zeros_like(twist), torch.inf
    for _ in range(steps):
        optimizer.zero_grad()
        image = renderer(still, moved_camera(camera, twist, scene.extent)).rgb
        found = photometric(with_ignored_right(image, view), photo)
        loss = found.l1.lerp(1 - found.ssim, SSIM_SHARE)
        if (value := float(loss.detach())) < lowest:
            best, lowest = twist.detach().clone(), value
        if not loss.requires_grad:  # Nothing of the scene is in sight.
            break
        loss.backward()
        optimizer.step()
        schedule.step()
    return plain(moved_camera(camera, best, scene.extent))
