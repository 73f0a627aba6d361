"""The definition of `composite_discs`: every disc over every pixel, front to back."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.composite.reference import _MovePerPixel, active_pixels
from glassplat.kernels.composite_discs.operation import BlendedDiscs
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from glassplat.kernels.maths.disc import LOW_PASS
from glassplat.kernels.maths.ray_hit import MOST_DEVIATIONS
from glassplat.kernels.records import Discs, TileBins


class _Layer(NamedTuple):
    """One disc over the whole image: coverage and depth [H, W]."""

    alpha: Tensor
    depth: Tensor


def composite_discs(
    discs: Discs, channels: Tensor, bins: TileBins,
    *, near: float, low_pass: float = LOW_PASS, probe: Tensor | None = None,
) -> BlendedDiscs:  # fmt: skip
    """See `glassplat.kernels.composite_discs.composite_discs`. Of the bins, only image size and active tiles count."""
    active = active_pixels(bins)
    blended = []
    for c in range(bins.num_cameras):
        own = Discs(discs.means2d[c], discs.maps[c], discs.opacities[c], discs.depths[c], discs.outlines)
        found = _camera(own, channels[c], bins, near, low_pass, None if probe is None else probe[c])
        blended.append([torch.where(_over(active[c], x), x, torch.zeros_like(x)) for x in found])
    return BlendedDiscs(*(torch.stack(tensors) for tensors in zip(*blended, strict=True)))


def _over(mask: Tensor, value: Tensor) -> Tensor:
    return mask.reshape(mask.shape + (1,) * (value.dim() - 2))


def _camera(
    discs: Discs, channels: Tensor, bins: TileBins, near: float, low_pass: float, probe: Tensor | None
) -> tuple[Tensor, ...]:
    """Image, alpha, depth, median and distortion of one camera."""
    transmittance = discs.means2d.new_ones(bins.height, bins.width)
    image = transmittance[..., None] * channels.new_zeros(channels.shape[-1])
    depth = median = distortion = torch.zeros_like(transmittance)
    running = torch.ones_like(transmittance, dtype=torch.bool)
    shown: list[tuple[Tensor, Tensor]] = []
    for index in torch.argsort(discs.depths, stable=True).tolist():
        if not bool(discs.opacities[index] > 0):
            continue
        layer = _layer(discs, index, bins, near, low_pass, probe)
        after = transmittance * (1 - layer.alpha)
        running = running & (after >= TRANSMITTANCE_MIN)
        weight = torch.where(running, layer.alpha * transmittance, 0)
        image = image + torch.where((weight > 0)[..., None], weight[..., None] * channels[index], 0)
        depth = depth + weight * layer.depth
        median = torch.where((weight > 0) & (transmittance > 0.5), layer.depth, median)
        for other, inverse in shown:
            distortion = distortion + weight * other * (1 / layer.depth - inverse).square()
        shown.append((weight, 1 / layer.depth))
        transmittance = torch.where(running, after, transmittance)
    return image, 1 - transmittance, depth, median, distortion


def _layer(discs: Discs, index: int, bins: TileBins, near: float, low_pass: float, probe: Tensor | None) -> _Layer:
    """What a disc covers, and where; elsewhere the depth is that of its centre."""
    like = discs.means2d
    x = torch.arange(bins.width, dtype=like.dtype) + 0.5
    y = torch.arange(bins.height, dtype=like.dtype)[:, None] + 0.5
    dx, dy = x - like[index, 0], y - like[index, 1]
    if probe is not None:
        moves = _MovePerPixel.apply(probe[index], bins.height, bins.width)
        dx, dy = dx - moves[..., 0], dy - moves[..., 1]
    u_x, u_y, v_x, v_y, w_x, w_y = discs.maps[index]
    e = 1 + w_x * dx + w_y * dy
    in_front = (e > 0) & (discs.depths[index] > near * e)
    safe = torch.where(in_front, e, 1)
    u, v = (u_x * dx + u_y * dy) / safe, (v_x * dx + v_y * dy) / safe
    solid = torch.where(in_front, u * u + v * v, torch.inf)
    around = (dx * dx + dy * dy) / low_pass**2 if low_pass else torch.full_like(solid, torch.inf)
    on_disc = in_front & ~(around < solid)
    q = torch.where(on_disc, torch.where(on_disc, solid, 0), around)
    covered = discs.opacities[index] * torch.exp(-0.5 * q.clamp(max=4 * MOST_DEVIATIONS**2))
    drawn = (q <= MOST_DEVIATIONS**2) & (covered >= ALPHA_MIN)
    alpha = torch.where(drawn, covered.clamp(max=ALPHA_MAX), 0)
    return _Layer(alpha, discs.depths[index] / torch.where(on_disc & drawn, e, 1))
