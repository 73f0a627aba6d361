"""The first glass Gaussians: flat discs spread over each pane (TR-Gaussians, Section III-C1)."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from glassplat.scene.activations import logit
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.plane import Planes
from glassplat.scene.scene import Scene

OVERLAP = 0.7
"""Standard deviation of a disc, in distances between neighbours; the discs blend into an even sheet."""
THICKNESS = 0.05
"""Standard deviation across the pane, as a share of that along it."""
OPAQUE_SHEET = 0.9
"""Opacity of discs that cover a pane which nobody trains."""


def glass_gaussians(
    planes: Planes, *, count: int = 1000, seed: int = 0, opacity: float = 0.5, mark: float = 0.99
) -> Gaussians:
    """Glass Gaussians on every pane's rectangle.

    They are spread by a scrambled Sobol sequence, so that chance leaves no holes. At the default
    opacity the sheet shows a mask of about 0.8 from the first step on, and training thins it out where
    the rectangle is larger than the pane.

    Args:
        planes: the panes.
        count: Gaussians on each pane.
        seed: of the places.
        opacity: of each Gaussian, in (0, 1).
        mark: m of each Gaussian, in (0, 1); the paper's 1 has no finite logit.
    """
    panes = [_pane_discs(planes, index, count=count, seed=seed) for index in range(len(planes))]
    if not panes:
        return Gaussians.empty(channels=("logit_mark",))
    means, quats, log_scales = (torch.cat(tensors) for tensors in zip(*panes, strict=True))
    number = len(means)
    return Gaussians(
        means=means,
        quats=quats,
        log_scales=log_scales,
        logit_opacities=torch.full((number,), logit(opacity)),
        sh=torch.zeros(number, 0, 3),
        channels={"logit_mark": torch.full((number,), logit(mark))},
    ).to(planes.centers.device)


def with_pane(scene: Scene, pane: Planes) -> Scene:
    """The scene with one more pane, its rectangle evenly covered with glass.

    Args:
        scene: any; Gaussians that do not say how bright they are in a pane are as bright as they are.
        pane: a single plane.

    Raises:
        ValueError: the scene has a pane of that label.
    """
    if set(pane.labels) & set(scene.planes.labels):
        raise ValueError(f"the scene has a pane {pane.labels[0]} already; its panes are {list(scene.planes.labels)}")
    pane = pane.to(scene.primary.means.device)
    glass = glass_gaussians(pane, opacity=OPAQUE_SHEET)
    return replace(
        scene,
        primary=with_intensity(scene.primary),
        planes=scene.planes.joined(pane) if len(scene.planes) else pane,
        glass=scene.glass.joined(glass) if len(scene.glass) else glass,
    )


def with_intensity(gaussians: Gaussians) -> Gaussians:
    """The Gaussians with an intensity of 1 in what panes mirror, unless they have one."""
    if "log_intensity" in gaussians.channels:
        return gaussians
    return replace(gaussians, channels={**gaussians.channels, "log_intensity": torch.zeros_like(gaussians.means[:, 0])})


def _pane_discs(planes: Planes, index: int, *, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Means [M, 3], quats [M, 4] and log scales [M, 3] of the discs on one pane."""
    half = planes.half_sizes[index].detach().cpu()
    places = SobolEngine(dimension=2, scramble=True, seed=seed + index).draw(count)
    tangent, bitangent = (axis[index].detach().cpu() for axis in planes.axes())
    in_plane = (2 * places - 1) * half
    means = planes.centers[index].detach().cpu() + in_plane @ torch.stack([tangent, bitangent])

    frame = torch.stack([tangent, bitangent, planes.normals[index].detach().cpu()], dim=1)
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(frame.double().numpy()).as_quat()
    quat = torch.tensor([w, x, y, z], dtype=torch.float32)
    along = OVERLAP * math.sqrt(float(4 * half.prod()) / count)
    log_scales = torch.tensor([along, along, THICKNESS * along]).log()
    return means, quat.repeat(len(means), 1), log_scales.repeat(len(means), 1)
