"""Opacity perturbation: shakes what lies behind a pane out of a wrong decomposition (TR-Gaussians, Section III-C3)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes


@torch.no_grad()
def behind_panes(points: Tensor, planes: Planes, cameras: Sequence[Camera]) -> Tensor:
    """[N] bool: which points some camera sees through some pane.

    A point counts if a camera on the front side of a pane (where its normal points) has the point
    in its image and the segment from the camera's centre to the point crosses the pane's rectangle.

    Args:
        points: [N, 3] world positions.
        planes: the panes.
        cameras: the training views.
    """
    found = torch.zeros(points.shape[0], dtype=torch.bool, device=points.device)
    if len(planes) == 0:
        return found
    # The views are taken one by one: all of them at once would need views x panes x points values.
    for camera in cameras:
        found |= crosses_pane(points, planes, camera.center) & in_image(points, camera)
    return found


def crosses_pane(points: Tensor, planes: Planes, eye: Tensor) -> Tensor:
    """[N] bool: whether the segment from `eye`, in front of a pane, to the point crosses the pane."""
    normals = planes.normals
    eye_distance = ((eye - planes.centers) * normals).sum(-1)
    distances = points @ normals.T - (planes.centers * normals).sum(-1)
    behind = (eye_distance > 0) & (distances < 0)
    share = torch.where(behind, eye_distance / (eye_distance - distances), 0)
    inside = behind
    for axis, half in zip(planes.axes(), planes.half_sizes.T, strict=True):
        start = ((eye - planes.centers) * axis).sum(-1)
        end = points @ axis.T - (planes.centers * axis).sum(-1)
        inside = inside & ((start + share * (end - start)).abs() <= half)
    return inside.any(dim=1)


def in_image(points: Tensor, camera: Camera) -> Tensor:
    """[N] bool: whether the points lie in the image of a camera, hidden or not."""
    pixels, depths = camera.project(points)
    size = pixels.new_tensor([camera.width, camera.height])
    return (depths > 0) & ((pixels >= 0) & (pixels <= size)).all(dim=1)


@torch.no_grad()
def perturb_opacities(
    gaussians: Gaussians,
    planes: Planes,
    cameras: Sequence[Camera],
    *,
    generator: torch.Generator,
    amplitude: float = 0.4,
    bounds: tuple[float, float] = (0.01, 0.99),
) -> tuple[Gaussians, Tensor]:
    """Adds uniform noise to the opacity of the Gaussians that are seen through a pane.

    Where the transmission image still holds part of the reflection, the depth loss and the gradient
    loss have reached a balance; a random change of opacities upsets both at once.

    Args:
        gaussians: the primary Gaussians.
        planes: the panes.
        cameras: the training views.
        generator: source of the noise, on the device of `gaussians`.
        amplitude: the noise is uniform in [-amplitude, amplitude] and acts on the activated opacity.
        bounds: range the new opacities are clamped to. The paper does not give it; the lower bound
            lies above the pruning threshold and where a Gaussian still gets a gradient, so that
            those that were wrongly lowered can return.

    Returns:
        The Gaussians and the mask [N] of those selected; forget their opacity moments.
    """
    selected = behind_panes(gaussians.means, planes, cameras)
    opacities = torch.sigmoid(gaussians.logit_opacities)
    unit = torch.rand(opacities.shape, generator=generator, dtype=opacities.dtype, device=opacities.device)
    noisy = (opacities + amplitude * (2 * unit - 1)).clamp(*bounds)
    logit_opacities = torch.where(selected, torch.logit(noisy), gaussians.logit_opacities)
    return gaussians.with_tensors({"logit_opacities": logit_opacities}), selected
