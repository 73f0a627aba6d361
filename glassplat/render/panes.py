"""Panes in a view: which it shows, what they mirror, and how they are laid before an image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.kernels import Fresnel
from glassplat.kernels import panes as pane_kernels
from glassplat.kernels.composite import composite
from glassplat.kernels.maths.images import linear_from_srgb, srgb_from_linear
from glassplat.kernels.panes import MirroredViews, blend_panes, pane_hits
from glassplat.kernels.project import GradientSum
from glassplat.kernels.records import TILE, PaneHits, Panes, Projected, Splats
from glassplat.kernels.tiles import bin_tiles
from glassplat.options import Blend
from glassplat.render.frame import project_gaussians
from glassplat.scene.camera import Camera, constant, mirror_matrices, waits
from glassplat.scene.corrections import world_from_photographer
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene


@dataclass(frozen=True)
class SeenPanes:
    """The panes that a view shows; only the nearest on each ray, or several that are seen through one another.

    Attributes:
        planes: the K panes that some tile shows.
        rows: [K] their positions among the scene's planes.
        order: L tensors [H, W] int32, L >= 1: the panes that each pixel's ray meets, nearest first, as positions in
            `planes`; -1 where there is none left.
        tiles: [K, rows, columns] bool, tiles in which a pixel shows the pane, in front or through others.
        windows: [K, 4] left, top, right and bottom edge, in pixels, of the pixels that show it.
        views: the camera mirrored about each of `planes`.
    """

    planes: Planes
    rows: Tensor
    order: tuple[Tensor, ...]
    tiles: Tensor
    windows: Tensor
    views: MirroredViews


def panes_in_camera(planes: Planes, camera: Camera) -> Panes:
    """The rectangles in the camera frame; no gradient."""
    pose = camera.cam_from_world
    if waits(pose.device):
        given = planes.centers, planes.raw_normals, planes.tangents, planes.half_sizes
        centers, raw_normals, tangents, half_sizes = (tensor.to(pose) for tensor in given)
        return pane_kernels.panes_in_camera(centers, raw_normals, tangents, half_sizes, pose)
    with torch.no_grad():
        rotation, translation = pose[:3, :3], pose[:3, 3]
        centers, normals, axes, half_sizes = (
            tensor.to(rotation)
            for tensor in (planes.centers, planes.normals, torch.stack(planes.axes(), 1), planes.half_sizes)
        )
        return Panes(centers @ rotation.T + translation, normals @ rotation.T, axes @ rotation.T, half_sizes)


def nearest_hits(panes: Panes, camera: Camera, mask: Tensor | None = None, beyond: PaneHits | None = None) -> PaneHits:
    """The nearest of `panes_in_camera` on the ray of each pixel, or the next one; see `pane_hits`."""
    return pane_hits(panes, camera.shared_intrinsics, camera.width, camera.height, mask, beyond=beyond)


def seen_panes(
    planes: Planes, camera: Camera, first: PaneHits, mask: Tensor | None = None, *, most: int | None = None
) -> SeenPanes | None:
    """The panes on the ray of each pixel, None where no tile shows any; the planes keep their gradient.

    Of a scene's panes A, B and C the view may show A and C, through A: then `planes` are A and C, `rows` [0, 2], and in
    a pixel that shows C through A `order` has 0 first and 1 next; where there is A alone it has 0 first and -1 next.

    Args:
        planes: the scene's.
        camera: of the view.
        first: `nearest_hits` of these.
        mask: [H, W] as given to `nearest_hits`.
        most: how many of them on one ray, the nearest ones; all if None.
    """
    hits, seen = [first], _visible_panes(first)
    if not any(seen):
        return None
    while len(hits) < (len(planes) if most is None else most):
        further = nearest_hits(panes_in_camera(planes, camera), camera, mask, beyond=hits[-1])
        shown = _visible_panes(further)
        if not any(shown):
            break
        hits.append(further)
        seen = [a or b for a, b in zip(seen, shown, strict=True)]
    tiles = torch.stack([h.tiles for h in hits]).any(dim=0)
    windows = first.windows if len(hits) == 1 else _joined_windows(hits)
    positions = tuple(k for k, is_seen in enumerate(seen) if is_seen)
    rows = constant(positions, torch.int64, tiles.device)
    if len(positions) == len(planes):
        return SeenPanes(planes, rows, tuple(h.pane for h in hits), tiles, windows, mirrored_views(planes, camera))
    # The last entry is for index -1, pixels without a pane.
    found = (*(positions.index(k) if is_seen else -1 for k, is_seen in enumerate(seen)), -1)
    position = constant(found, torch.int32, tiles.device)
    order = tuple(position[h.pane.long()] for h in hits)
    planes = planes.select(positions)
    return SeenPanes(planes, rows, order, tiles[rows], windows[rows], mirrored_views(planes, camera))


def _visible_panes(hits: PaneHits) -> list[bool]:
    """Panes that some tile shows. The one thing that the program asks of a GPU here, and waits for."""
    found: list[bool] = hits.tiles.flatten(1).any(dim=1).tolist()
    return found


def _joined_windows(hits: list[PaneHits]) -> Tensor:
    """[K, 4] the smallest windows around those of all hits; an empty window is all 0."""
    windows = torch.stack([h.windows for h in hits])
    empty = (windows[..., 2] == 0)[..., None]
    first = torch.where(empty, torch.inf, windows[..., :2]).amin(dim=0)
    joined = torch.cat([first, windows[..., 2:].amax(dim=0)], dim=1)
    return torch.where(empty.all(dim=0), 0, joined)


def project_mirrored(
    gaussians: Gaussians, camera: Camera, seen: SeenPanes, *, near: float, total: GradientSum | None = None
) -> Projected:
    """Projects the Gaussians of the camera's side into the camera mirrored about each plane (Eqs. 8-12).

    Args:
        gaussians: the set to project.
        camera: whose mirror images are wanted.
        seen: the planes that it sees, and where; what lies outside of a plane's window is culled.
        near: depth below which a Gaussian is culled, world units.
        total: as for `project_gaussians`.
    """
    return project_gaussians(
        gaussians,
        camera,
        near=near,
        poses=seen.views.poses,
        clip_planes=seen.views.half_spaces,
        windows=seen.windows,
        total=total,
    )


def project_photographer(scene: Scene, camera: Camera, seen: SeenPanes, *, near: float) -> Projected:
    """Projects the photographer's mirror images: what `project_mirrored` does, of Gaussians that the camera carries.

    Mirrored about plane k, the camera sees them at `cam_from_world @ M_k @ world_from_photographer`; all else, also
    the depths by which they are sorted into the room, follows from that pose.

    Args:
        scene: with a photographer.
        camera: that the photographer holds.
        seen: the planes that it sees, and where.
        near: depth below which a Gaussian is culled, world units.
    """
    frame = world_from_photographer(camera, scene.up)
    return project_gaussians(
        scene.photographer,
        camera,
        near=near,
        poses=seen.views.poses @ frame,
        # A plane n . x + d = 0 is (n, d) as a row vector, so that frames change it from the right.
        clip_planes=seen.views.half_spaces @ frame.detach(),
        windows=seen.windows,
    )


def mirrored_views(planes: Planes, camera: Camera) -> MirroredViews:
    """The camera mirrored about each plane, and the clip planes that keep the side on which it stands.

    The half spaces have no gradient. On a GPU that is one kernel, as some sixty operations on few numbers would take
    longer than all Gaussians.
    """
    pose = camera.cam_from_world
    if waits(planes.centers.device):
        return pane_kernels.mirrored_views(planes.centers, planes.raw_normals, pose)
    normals = planes.normals
    poses = pose @ mirror_matrices(planes.centers, normals)
    with torch.no_grad():
        side = torch.sign(((camera.center - planes.centers) * normals).sum(-1, keepdim=True))
        facing = normals * side
        half_spaces = torch.cat([facing, -(facing * planes.centers).sum(-1, keepdim=True)], dim=1)
    return MirroredViews(poses, planes.normals @ pose[:3, :3].T, half_spaces)


FAINT = 0.5
"""A pane that is less visible in a pixel, as at its rim, leaves the layers to the pane behind it."""


class CompositedPanes(NamedTuple):
    """An image behind panes.

    rgb [H, W, 3]; transmission and reflection [H, W, 3] and strength [H, W] of the nearest pane that is not `FAINT`
    in a pixel, joined with those before it; and share [H, W], how much of what is seen all panes add.
    """

    rgb: Tensor
    transmission: Tensor
    reflection: Tensor
    strength: Tensor
    share: Tensor


def composite_panes(
    image: Tensor, seen: SeenPanes, masks: Sequence[Tensor], reflections: Tensor, camera: Camera,
    *, fresnel: Fresnel, intensity: bool, blend: Blend,
) -> CompositedPanes:  # fmt: skip
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
    laid = []
    transmittances = seen.planes.transmittances
    for mask, pane in zip(reversed(masks), reversed(seen.order), strict=True):
        if transmittances is not None:
            image = tint_by_panes(image, mask, pane, transmittances, blend)
        result = blend_panes(
            image,
            mask,
            reflections,
            pane,
            seen.views.normals,
            seen.planes.base_reflectances,
            camera.shared_intrinsics,
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
        return CompositedPanes(image, *layers, share)
    faint = masks[0] < FAINT
    for number, (behind, farther) in enumerate(reversed(laid), 1):
        reflection = farther.reflection
        for mask, pane in zip(masks[:number], seen.order, strict=False):
            if transmittances is not None:
                behind = tint_by_panes(behind, mask, pane, transmittances, blend)
                reflection = tint_by_panes(reflection, mask, pane, transmittances, blend)
        where = faint & (farther.strength > 0)
        layers = _joined_layers(layers, (behind, reflection, farther.strength), where, blend)
        faint = faint & (masks[number] < FAINT)
    return CompositedPanes(image, *layers, share)


def tint_by_panes(image: Tensor, mask: Tensor, pane: Tensor, transmittances: Tensor, blend: Blend) -> Tensor:
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


@torch.no_grad()
def tint_of_panes(seen: SeenPanes, masks: Sequence[Tensor], transmittances: Tensor) -> Tensor:
    """[H, W, 3] share of the light that gets through the glass of all panes on a ray, where light adds up."""
    tint = torch.ones_like(masks[0][..., None]).expand(-1, -1, 3)
    for mask, pane in zip(masks, seen.order, strict=True):
        tint = tint_by_panes(tint, mask, pane, transmittances, "srgb")  # As it is: shares have no curve.
    return tint


def _all_of_them(strengths: Sequence[Tensor]) -> Tensor:
    """[H, W] how much of what is seen panes of these strengths add, the farthest first."""
    share, *nearer = strengths
    for strength in nearer:
        share = strength + (1 - strength) * share
    return share


Layers = tuple[Tensor, Tensor, Tensor]
"""Transmission, reflection and strength."""


def _joined_layers(layers: Layers, farther: Layers, where: Tensor, blend: Blend) -> Layers:
    """Those of a pane and of one seen through its glass as if they were one, in some pixels.

    They make the same image: R = R_1 + (1 - R_1) R_2 and R C_r = R_1 C_1 + (1 - R_1) R_2 C_2.
    """
    decode, encode = curves(blend)
    (transmission, reflection, strength), (behind, mirrored, share) = layers, farther
    pixels = where.nonzero(as_tuple=True)
    first = strength[pixels]
    second = (1 - first) * share[pixels]
    both = first + second
    light = first[:, None] * decode(reflection[pixels]) + second[:, None] * decode(mirrored[pixels])
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
