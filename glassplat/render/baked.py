"""Reflections as Gaussians behind the panes, for viewers that know nothing of panes."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from glassplat.kernels.turned_harmonics import turned_harmonics
from glassplat.render.frame import Renderer
from glassplat.render.splat import Splat
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.mirrored import mirrored_gaussians
from glassplat.scene.scene import Scene
from glassplat.scene.sight import behind_panes

MOST_CAMERAS = 24
"""Views over which the strength of a pane is averaged; a few more change it in the third digit."""
COMPARED_CAMERAS = 5
GAINS = (1.0, 1.5, 2.0, 3.0)
"""Candidates: blended in sRGB, as viewers do, a weak reflection has to weigh more than in linear radiance."""
OPAQUE = 1 - 1e-6


@torch.no_grad()
def baked(scene: Scene, renderer: Renderer, cameras: Sequence[Camera]) -> Gaussians:
    """The primary Gaussians, and behind each pane their mirror images, as a set that any viewer shows.

    A mirror image has the mirrored shape and the mirrored harmonics; its opacity is multiplied by the mean strength
    of its pane over the cameras' views, and by the one of `GAINS` that comes nearest to the true render from some of
    them. Only those are added that some camera sees through the pane. What this cannot show: a strength that follows
    the angle, light that adds up (a mirror image covers what is behind it), and reflections in front of an opaque wall.

    Args:
        scene: with panes; without any, its primary Gaussians come back as they are.
        renderer: of the run, whose frames have `strength`.
        cameras: from where the scene will be looked at; the training cameras.
    """
    strengths = mean_strengths(scene, renderer, cameras)
    images = [_mirror_images(scene, row, cameras) for row in range(len(strengths))]
    compared = _showing_panes(scene, renderer, cameras)

    def with_gain(gain: float) -> Gaussians:
        weaker = [_weakened(part, gain * strength) for part, strength in zip(images, strengths, strict=True)]
        return functools.reduce(Gaussians.joined, weaker, scene.primary)

    def error(gain: float) -> float:
        candidate = Scene(with_gain(gain), scene.extent)
        return sum(float((Splat()(candidate, camera).rgb - truth).square().mean()) for camera, truth in compared)

    return with_gain(min(GAINS, key=error) if compared else 1.0)


def _showing_panes(scene: Scene, renderer: Renderer, cameras: Sequence[Camera]) -> list[tuple[Camera, Tensor]]:
    """Some cameras that show a pane, with what they see [H, W, 3]."""
    found = []
    for camera in cameras[:: max(1, len(cameras) // (2 * COMPARED_CAMERAS))]:
        frame = renderer(scene, camera)
        if "strength" in frame.layers and bool((frame.layers["strength"] > 0).any()):
            found.append((camera, frame.rgb))
    return found[:COMPARED_CAMERAS]


@torch.no_grad()
def mean_strengths(scene: Scene, renderer: Renderer, cameras: Sequence[Camera]) -> list[float]:
    """For each pane the mean share of light that it reflects, over the pixels of all views that show it; 0 if none."""
    chosen = cameras[:: max(1, -(-len(cameras) // MOST_CAMERAS))]
    strengths = []
    for row in range(len(scene.planes)):
        alone = replace(scene, planes=scene.planes.select([row]))
        total, count = 0.0, 0
        for camera in chosen:
            strength = renderer(alone, camera).layers["strength"]
            shown = strength > 0
            total, count = total + float(strength[shown].sum()), count + int(shown.sum())
        strengths.append(total / count if count else 0.0)
    return strengths


def mirrored_harmonics(sh: Tensor, normal: Tensor) -> Tensor:
    """Coefficients [N, K, 3] of colours seen in a mirror: the same colour along the mirrored direction.

    Args:
        sh: [N, K, 3], K in {0, 1, 4, 9, 16}.
        normal: [3] unit normal of the mirror.
    """
    return turned_harmonics(sh, torch.eye(3).to(normal) - 2 * normal[:, None] * normal)


def _mirror_images(scene: Scene, row: int, cameras: Sequence[Camera]) -> Gaussians:
    """The mirror images of one pane that some camera sees through it."""
    plane = scene.planes.select([row])
    center, normal = plane.centers[0], plane.normals[0]
    images = mirrored_gaussians(scene.primary, center, normal)
    images = images.with_tensors({"sh": mirrored_harmonics(scene.primary.sh, normal)})
    return images.select(behind_panes(images.means, plane, cameras))


def _weakened(gaussians: Gaussians, factor: float) -> Gaussians:
    opacities = (factor * torch.sigmoid(gaussians.logit_opacities)).clamp(max=OPAQUE)
    return gaussians.with_tensors({"logit_opacities": torch.logit(opacities, eps=1e-6)})
