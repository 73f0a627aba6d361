"""Laying panes before an image: one after the other, from the farthest on each ray to the nearest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.kernels.composite import composite
from glassplat.kernels.fresnel import Fresnel
from glassplat.kernels.maths.color import linear_from_srgb, srgb_from_linear
from glassplat.kernels.panes import blend_panes
from glassplat.kernels.records import TILE, BlendedPanes, Splats
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.choices import Blend
from glassplat.render.seen_panes import SeenPanes
from glassplat.scene.camera import Camera

FAINT = 0.5
"""A pane that is less visible in a pixel, as at its rim, leaves the layers to the pane behind it."""
GATE_PIXELS = 960 * 720
"""Size of photographs for which the strength of the gradient's gate is given; slopes per pixel are steeper in smaller
ones, by the power 0.4 of the number of pixels as L_c suggests, whose product of two slopes grows by 0.8."""


class Glazed(NamedTuple):
    """An image behind panes.

    rgb [H, W, 3]; transmission and reflection [H, W, 3] and strength [H, W] of the nearest pane that is not `FAINT`
    in a pixel, joined with those before it; and share [H, W], how much of what is seen all panes add.
    """

    rgb: Tensor
    transmission: Tensor
    reflection: Tensor
    strength: Tensor
    share: Tensor


def glazed(
    image: Tensor, seen: SeenPanes, masks: Sequence[Tensor], reflections: Tensor, camera: Camera,
    *, fresnel: Fresnel, intensity: bool, blend: Blend,
) -> Glazed:  # fmt: skip
    """Applies Eq. 1 of TR-Gaussians for each pane on a ray, C_t being what all panes behind it make of the image.

    Tinted glass, which the paper does not have, lets through a share of each primary of C_t.

    Args:
        image: [H, W, 3] without panes.
        seen: the K panes, and their order.
        masks: [H, W] for each of `seen.order`, visibility of that pane.
        reflections: [K, H, W, 4] what each pane mirrors, and its intensity minus 1.
        camera: of the view.
        fresnel: as for `blend_panes`.
        intensity: as for `blend_panes`.
        blend: the space in which light adds up.
    """
    normals = seen.planes.normals @ camera.cam_from_world[:3, :3].T
    laid = []
    transmittances = seen.planes.transmittances
    for mask, pane in zip(reversed(masks), reversed(seen.order), strict=True):
        if transmittances is not None:
            image = tinted(image, mask, pane, transmittances, blend)
        result = blend_panes(
            image,
            mask,
            reflections,
            pane,
            normals,
            seen.planes.base_reflectances,
            camera.intrinsics,
            fresnel=fresnel,
            intensity=intensity,
            linear=blend == "linear",
        )
        laid.append((image, result))
        image = result.rgb
    share = _all_of_them([result.strength for _, result in laid])
    behind, nearest = laid.pop()
    layers = (behind, nearest.reflection, nearest.strength)
    if not laid:
        return Glazed(image, *layers, share)
    faint = masks[0] < FAINT
    for mask, (behind, farther) in zip(masks[1:], reversed(laid), strict=True):
        layers = _joined_layers(layers, behind, farther, faint & (farther.strength > 0), blend)
        faint = faint & (mask < FAINT)
    return Glazed(image, *layers, share)


def gated_transmission(image: Tensor, seen: SeenPanes, reflections: Tensor, gate: float) -> Tensor:
    """The same image [H, W, 3], whose gradient is scaled down where the nearest pane mirrors edges.

    An edge of the photograph that the mirrored layer explains should not be learnt by what stands behind the pane
    (specular-aware gradient gating of RT-Splatting). The gradient is divided by 1 + gate * slope, the slope being that
    of the mirrored colour per pixel of a photograph of `GATE_PIXELS`.

    Args:
        image: C_t without panes.
        seen: the K panes, and their order.
        reflections: [K, H, W, 4] what each pane mirrors.
        gate: how strongly; 0 leaves the gradient as it is.
    """
    if gate == 0:
        return image
    with torch.no_grad():
        pane = seen.order[0]
        slopes = slopes_per_pixel(reflections[..., :3]).gather(0, pane.clamp(min=0).long()[None])[0]
        size = (pane.numel() / GATE_PIXELS) ** 0.4
        kept = torch.where(pane >= 0, 1 / (1 + gate * size * slopes), 1)[..., None]
    return image * kept + image.detach() * (1 - kept)


def slopes_per_pixel(images: Tensor) -> Tensor:
    """[K, H, W] absolute central differences of images [K, H, W, C], both directions added up; 0 on the border."""
    slopes = torch.zeros_like(images)
    slopes[:, :, 1:-1] += (images[:, :, 2:] - images[:, :, :-2]).abs() / 2
    slopes[:, 1:-1] += (images[:, 2:] - images[:, :-2]).abs() / 2
    return slopes.mean(dim=-1)


def tinted(image: Tensor, mask: Tensor, pane: Tensor, transmittances: Tensor, blend: Blend) -> Tensor:
    """[H, W, 3] what gets through panes of the transmittances [K, 3].

    Args:
        image: [H, W, 3] what is behind them.
        mask: [H, W] visibility of the pane in each pixel.
        pane: [H, W] which one it is, -1 where there is none.
        transmittances: of all panes.
        blend: the space in which light is let through.
    """
    decode, encode = curves(blend)
    # An embedding's gradient has the same bits for any number of threads, that of an index has not.
    through = torch.nn.functional.embedding(pane.clamp(min=0).long(), transmittances)
    shown = (mask > 0) & (pane >= 0)
    return torch.where(shown[..., None], encode(decode(image) * (1 - mask[..., None] * (1 - through))), image)


def _all_of_them(strengths: Sequence[Tensor]) -> Tensor:
    """[H, W] how much of what is seen panes of these strengths add, the farthest first."""
    share, *nearer = strengths
    for strength in nearer:
        share = strength + (1 - strength) * share
    return share


def _joined_layers(
    layers: tuple[Tensor, Tensor, Tensor], behind: Tensor, farther: BlendedPanes, where: Tensor, blend: Blend
) -> tuple[Tensor, Tensor, Tensor]:
    """Transmission, reflection and strength of a pane and the one behind it as if they were one, in some pixels.

    They make the same image: R = R_1 + (1 - R_1) R_2 and R C_r = R_1 C_1 + (1 - R_1) R_2 C_2.
    """
    decode, encode = curves(blend)
    transmission, reflection, strength = layers
    pixels = where.nonzero(as_tuple=True)
    first = strength[pixels]
    second = (1 - first) * farther.strength[pixels]
    both = first + second
    light = first[:, None] * decode(reflection[pixels]) + second[:, None] * decode(farther.reflection[pixels])
    return (
        transmission.index_put(pixels, behind[pixels]),
        reflection.index_put(pixels, encode(light / both[:, None])),
        strength.index_put(pixels, both),
    )


def curves(blend: Blend) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]:
    """Into the space in which light is blended, and back to sRGB."""
    return (linear_from_srgb, srgb_from_linear) if blend == "linear" else (_unchanged, _unchanged)


def _unchanged(color: Tensor) -> Tensor:
    return color


def visibilities(seen: SeenPanes, joint: Tensor, own: Tensor) -> list[Tensor]:
    """[H, W] for each of `seen.order`: how much of that pane is visible.

    Args:
        seen: panes seen through one another.
        joint: [H, W] mask of all panes together, which holds where a ray meets one pane.
        own: [K, H, W] mask of each, from `own_masks`.
    """
    nearest, *farther = (own.gather(0, pane.clamp(min=0).long()[None])[0] for pane in seen.order)
    return [torch.where(seen.order[1] >= 0, nearest, joint), *farther]


def own_masks(seen: SeenPanes, splats: Splats, marks: Tensor, owners: Tensor, size: tuple[int, int]) -> Tensor:
    """[K, H, W] mask of each pane as if it were the only one, in tiles where it is one of several.

    As M of TR-Gaussians, Eq. 7, but other panes, through which it is seen, do not hide it.

    Args:
        seen: panes seen through one another.
        splats: [1, G] primary ones, then glass.
        marks: [1, M] of the glass ones.
        owners: [M] the pane that each glass one is part of, position among the scene's planes.
        size: height and width of the image.
    """
    count, (height, width), several = len(seen.planes), size, seen.order[1] >= 0
    near, first_glass = _splats_near(splats, several), splats.radii.shape[1] - len(owners)
    glass = near[near >= first_glass] - first_glass
    num_primary = len(near) - len(glass)
    means2d, conics, opacities, depths, radii = (
        field[:, near].expand(count, len(near), *field.shape[2:]) for field in splats
    )
    foreign = owners[glass] != seen.rows[:, None]
    kept = torch.cat([foreign.new_zeros(count, num_primary), foreign], dim=1).logical_not()
    splats = Splats(means2d, conics, opacities, depths, radii * kept[..., None])
    active = torch.nn.functional.max_pool2d(several.to(torch.float32)[None], TILE, ceil_mode=True) > 0
    bins = bin_tiles(splats, width, height, seen.tiles & active)
    nothing = marks.new_zeros(count, len(near), 1)
    return composite(splats, nothing, bins, marks=marks[:, glass].expand(count, -1), num_primary=num_primary).mask


@torch.no_grad()
def _splats_near(splats: Splats, pixels: Tensor) -> Tensor:
    """Positions, in order, of the splats [1, G] that may reach the smallest window around the pixels [H, W] bool."""
    columns, rows = (pixels.any(dim=axis).nonzero().aminmax() for axis in (0, 1))
    # Whole tiles, all of which are traversed.
    low = torch.stack([columns.min, rows.min]) // TILE * TILE
    high = (torch.stack([columns.max, rows.max]) // TILE + 1) * TILE
    means, radii = splats.means2d[0], splats.radii[0]
    reaches = (means + radii >= low) & (means - radii <= high) & (radii > 0)
    return reaches.all(dim=1).nonzero().flatten()
