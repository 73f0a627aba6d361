"""Panes in a view: visibility, mirrored images, and compositing over an image."""

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
from glassplat.scene.camera import Camera, constant, mirror_matrices, synchronises
from glassplat.scene.corrections import world_from_photographer
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene


@dataclass(frozen=True)
class SeenPanes:
    """The panes visible in a view: the nearest on each ray, or several behind each other.

    Attributes:
        planes: the K visible panes.
        rows: [K] their positions among the scene's planes.
        order: L tensors [H, W] int32, L >= 1: the panes on each pixel's ray, nearest first, as positions in `planes`;
            -1 for none.
        tiles: [K, rows, columns] bool, tiles with pixels of the pane, in front or through others.
        windows: [K, 4] left, top, right and bottom edge, in pixels, of its bounding box.
        views: the camera mirrored about each of `planes`.
    """

    planes: Planes
    rows: Tensor
    order: tuple[Tensor, ...]
    tiles: Tensor
    windows: Tensor
    views: MirroredViews


def panes_in_camera(planes: Planes, camera: Camera) -> Panes:
    """The rectangles in the camera frame, without gradients."""
    pose = camera.cam_from_world
    if synchronises(pose.device):
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
        planes: planes of the scene.
        camera: camera of the view.
        first: result of `nearest_hits` for these.
        mask: [H, W] as given to `nearest_hits`.
        most: maximum number per ray, nearest first; all if None.
    """
    hits, seen = [first], _are_visible(first)
    if not any(seen):
        return None
    while len(hits) < (len(planes) if most is None else most):
        further = nearest_hits(panes_in_camera(planes, camera), camera, mask, beyond=hits[-1])
        shown = _are_visible(further)
        if not any(shown):
            break
        hits.append(further)
        seen = [a or b for a, b in zip(seen, shown, strict=True)]
    tiles = torch.stack([h.tiles for h in hits]).any(dim=0)
    windows = first.windows if len(hits) == 1 else _union_windows(hits)
    positions = tuple(k for k, is_seen in enumerate(seen) if is_seen)
    rows = constant(positions, torch.int64, tiles.device)
    if len(positions) == len(planes):
        return SeenPanes(planes, rows, tuple(h.pane for h in hits), tiles, windows, mirrored_views(planes, camera))
    # The last entry is for index -1: pixels without a pane.
    found = (*(positions.index(k) if is_seen else -1 for k, is_seen in enumerate(seen)), -1)
    position = constant(found, torch.int32, tiles.device)
    order = tuple(position[h.pane.long()] for h in hits)
    planes = planes.select(positions)
    return SeenPanes(planes, rows, order, tiles[rows], windows[rows], mirrored_views(planes, camera))


def _are_visible(hits: PaneHits) -> list[bool]:
    """Visibility of each pane. Reading it is the only synchronisation with a GPU here."""
    found: list[bool] = hits.tiles.flatten(1).any(dim=1).tolist()
    return found


def _union_windows(hits: list[PaneHits]) -> Tensor:
    """[K, 4] bounding boxes of the windows of all hits; zeros if empty."""
    windows = torch.stack([h.windows for h in hits])
    empty = (windows[..., 2] == 0)[..., None]
    first = torch.where(empty, torch.inf, windows[..., :2]).amin(dim=0)
    union = torch.cat([first, windows[..., 2:].amax(dim=0)], dim=1)
    return torch.where(empty.all(dim=0), 0, union)


def project_mirrored(
    gaussians: Gaussians, camera: Camera, seen: SeenPanes, *, near: float, gradient_sum: GradientSum | None = None
) -> Projected:
    """Projects the Gaussians of the camera's side into the camera mirrored about each plane (Eqs. 8-12).

    Args:
        gaussians: the set to project.
        camera: the camera to mirror.
        seen: visible planes; Gaussians outside a plane's window are culled.
        near: depth below which a Gaussian is culled, world units.
        gradient_sum: see `project_gaussians`.
    """
    return project_gaussians(
        gaussians,
        camera,
        near=near,
        poses=seen.views.poses,
        clip_planes=seen.views.half_spaces,
        windows=seen.windows,
        gradient_sum=gradient_sum,
    )


def project_photographer(scene: Scene, camera: Camera, seen: SeenPanes, *, near: float) -> Projected:
    """Projects the photographer's mirror images, like `project_mirrored`, for Gaussians in the photographer's frame.

    Mirrored about plane k, the camera has the pose `cam_from_world @ M_k @ world_from_photographer`, which also
    defines the depths for sorting.

    Args:
        scene: scene with a photographer.
        camera: the photographer's camera.
        seen: visible planes.
        near: depth below which a Gaussian is culled, world units.
    """
    frame = world_from_photographer(camera, scene.up)
    return project_gaussians(
        scene.photographer,
        camera,
        near=near,
        poses=seen.views.poses @ frame,
        # A plane n . x + d = 0 is the row vector (n, d), which transforms from the right.
        clip_planes=seen.views.half_spaces @ frame.detach(),
        windows=seen.windows,
    )


def mirrored_views(planes: Planes, camera: Camera) -> MirroredViews:
    """The camera mirrored about each plane, and the clip planes that keep the camera's side.

    The clip planes have no gradient. On a GPU this is one kernel, because sixty operations on few numbers would take
    longer than all Gaussians.
    """
    pose = camera.cam_from_world
    if synchronises(planes.centers.device):
        return pane_kernels.mirrored_views(planes.centers, planes.raw_normals, pose)
    normals = planes.normals
    poses = pose @ mirror_matrices(planes.centers, normals)
    with torch.no_grad():
        side = torch.sign(((camera.center - planes.centers) * normals).sum(-1, keepdim=True))
        facing = normals * side
        half_spaces = torch.cat([facing, -(facing * planes.centers).sum(-1, keepdim=True)], dim=1)
    return MirroredViews(poses, planes.normals @ pose[:3, :3].T, half_spaces)


LEAST_VISIBILITY = 0.5
"""Visibility in a pixel below which the layers are those of the pane behind, as at a pane's border."""


