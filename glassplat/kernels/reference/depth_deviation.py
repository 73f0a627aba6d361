"""The definition of `depth_deviation`: every primary splat over every pixel, front to back."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.kernels.maths_blend import TRANSMITTANCE_MIN
from glassplat.kernels.reference.composite import active_pixels, alphas_front_to_back, splats_of_camera
from glassplat.kernels.splats import Splats, TileBins


def depth_deviation(splats: Splats, depth_map: Tensor, bins: TileBins, *, num_primary: int | None = None) -> Tensor:
    """See `glassplat.kernels.depth_deviation.depth_deviation`."""
    num_primary = splats.opacities.shape[1] if num_primary is None else num_primary
    cameras = [
        _camera_deviation(splats_of_camera(splats, c), depth_map[c], bins, num_primary) for c in range(bins.num_cameras)
    ]
    return torch.stack(cameras) * active_pixels(bins)


def _camera_deviation(splats: Splats, depth_map: Tensor, bins: TileBins, num_primary: int) -> Tensor:
    transmittance, deviation = torch.ones_like(depth_map), torch.zeros_like(depth_map)
    running = torch.ones_like(depth_map, dtype=torch.bool)
    for index, alpha in alphas_front_to_back(splats, bins):
        if index >= num_primary:
            continue
        after = transmittance * (1 - alpha)
        running = running & (after >= TRANSMITTANCE_MIN)
        weight = torch.where(running, alpha * transmittance, 0)
        deviation = deviation + weight * (splats.depths[index] - depth_map).abs()
        transmittance = torch.where(running, after, transmittance)
    return deviation
