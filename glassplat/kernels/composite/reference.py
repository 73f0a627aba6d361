"""The definition of `composite`: every splat over every pixel, front to back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from glassplat.kernels.composite import Composite
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from glassplat.kernels.records import LEAST_ALPHA, Deviation, Splats, TileBins

TILE = 16


def composite(
    splats: Splats, channels: Tensor, bins: TileBins,
    *, marks: Tensor | None = None, num_primary: int | None = None, deviation: Deviation | None = None,
    probe: Tensor | None = None,
) -> Composite:  # fmt: skip
    """See `glassplat.kernels.composite.composite`. Of the bins, only the image size and active tiles are used."""
    num_primary = splats.opacities.shape[1] if num_primary is None else num_primary
    active = active_pixels(bins)
    images, alphas, masks, deviations = [], [], [], []
    for c in range(bins.num_cameras):
        image, alpha, mask, weights = _camera_composite(
            splats_of_camera(splats, c),
            channels[c],
            bins,
            None if marks is None else marks[c],
            num_primary,
            None if probe is None else probe[c],
        )
        images.append(image * active[c, ..., None])
        alphas.append(alpha * active[c])
        masks.append(mask * active[c])
        if deviation:
            values = channels[c, :, deviation.channel]
            spread = _spread(weights, values, image[..., deviation.channel], alpha, deviation.through_mean)
            deviations.append(deviation.where[c] * spread * active[c])
    stacked = torch.stack(deviations) if deviation else channels.new_zeros(0, 0, 0)
    return Composite(torch.stack(images), torch.stack(alphas), torch.stack(masks), stacked)


def _spread(weights: dict[int, Tensor], values: Tensor, total: Tensor, alpha: Tensor, through_mean: bool) -> Tensor:
    """Sum of w_i |z_i - mean| over the splats, with weights [H, W] by splat and values [G]."""
    covered = alpha > LEAST_ALPHA
    mean = torch.where(covered, total / torch.where(covered, alpha, 1), 0)
    mean = mean if through_mean else mean.detach()
    return torch.stack([torch.zeros_like(mean), *(w * (values[i] - mean).abs() for i, w in weights.items())]).sum(0)


def _camera_composite(
    splats: Splats, channels: Tensor, bins: TileBins, marks: Tensor | None, num_primary: int, probe: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, dict[int, Tensor]]:
    """Image, alpha, mask and the weight [H, W] of every primary splat."""
    transmittance = splats.means2d.new_ones(bins.height, bins.width)
    image = transmittance[..., None] * channels.new_zeros(channels.shape[-1])
    mask, glass_transmittance = torch.zeros_like(transmittance), torch.ones_like(transmittance)
    running = glass_running = torch.ones_like(transmittance, dtype=torch.bool)
    weights = {}
    for index, alpha in alphas_front_to_back(splats, bins, probe):
        if index < num_primary:
            after = transmittance * (1 - alpha)
            running = running & (after >= TRANSMITTANCE_MIN)
            weights[index] = weight = torch.where(running, alpha * transmittance, 0)
            image = image + torch.where((weight > 0)[..., None], weight[..., None] * channels[index], 0)
            transmittance = torch.where(running, after, transmittance)
        elif marks is not None:
            after = glass_transmittance * (1 - alpha)
            glass_running = glass_running & (~running | (after >= TRANSMITTANCE_MIN))
            seen = running & glass_running
            shown = alpha * transmittance * glass_transmittance * marks[index - num_primary]
            mask = mask + torch.where(seen, shown, 0)
            glass_transmittance = torch.where(seen, after, glass_transmittance)
    return image, 1 - transmittance, mask, weights


def alphas_front_to_back(splats: Splats, bins: TileBins, probe: Tensor | None = None) -> Iterator[tuple[int, Tensor]]:
    """Index and coverage [H, W] of every splat of one camera that is drawn, nearest first; `probe` [G, 2]."""
    like = splats.means2d
    x = torch.arange(bins.width, dtype=like.dtype) + 0.5
    y = torch.arange(bins.height, dtype=like.dtype)[:, None] + 0.5
    for index in torch.argsort(splats.depths, stable=True).tolist():
        xx, xy, yy = splats.conics[index]
        if not bool((splats.radii[index] > 0).all() & (xx > 0) & (xx * yy - xy * xy > 0)):
            continue
        dx, dy = x - splats.means2d[index, 0], y - splats.means2d[index, 1]
        if probe is not None:
            moves = _MovePerPixel.apply(probe[index], bins.height, bins.width)
            dx, dy = dx - moves[..., 0], dy - moves[..., 1]
        q = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
        coverage = splats.opacities[index] * torch.exp(-0.5 * q)
        yield index, torch.where(coverage >= ALPHA_MIN, coverage.clamp(max=ALPHA_MAX), 0)


class _MovePerPixel(torch.autograd.Function):
    """A move [H, W, 2] of a splat's centre for each pixel on its own, all zero; the gradient is summed unsigned."""

    @staticmethod
    def forward(ctx: Any, probe: Tensor, height: int, width: int) -> Tensor:
        return probe.new_zeros(height, width, 2)

    @staticmethod
    def backward(ctx: Any, v_moves: Tensor) -> tuple[Tensor, None, None]:
        return v_moves.abs().sum((0, 1)), None, None


def active_pixels(bins: TileBins) -> Tensor:
    """[C, H, W] bool: whether a pixel lies in an active tile."""
    columns, rows = -(-bins.width // TILE), -(-bins.height // TILE)
    tiles = torch.zeros(bins.num_cameras * rows * columns, dtype=torch.bool)
    tiles[bins.active.long()] = True
    pixels = tiles.reshape(bins.num_cameras, rows, columns).repeat_interleave(TILE, 1).repeat_interleave(TILE, 2)
    return pixels[:, : bins.height, : bins.width]


def splats_of_camera(splats: Splats, camera: int) -> Splats:
    """The splats of one camera, [G, ...]."""
    return Splats(*(tensor[camera] for tensor in splats))
