"""Reference blending, which defines the result: every ellipsoid or disc over every pixel, front to back."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.composite import BlendedDiscs, Composite
from glassplat.kernels.maths.blending import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN
from glassplat.kernels.maths.disc import LOW_PASS, MOST_DEVIATIONS
from glassplat.kernels.project.reference import where
from glassplat.kernels.records import LEAST_ALPHA, ON_MEAN, TILE, Deviation, Discs, Splats, TileBins


def composite(
    splats: Splats, channels: Tensor, bins: TileBins,
    *, marks: Tensor | None = None, num_primary: int | None = None, deviation: Deviation | None = None,
    absgrad: Tensor | None = None,
) -> Composite:  # fmt: skip
    """See `glassplat.kernels.composite.composite`. Of the bins, only the image size and active tiles are used."""
    num_primary = splats.opacities.shape[1] if num_primary is None else num_primary
    active = active_pixels(bins)
    images, alphas, masks, deviations = [], [], [], []
    for c in range(bins.num_cameras):
        image, alpha, mask, weights = _camera_composite(
            Splats(*(tensor[c] for tensor in splats)),
            channels[c],
            bins,
            None if marks is None else marks[c],
            num_primary,
            None if absgrad is None else absgrad[c],
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
    """Sum of w_i |z_i - mean| over the splats, given weights [H, W] per splat and values [G]."""
    covered = alpha > LEAST_ALPHA
    mean = torch.where(covered, total / torch.where(covered, alpha, 1), 0)
    mean = mean if through_mean else mean.detach()
    slack = ON_MEAN * torch.finfo(mean.dtype).eps * mean.abs()
    parts = [torch.zeros_like(mean)]
    for index, weight in weights.items():
        distance = (values[index] - mean).abs()
        parts.append(weight * torch.where(distance > slack, distance, distance.detach()))
    return torch.stack(parts).sum(0)


def _camera_composite(
    splats: Splats, channels: Tensor, bins: TileBins, marks: Tensor | None, num_primary: int, absgrad: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, dict[int, Tensor]]:
    """Image, alpha, mask and the weight [H, W] of every primary splat."""
    transmittance = splats.means2d.new_ones(bins.height, bins.width)
    image = transmittance[..., None] * channels.new_zeros(channels.shape[-1])
    mask, glass_transmittance = torch.zeros_like(transmittance), torch.ones_like(transmittance)
    running = glass_running = torch.ones_like(transmittance, dtype=torch.bool)
    weights = {}
    for index, alpha in alphas_front_to_back(splats, bins, absgrad):
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


def alphas_front_to_back(splats: Splats, bins: TileBins, absgrad: Tensor | None = None) -> Iterator[tuple[int, Tensor]]:
    """Yields index and coverage [H, W] of every drawn splat of one camera, nearest first; `absgrad` is [G, 2]."""
    like = splats.means2d
    x = torch.arange(bins.width, dtype=like.dtype) + 0.5
    y = torch.arange(bins.height, dtype=like.dtype)[:, None] + 0.5
    for index in torch.argsort(splats.depths, stable=True).tolist():
        xx, xy, yy = splats.conics[index]
        # In double precision, as in the kernels: for a needle's conic, it is a small difference of large products.
        determinant = xx.double() * yy.double() - xy.double() ** 2
        if not bool((splats.radii[index] > 0).all() & (xx > 0) & (determinant > 0)):
            continue
        dx, dy = x - splats.means2d[index, 0], y - splats.means2d[index, 1]
        if absgrad is not None:
            moves = _MovePerPixel.apply(absgrad[index], bins.height, bins.width)
            dx, dy = dx - moves[..., 0], dy - moves[..., 1]
        q = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
        coverage = splats.opacities[index] * torch.exp(-0.5 * q)
        yield index, torch.where(coverage >= ALPHA_MIN, coverage.clamp(max=ALPHA_MAX), 0)


class _MovePerPixel(torch.autograd.Function):
    """A zero shift [H, W, 2] of a splat's centre for each pixel; absolute values of the gradient are summed."""

    @staticmethod
    def forward(ctx: Any, absgrad: Tensor, height: int, width: int) -> Tensor:
        return absgrad.new_zeros(height, width, 2)

    @staticmethod
    def backward(ctx: Any, v_moves: Tensor) -> tuple[Tensor, None, None]:
        return v_moves.abs().sum((0, 1)), None, None


def active_pixels(bins: TileBins) -> Tensor:
    """Mask [C, H, W] of pixels in active tiles."""
    columns, rows = -(-bins.width // TILE), -(-bins.height // TILE)
    tiles = torch.zeros(bins.num_cameras * rows * columns, dtype=torch.bool)
    tiles[bins.active.long()] = True
    pixels = tiles.reshape(bins.num_cameras, rows, columns).repeat_interleave(TILE, 1).repeat_interleave(TILE, 2)
    return pixels[:, : bins.height, : bins.width]


class _Layer(NamedTuple):
    """One disc over the whole image: coverage and depth [H, W]."""

    alpha: Tensor
    depth: Tensor


def composite_discs(
    discs: Discs, channels: Tensor, bins: TileBins,
    *, near: float, low_pass: float = LOW_PASS, absgrad: Tensor | None = None,
) -> BlendedDiscs:  # fmt: skip
    """See `glassplat.kernels.composite.composite_discs`. Of the bins, only image size and active tiles count."""
    active = active_pixels(bins)
    blended = []
    for c in range(bins.num_cameras):
        own = Discs(discs.means2d[c], discs.maps[c], discs.opacities[c], discs.depths[c], discs.outlines)
        found = _camera(own, channels[c], bins, near, low_pass, None if absgrad is None else absgrad[c])
        blended.append([where(active[c], tensor, torch.zeros_like(tensor)) for tensor in found])
    return BlendedDiscs(*(torch.stack(tensors) for tensors in zip(*blended, strict=True)))


def _camera(
    discs: Discs, channels: Tensor, bins: TileBins, near: float, low_pass: float, absgrad: Tensor | None
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
        layer = _layer(discs, index, bins, near, low_pass, absgrad)
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


def _layer(discs: Discs, index: int, bins: TileBins, near: float, low_pass: float, absgrad: Tensor | None) -> _Layer:
    """Coverage and depth of a disc; where it is not drawn, the depth is that of its centre."""
    like = discs.means2d
    x = torch.arange(bins.width, dtype=like.dtype) + 0.5
    y = torch.arange(bins.height, dtype=like.dtype)[:, None] + 0.5
    dx, dy = x - like[index, 0], y - like[index, 1]
    if absgrad is not None:
        moves = _MovePerPixel.apply(absgrad[index], bins.height, bins.width)
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
