"""Blended distance of splats from a depth map: what keeps reflections from becoming floaters."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from glassplat.kernels.blend_inputs import check_splats, check_tensor, primary_count
from glassplat.kernels.cpu import depth_deviation as cpu
from glassplat.kernels.splats import Splats, TileBins


def depth_deviation(splats: Splats, depth_map: Tensor, bins: TileBins, *, num_primary: int | None = None) -> Tensor:
    """Mean absolute distance in depth between what is blended and a depth map (TR-Gaussians, Eq. 14).

        deviation(u) = sum over primary i of |z_i - D(u)| alpha_i(u) T_i(u)

    in world units, with alpha, T and the stopping rule of `composite`. The hit mask of Eq. 14 is the caller's:
    pixels of tiles that are not active are zero.

    Differentiable in `means2d`, `conics`, `opacities`, `depths` and `depth_map`; detach the map to keep it fixed.

    Args:
        splats: [C, G] splats; those with index >= `num_primary` are glass and take no part.
        depth_map: [C, H, W] depth D to compare with, camera z in world units.
        bins: the same splats sorted into tiles; `active` may be a subset of the tiles.
        num_primary: how many splats are primary; all of them by default.

    Returns:
        [C, H, W] deviation.

    Raises:
        TypeError: tensors are not all float32 or all float64.
        ValueError: shapes disagree, or the tensors are not on the CPU.
    """
    check_splats(splats, bins)
    num_primary = primary_count(num_primary, splats)
    check_tensor("depth_map", depth_map, (bins.num_cameras, bins.height, bins.width), like=splats.means2d)
    deviation: Tensor = _DepthDeviation.apply(*splats, depth_map, bins, num_primary)
    return deviation


class _DepthDeviation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Tensor:
        *tensors, bins, num_primary = arguments
        *fields, depth_map = (tensor.detach().contiguous() for tensor in tensors)
        deviation, ctx.saved = cpu.depth_deviation(Splats(*fields), depth_map, bins, num_primary=num_primary)
        ctx.save_for_backward(*fields, depth_map)
        ctx.bins, ctx.num_primary = bins, num_primary
        return deviation

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_deviation: Tensor) -> tuple[Tensor | None, ...]:
        *fields, depth_map = ctx.saved_tensors
        v_means, v_conics, v_opacities, v_depths, v_depth_map = cpu.depth_deviation_gradients(
            Splats(*fields), depth_map, ctx.bins, ctx.saved, v_deviation, num_primary=ctx.num_primary
        )
        return v_means, v_conics, v_opacities, v_depths, None, v_depth_map, None, None
