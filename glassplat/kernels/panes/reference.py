"""The definition of the operations on panes, in PyTorch."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from glassplat.kernels import Fresnel
from glassplat.kernels.maths.images import linear_from_srgb, srgb_from_linear
from glassplat.kernels.maths.pane import DARKEST, FULL_WEIGHT_RATIO
from glassplat.kernels.records import BEHIND, DAZZLING, TILE, BlendedPanes, PaneHits, Panes


def pane_hits(
    panes: Panes,
    intrinsics: Tensor,
    width: int,
    height: int,
    mask: Tensor | None = None,
    *,
    beyond: PaneHits | None = None,
) -> PaneHits:
    """See `glassplat.kernels.panes.pane_hits`."""
    rays = ray_grid(intrinsics, width, height)
    count = panes.centers.shape[0]
    distance = (panes.centers * panes.normals).sum(-1)
    depth = distance[:, None, None] / torch.einsum("hwi,ki->khw", rays, panes.normals)
    inside = depth > 0
    for axis in range(2):
        along = torch.einsum("hwi,ki->khw", rays, panes.axes[:, axis]) * depth
        offset = along - (panes.centers * panes.axes[:, axis]).sum(-1)[:, None, None]
        inside &= offset.abs() <= panes.half_sizes[:, axis, None, None]
    if beyond is not None:
        # A pane is not behind itself or a coplanar one, however depths are rounded.
        own = beyond.pane == torch.arange(count, device=beyond.pane.device)[:, None, None]
        inside &= (depth > beyond.depth * BEHIND) & ~own
    far = torch.full((1, height, width), torch.inf, dtype=rays.dtype)
    nearest, index = torch.cat([far, torch.where(inside, depth, torch.inf)]).min(dim=0)
    index = torch.where(nearest < torch.inf, index, 0) - 1
    shown = torch.stack([index == k for k in range(count)]) if count else torch.zeros(0, height, width).bool()
    if mask is not None:
        shown &= mask > 0
    tiles = torch.nn.functional.max_pool2d(shown.float()[:, None], TILE, ceil_mode=True)[:, 0] > 0
    windows = torch.zeros(count, 4, dtype=rays.dtype)
    for k in range(count):
        rows, columns = shown[k].nonzero().unbind(-1)
        if len(rows):
            windows[k] = torch.stack([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1])
    return PaneHits(index.to(torch.int32), nearest, tiles, windows)


def ray_grid(intrinsics: Tensor, width: int, height: int) -> Tensor:
    """Rays [H, W, 3] through the pixel centres, (x, y, 1) in the camera frame."""
    columns, rows = (torch.arange(n, dtype=intrinsics.dtype, device=intrinsics.device) for n in (width, height))
    return pixel_rays(intrinsics, columns, rows[:, None])


def pixel_rays(intrinsics: Tensor, columns: Tensor, rows: Tensor) -> Tensor:
    """Rays [..., 3] through the centres of pixels, (x, y, 1) in the camera frame; columns and rows are broadcast."""
    fx, fy, cx, cy = intrinsics
    x, y = torch.broadcast_tensors((columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy)
    return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def two_surfaces(base: Tensor, cosine: Tensor) -> Tensor:
    """Snell's and Fresnel's laws at a surface, for both polarisations, with multiple reflections between two."""
    one_surface = torch.sqrt(base / (2 - base))
    inverse_index = (1 - one_surface) / (1 + one_surface)
    inside = torch.sqrt(1 - inverse_index**2 * (1 - cosine**2))
    across = ((inverse_index * cosine - inside) / (inverse_index * cosine + inside)) ** 2
    along = ((cosine - inverse_index * inside) / (cosine + inverse_index * inside)) ** 2
    return across / (1 + across) + along / (1 + along)


REFLECTANCE: dict[Fresnel, Callable[[Tensor, Tensor], Tensor]] = {
    "pane": two_surfaces,
    "schlick": lambda base, cosine: base + (1 - base) * (1 - cosine) ** 5,
    "none": lambda base, cosine: base,
}


def blend_panes(
    transmission: Tensor, mask: Tensor, reflections: Tensor, pane: Tensor,
    normals: Tensor, base_reflectances: Tensor, intrinsics: Tensor,
    *, fresnel: Fresnel = "pane", intensity: bool = True, linear: bool = True,
) -> BlendedPanes:  # fmt: skip
    """See `glassplat.kernels.panes.blend_panes`."""
    height, width = mask.shape
    rays = torch.nn.functional.normalize(ray_grid(intrinsics, width, height), dim=-1)
    strength, reflection = torch.zeros_like(mask), torch.zeros_like(transmission)
    for k in range(len(normals)):
        shown = (pane == k) & (mask > 0)
        cosine = (rays @ normals[k]).abs().clamp(max=1)
        base = base_reflectances[k]
        gain = 1 + reflections[k, ..., 3:] if intensity else torch.ones_like(mask)[..., None]
        share = REFLECTANCE[fresnel](base, cosine)
        share = torch.where(gain[..., 0] <= DAZZLING, share, share.detach())
        strength = torch.where(shown, share * mask, strength)
        color = reflections[k, ..., :3]
        bright = srgb_from_linear(linear_from_srgb(color) * gain) if linear else color * gain
        reflection = torch.where(shown[..., None], bright, reflection)
    share = strength[..., None]
    if linear:
        behind, mirrored = linear_from_srgb(transmission), linear_from_srgb(reflection)
        mixed = srgb_from_linear(behind + share * (mirrored - behind))
    else:
        mixed = transmission + share * (reflection - transmission)
    return BlendedPanes(torch.where(share > 0, mixed, transmission), reflection, strength)


GREY = 0.5
"""Placeholder for strength and light of pixels that are left out; any value with finite derivatives works."""


def layer_derivatives(
    strength: Tensor, transmission: Tensor, reflection: Tensor, where: Tensor, *, linear: bool
) -> tuple[Tensor, Tensor]:
    """See `glassplat.kernels.panes.layer_derivatives`; computes left-out pixels, too, to avoid a synchronisation."""
    layers = (strength, transmission.mean(dim=-1), reflection.mean(dim=-1))
    share, *greys = (torch.where(where, layer.detach(), GREY) for layer in layers)
    with torch.enable_grad():
        behind, mirror_image = (grey.requires_grad_() for grey in greys)
        if linear:
            light = (1 - share) * linear_from_srgb(behind) + share * linear_from_srgb(mirror_image)
            image = srgb_from_linear(light)
        else:
            image = (1 - share) * behind + share * mirror_image
        through, mirrored = torch.autograd.grad(image.sum(), (behind, mirror_image))
    return torch.where(where, through, 1), torch.where(where, mirrored, 0)


def gradient_conflict(
    transmission: Tensor, reflection: Tensor, hit: Tensor, strength: Tensor | None = None, *, cell: int = 1
) -> Tensor:
    """See `glassplat.kernels.panes.gradient_conflict`: products of Sobel derivatives, summed in cells."""
    reflection, weight = reflection.detach(), hit[1:-1, 1:-1, None]
    of_transmission, of_reflection = sobel(transmission), sobel(reflection)
    products = weight * (of_transmission[0] * of_reflection[0] + of_transmission[1] * of_reflection[1])
    shared = cell_sums(products, cell)
    weight_of_cell = torch.ones_like(shared)
    if strength is not None:
        with torch.no_grad():
            light_t, light_r = (image[1:-1, 1:-1].clamp(DARKEST, 1) for image in (transmission, reflection))
            squares = of_reflection[0].square() + of_reflection[1].square()
            held = cell_sums(light_t * light_r * products, cell).abs()
            full = cell_sums(weight * strength[1:-1, 1:-1, None] * light_r.square() * squares, cell)
            weight_of_cell = torch.where(held > 0, (2 - held / (FULL_WEIGHT_RATIO * full)).clamp(0, 1), 1)
    return (weight_of_cell * shared.abs()).sum() / products.numel()


def cell_sums(values: Tensor, cell: int) -> Tensor:
    """Sums of values [H, W, C] over square cells of `cell` pixels a side; the last ones of an axis may be smaller."""
    sums = torch.nn.functional.avg_pool2d(values.permute(2, 0, 1), cell, ceil_mode=True, divisor_override=1)
    return sums.permute(1, 2, 0)


def sobel(image: Tensor) -> tuple[Tensor, Tensor]:
    """Horizontal and vertical Sobel derivatives [H-2, W-2, C] of an image [H, W, C], borders left out."""
    across = image[:, 2:] - image[:, :-2]
    down = image[2:] - image[:-2]
    horizontal = across[:-2] + 2 * across[1:-1] + across[2:]
    vertical = down[:, :-2] + 2 * down[:, 1:-1] + down[:, 2:]
    return horizontal, vertical