class CompositedPanes(NamedTuple):
    """An image behind panes.

    rgb [H, W, 3]; transmission and reflection [H, W, 3] and strength [H, W] of the nearest pane above
    `LEAST_VISIBILITY`, combined with those in front; and share [H, W] of the image added by all panes.
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
    """Applies Eq. 1 of TR-Gaussians for each pane on a ray; C_t is the image with all panes behind it.

    Tinted glass, which the paper does not have, scales the channels of C_t. Differentiable in all images, and in
    normals, reflectances and transmittances of the panes.

    Args:
        image: [H, W, 3] image without panes.
        seen: the K visible panes.
        masks: visibility [H, W] for each of `seen.order`.
        reflections: [K, H, W, 4] mirrored image of each pane, and its intensity minus 1.
        camera: camera of the view.
        fresnel: as for `blend_panes`.
        intensity: as for `blend_panes`.
        blend: space of blending.
    """
    composited = []
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
        composited.append((image, result))
        image = result.rgb
    share = _total_share([result.strength for _, result in composited])
    behind, nearest = composited.pop()
    layers = (behind, nearest.reflection, nearest.strength)
    if not composited:
        return CompositedPanes(image, *layers, share)
    faint = masks[0] < LEAST_VISIBILITY
    for number, (behind, farther) in enumerate(reversed(composited), 1):
        reflection = farther.reflection
        for mask, pane in zip(masks[:number], seen.order, strict=False):
            if transmittances is not None:
                behind = tint_by_panes(behind, mask, pane, transmittances, blend)
                reflection = tint_by_panes(reflection, mask, pane, transmittances, blend)
        where = faint & (farther.strength > 0)
        layers = _merge_layers(layers, (behind, reflection, farther.strength), where, blend)
        faint = faint & (masks[number] < LEAST_VISIBILITY)
    return CompositedPanes(image, *layers, share)


def tint_by_panes(image: Tensor, mask: Tensor, pane: Tensor, transmittances: Tensor, blend: Blend) -> Tensor:
    """[H, W, 3] light transmitted by panes of the transmittances [K, 3].

    Args:
        image: [H, W, 3] image behind the panes.
        mask: [H, W] visibility of the pane in each pixel.
        pane: [H, W] index of the pane, -1 for none.
        transmittances: transmittances of all panes.
        blend: space in which transmittances apply.
    """
    decode, encode = blend_conversions(blend)
    # The gradient of an embedding is deterministic for any number of threads, unlike that of indexing.
    through = torch.nn.functional.embedding(pane.clamp(min=0).long(), transmittances)
    shown = (mask > 0) & (pane >= 0)
    return torch.where(shown[..., None], encode(decode(image) * (1 - mask[..., None] * (1 - through))), image)


@torch.no_grad()
def tint_of_panes(seen: SeenPanes, masks: Sequence[Tensor], transmittances: Tensor) -> Tensor:
    """[H, W, 3] transmittance of all panes on a ray, in the space of blending."""
    tint = torch.ones_like(masks[0][..., None]).expand(-1, -1, 3)
    for mask, pane in zip(masks, seen.order, strict=True):
        tint = tint_by_panes(tint, mask, pane, transmittances, "srgb")  # Unchanged: shares have no transfer curve.
    return tint


def _total_share(strengths: Sequence[Tensor]) -> Tensor:
    """[H, W] share of the image added by panes of these strengths, farthest first."""
    share, *nearer = strengths
    for strength in nearer:
        share = strength + (1 - strength) * share
    return share


Layers = tuple[Tensor, Tensor, Tensor]
"""Transmission, reflection and strength."""


def _merge_layers(layers: Layers, farther: Layers, where: Tensor, blend: Blend) -> Layers:
    """Those of a pane and of one seen through its glass as if they were one, in some pixels.

    They give the same image: R = R_1 + (1 - R_1) R_2 and R C_r = R_1 C_1 + (1 - R_1) R_2 C_2.
    """
    decode, encode = blend_conversions(blend)
    (transmission, reflection, strength), (behind, mirrored, share) = layers, farther
    pixels = where.nonzero(as_tuple=True)
    first = strength[pixels]
    second = (1 - first) * share[pixels]
    total = first + second
    light = first[:, None] * decode(reflection[pixels]) + second[:, None] * decode(mirrored[pixels])
    return (
        transmission.index_put(pixels, behind[pixels]),
        reflection.index_put(pixels, encode(light / total[:, None])),
        strength.index_put(pixels, total),
    )


def blend_conversions(blend: Blend) -> tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]]:
    """Conversions to the space of blending and back to sRGB."""
    return (linear_from_srgb, srgb_from_linear) if blend == "linear" else (torch.positive, torch.positive)


def visibilities(seen: SeenPanes, joint: Tensor, own: Tensor) -> list[Tensor]:
    """Visibility [H, W] for each of `seen.order`.

    Args:
        seen: panes behind each other.
        joint: [H, W] mask of all panes together, valid where a ray meets one pane.
        own: [K, H, W] mask of each, from `own_masks`.
    """
    nearest, *farther = (own.gather(0, pane.clamp(min=0).long()[None])[0] for pane in seen.order)
    return [torch.where(seen.order[1] >= 0, nearest, joint), *farther]


def own_masks(seen: SeenPanes, splats: Splats, marks: Tensor, owners: Tensor, size: tuple[int, int]) -> Tensor:
    """[K, H, W] mask of each pane as if it were the only one, in tiles with several.

    As M of TR-Gaussians, Eq. 7, but not occluded by other panes. Differentiable in splats and marks.

    Args:
        seen: panes behind each other.
        splats: [1, G] primary splats, then glass.
        marks: [1, M] marks of the glass.
        owners: [M] pane of each glass Gaussian, as position among the scene's planes.
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
    """Positions, in order, of the splats [1, G] that may reach the bounding box of the pixels [H, W] bool."""
    columns, rows = (pixels.any(dim=axis).nonzero().aminmax() for axis in (0, 1))
    # Extended to whole tiles.
    low = torch.stack([columns.min, rows.min]) // TILE * TILE
    high = (torch.stack([columns.max, rows.max]) // TILE + 1) * TILE
    means, radii = splats.means2d[0], splats.radii[0]
    overlaps = (means + radii >= low) & (means - radii <= high) & (radii > 0)
    return overlaps.all(dim=1).nonzero().flatten()
