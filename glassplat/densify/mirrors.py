"""Finds what looks like a mirror and takes it for one, with normals from the depths of all views.

3DGS-DR and EnvGS begin with hardly any reflection, and let it spread from where it happens to explain something. What
mirrors its neighbourhood has become a picture of it by then. But a mirror betrays itself earlier, by looking different
from every side, and depths tell coarsely which way it faces: from there its normals find their way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from glassplat.data.normal_maps import estimated_normals
from glassplat.data.view import View
from glassplat.densify.options import MirrorSearch
from glassplat.densify.reflectors import LEAST_SHOWN, evenly, in_region, residual_spreads
from glassplat.render.contribution import gathered
from glassplat.render.depth_normals import cell_side, depth_normals
from glassplat.render.frame import Renderer
from glassplat.render.surface import seen_surface, view_directions
from glassplat.scene.activations import logit
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.pose import quat_product, rotation_from_quat
from glassplat.scene.scene import Scene
from glassplat.scene.transfer import moved

COLOR_NEIGHBOURS, NORMAL_NEIGHBOURS = 16, 4
"""Gaussians, itself among them, over which the spread of colours and the normals are averaged."""
FACING = 1e-3
"""Length of a sum of normals, in pixels, from which it tells a direction."""


@torch.no_grad()
def mirror_lookalikes(
    options: MirrorSearch, scene: Scene, views: Sequence[View], renderer: Renderer
) -> tuple[Tensor, Tensor]:
    """[N] bool each: which primary Gaussians the views show, and which of these look like mirrors.

    That is a Gaussian of the region whose pixels, but for one constant colour, differ from view to view. One by
    itself may lie where a pattern is not resolved yet; so its neighbours count as well.

    Args:
        options: what looks like one.
        scene: with an environment of which the region is known, or everywhere is.
        views: those that are trained on.
        renderer: draws the primary Gaussians.
    """
    plain = replace(scene, primary=replace(scene.primary, active_sh_degree=0))
    shown, spreads = residual_spreads(plain, evenly(views, options.views), renderer)
    seen = shown > LEAST_SHOWN
    rows = seen.nonzero().squeeze(1)
    variances = torch.zeros_like(spreads)
    near = neighbours(scene.primary.means[rows], COLOR_NEIGHBOURS)
    weights, values = shown[rows][near], spreads[rows].square()[near]
    variances[rows] = (weights * values).sum(1) / weights.sum(1)
    return seen, seen & (variances > options.spread**2) & in_region(scene)


@torch.no_grad()
def made_mirrors(options: MirrorSearch, scene: Scene, views: Sequence[View], chosen: Tensor) -> Gaussians:
    """The primary Gaussians, the chosen [N] ones as mirrors that face as the views say (`seen_normals`).

    Their colours stay, but for what turns with the view: what the reflection explains, it takes from them.
    """
    gaussians = scene.primary
    looked_at = evenly(views, options.views)
    normals = seen_normals(scene, looked_at, options.estimated_normals)
    turned = chosen & (normals.norm(dim=1) > FACING)
    rows = turned.nonzero().squeeze(1)
    near = neighbours(gaussians.means[rows], NORMAL_NEIGHBOURS)
    normals[rows] = normals[rows][near].sum(1)
    quats, log_scales = facing(gaussians, normalize(normals, dim=1), math.log(options.flatness))
    sh = gaussians.sh.clone()
    sh[chosen, 1:] = 0
    strengths, opacities = gaussians.channels["logit_strength"], gaussians.logit_opacities
    return gaussians.with_tensors(
        {
            "quats": torch.where(turned[:, None], quats, gaussians.quats),
            "log_scales": torch.where(turned[:, None], log_scales, gaussians.log_scales),
            "logit_strength": strengths.masked_fill(chosen, logit(options.strength)),
            "logit_opacities": torch.where(chosen, opacities.clamp(min=logit(options.least_opacity)), opacities),
            "sh": sh,
        }
    )


def neighbours(points: Tensor, count: int) -> Tensor:
    """[N, count] rows of the nearest of points [N, 3], each its own first neighbour; fewer where there are fewer."""
    if not len(points):
        return torch.zeros(0, 1, dtype=torch.int64, device=points.device)
    from scipy.spatial import cKDTree  # Takes long to import, and most commands never need it.

    places = points.detach().cpu().numpy()
    _, rows = cKDTree(places).query(places, k=range(1, min(count, len(places)) + 1), workers=-1)
    return torch.from_numpy(rows).to(points.device)


def seen_normals(scene: Scene, views: Sequence[View], estimated: bool = False) -> Tensor:
    """[N, 3] normals that the views show, summed over the pixels of each primary Gaussian, world axes.

    A surface that is seen at a grazing angle counts by the cosine.

    Args:
        scene: with primary Gaussians.
        views: those that are looked at.
        estimated: take normals that were estimated from a photograph where they lie beside it; all others are those of
            the depth maps.
    """
    normals = torch.zeros_like(scene.primary.means)
    for view in views:
        camera = view.camera.to(normals.device)
        known = estimated_normals(view) if estimated else None
        image = slopes_of_depths(scene, camera) if known is None else moved(known, normals.device)
        cosines = -(image * normalize(view_directions(camera), dim=-1)).sum(-1, keepdim=True)
        normals += gathered(scene, camera, image * cosines.clamp(min=0))
    return normals


def slopes_of_depths(scene: Scene, camera: Camera) -> Tensor:
    """[H, W, 3] normals of a camera's depth map, world axes; zero where they cannot be trusted."""
    surface = seen_surface(scene, camera, background=(0.0, 0.0, 0.0))
    cells, trusted = depth_normals(surface.depth, surface.alpha, camera)
    return _whole_size(cells * trusted[..., None], cell_side(camera), surface.depth.shape)


def _whole_size(cells: Tensor, side: int, size: Sequence[int]) -> Tensor:
    """[H, W, 3] unit vectors between those of cells [h, w, 3] of so many pixels, and zero where these are."""
    height, width = (side * count for count in cells.shape[:2])
    large = interpolate(cells.permute(2, 0, 1)[None], (height, width), mode="bilinear")[0].permute(1, 2, 0)
    image = cells.new_zeros(*size, 3)
    image[:height, :width] = normalize(large, dim=-1)
    return image


def facing(gaussians: Gaussians, normals: Tensor, log_flatness: float) -> tuple[Tensor, Tensor]:
    """Orientations [N, 4] and log scales of Gaussians whose normals are turned to others [N, 3], on the shortest way.

    Ellipsoids become flat; a disc is as flat as can be.
    """
    axes, log_scales = rotation_from_quat(gaussians.quats), gaussians.log_scales
    shortest = torch.full_like(log_scales[:, 0], 2).long() if gaussians.are_discs else log_scales.argmin(dim=1)
    now = axes.gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
    # A normal and its opposite are the same.
    wanted = torch.where((now * normals).sum(1, keepdim=True) < 0, -normals, normals)
    half_turn = torch.cat([1 + (now * wanted).sum(1, keepdim=True), torch.linalg.cross(now, wanted)], dim=1)
    quats = quat_product(normalize(half_turn, dim=1), normalize(gaussians.quats, dim=1))
    if gaussians.are_discs:
        return quats, log_scales
    least, middle = log_scales.sort(dim=1).values[:, :2].unbind(1)
    flat = torch.minimum(least, middle + log_flatness)
    return quats, log_scales.scatter(1, shortest[:, None], flat[:, None])
