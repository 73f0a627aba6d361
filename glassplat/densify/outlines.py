"""The ellipsoid that the outlines of a mirror describe: what a ball, a bowl or an egg of metal begins as.

A curved mirror looks like a window: what it mirrors seems to lie within it, and so do the Gaussians that have learnt to
look like it. Their depths say little about its surface. But its outline is its own in every view.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, normalize

from glassplat.data.view import View
from glassplat.kernels.composite import composite, mean_depth
from glassplat.kernels.maths.color import linear_from_srgb, srgb_from_linear
from glassplat.kernels.tiles import bin_tiles
from glassplat.render.frame import Renderer
from glassplat.render.rasterize import NEAR_PER_EXTENT, joined_splats, project_gaussians
from glassplat.render.surface import view_directions
from glassplat.render.traced import START_PER_EXTENT, traced_colors
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.pose import rotation_from_quat
from glassplat.scene.scene import Scene

LEAST_PIXELS = 30
"""Of a mirror, in a view that tells of its outline."""
STEPS, RATE = 300, 0.03
PIXELS = 4000
"""That are compared in each step, of all views together."""
SHARPNESS = 8.0
"""How fast a ray counts as passing the ellipsoid, by the square of its distance in radii."""
REFINE_STEPS, FIRST_STEP = 500, 0.03
GROWN, SHRUNK = 1.5, 0.9
"""By what a step's length changes where one helps and where it does not: it stays where one in five does."""
RAYS, RIM_WEIGHT = 3000, 0.1
"""Rays traced in each step of the refinement, and what outlines count there."""
GOLDEN_ANGLE_RAD = math.pi * (3 - math.sqrt(5))
FLAT = 0.1
"""Standard deviation along the normal, as a share of those along the surface."""
OVERLAP = 0.7
"""Standard deviation along the surface, as a share of the distance between neighbours."""


@dataclass(frozen=True)
class Outlines:
    """Rays of several views, and which of them end in a mirror.

    Attributes:
        origins: [P, 3] world units.
        directions: [P, 3] unit.
        inside: [P] 1 where the mirror is seen, 0 where what is behind it is.
    """

    origins: Tensor
    directions: Tensor
    inside: Tensor


@dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid in the world.

    Attributes:
        center: [3] world units.
        log_radii: [3] logarithm of the half axes.
        quat: [4] `wxyz`, its orientation.
    """

    center: Tensor
    log_radii: Tensor
    quat: Tensor

    def in_units(self, vectors: Tensor) -> Tensor:
        """[P, 3] world directions in its own frame, in which it is the unit sphere."""
        return (vectors @ rotation_from_quat(self.quat)) * torch.exp(-self.log_radii)

    def misses(self, outlines: Outlines) -> Tensor:
        """[P] squares of the least distances of rays from its centre, in radii: below 1 where they meet it."""
        start, along = self.in_units(outlines.origins - self.center), self.in_units(outlines.directions)
        nearest = (start * along).sum(1) / along.square().sum(1)
        return (start - nearest[:, None] * along).square().sum(1)

    def overlap(self, outlines: Outlines) -> float:
        """How well it fits: the pixels in which it and the mirror are seen, as a share of those that show either."""
        meets, inside = self.misses(outlines) < 1, outlines.inside > 0.5
        return float((meets & inside).sum() / (meets | inside).sum().clamp(min=1))


@torch.no_grad()
def outlines_of(scene: Scene, views: Sequence[View], chosen: Tensor) -> Outlines:
    """Where the views show the chosen [N] primary Gaussians, and where what is behind them.

    Pixels in which something nearer is seen say nothing and are left out.
    """
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    center = scene.primary.means[chosen].mean(dim=0)
    for view in views if bool(chosen.any()) else ():
        camera = view.camera.to(center.device)
        share, depth = _shares(scene, camera, chosen)
        inside = share > 0.5
        if int(inside.sum()) < LEAST_PIXELS:
            continue
        _, distance = camera.project(center[None])
        told = inside | (depth > distance)
        directions = normalize(view_directions(camera)[told], dim=1)
        parts.append((camera.center.expand_as(directions), directions, inside[told].to(directions)))
    if not parts:
        nothing = center.new_zeros(0, 3)
        return Outlines(nothing, nothing, nothing[:, 0])
    return Outlines(*(torch.cat(column) for column in zip(*parts, strict=True)))


def _shares(scene: Scene, camera: Camera, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """[H, W] which share of a pixel the chosen Gaussians make, and the mean depth."""
    projected = project_gaussians(scene.primary, camera, near=NEAR_PER_EXTENT * scene.extent)
    splats = joined_splats(projected)
    channels = torch.stack([chosen.to(projected.depths), projected.depths[0]], dim=-1)[None]
    result = composite(splats, channels, bin_tiles(splats, camera.width, camera.height))
    return result.image[0, ..., 0], mean_depth(result.image[0, ..., 1], result.alpha[0])


@torch.enable_grad()
def fitted_ellipsoid(outlines: Outlines, means: Tensor, generator: torch.Generator) -> Ellipsoid:
    """The ellipsoid whose outlines agree best with those of the views.

    Args:
        outlines: of a mirror.
        means: [M, 3] of its Gaussians, where to begin.
        generator: chooses the pixels of each step.
    """
    center = means.median(dim=0).values.clone()
    size = (means - center).abs().median().clamp(min=1e-6) * 2
    offset = torch.zeros_like(center).requires_grad_()
    log_radii = torch.zeros_like(center).requires_grad_()
    quat = means.new_tensor([1.0, 0.0, 0.0, 0.0]).requires_grad_()
    optimizer = torch.optim.Adam([offset, log_radii, quat], lr=RATE)
    for step in range(STEPS):
        optimizer.param_groups[0]["lr"] = RATE * (1 - step / STEPS) + 1e-4
        rows = torch.randint(len(outlines.inside), (PIXELS,), generator=generator, device=means.device)
        drawn = Outlines(outlines.origins[rows], outlines.directions[rows], outlines.inside[rows])
        ellipsoid = Ellipsoid(center + size * offset, log_radii + size.log(), quat)
        loss = binary_cross_entropy_with_logits(SHARPNESS * (1 - ellipsoid.misses(drawn)), drawn.inside)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return Ellipsoid(*(t.detach() for t in (ellipsoid.center, ellipsoid.log_radii, ellipsoid.quat)))


@dataclass(frozen=True)
class Mirrored:
    """Rays that meet a mirror, and what they show there.

    Attributes:
        origins: [P, 3] world units.
        directions: [P, 3] unit.
        colors: [P, 3] sRGB, without what panes before it reflect.
    """

    origins: Tensor
    directions: Tensor
    colors: Tensor


@torch.no_grad()
def mirrored_by(scene: Scene, views: Sequence[View], chosen: Tensor, renderer: Renderer) -> Mirrored:
    """What the views show of the chosen [N] Gaussians, through no pane that reflects more than half."""
    parts: list[tuple[Tensor, Tensor, Tensor]] = []
    for view in views:
        camera = view.camera.to(chosen.device)
        frame = renderer(scene, camera)
        share, _ = _shares(scene, camera, chosen)
        shown = (share > 0.5) & (frame.layers["share"] < 0.5)
        weight = frame.layers["share"][shown][:, None]
        photo = linear_from_srgb(view.photo.to(weight)[shown] / 255)
        # What all panes together add to the image that there would be without them.
        added = linear_from_srgb(frame.rgb[shown]) - (1 - weight) * linear_from_srgb(
            frame.layers["without_panes"][shown]
        )
        colors = srgb_from_linear(((photo - added) / (1 - weight)).clamp(0, 1))
        directions = normalize(view_directions(camera)[shown], dim=1)
        parts.append((camera.center.expand_as(directions), directions, colors))
    return Mirrored(*(torch.cat(column) for column in zip(*parts, strict=True)))


@torch.no_grad()
def refined_ellipsoid(
    start: Ellipsoid, outlines: Outlines, mirrored: Mirrored, scene: Scene, generator: torch.Generator
) -> Ellipsoid:
    """The ellipsoid near another one that mirrors what the views show, as well as having their outlines.

    Nine numbers, of which every pixel tells something: they are found where the normals of single Gaussians, each for
    itself, lose their way. A pattern that is mirrored sharply has slopes that lead nowhere, so that steps are drawn by
    chance and kept if they help, smaller ones where few do (a (1+1) evolution strategy).
    """
    rows = torch.randint(len(mirrored.colors), (RAYS,), generator=generator, device=start.center.device)
    drawn = torch.randint(len(outlines.inside), (PIXELS,), generator=generator, device=start.center.device)
    some = Outlines(outlines.origins[drawn], outlines.directions[drawn], outlines.inside[drawn])

    def error(ellipsoid: Ellipsoid) -> float:
        rim = 1 - ellipsoid.overlap(some)
        return float(reflection_error(ellipsoid, scene, mirrored, rows)) + RIM_WEIGHT * rim

    best, least, step = start, error(start), FIRST_STEP
    for _ in range(REFINE_STEPS):
        noise = step * torch.randn(10, generator=generator, device=start.center.device)
        offset, growth, turn = noise.to(start.center).split((3, 3, 4))
        size = float(torch.exp(best.log_radii.mean()))
        tried = Ellipsoid(best.center + size * offset, best.log_radii + growth, normalize(best.quat + turn, dim=0))
        found = error(tried)
        step *= GROWN if found < least else SHRUNK
        if found < least:
            best, least = tried, found
    return best


def reflection_error(ellipsoid: Ellipsoid, scene: Scene, mirrored: Mirrored, rows: Tensor) -> Tensor:
    """Mean absolute difference, sRGB, of what some rays [R] would show if the ellipsoid were silver."""
    origins, directions = mirrored.origins[rows], mirrored.directions[rows]
    start, along = ellipsoid.in_units(origins - ellipsoid.center), ellipsoid.in_units(directions)
    square, middle = along.square().sum(1), (start * along).sum(1)
    discriminant = middle.square() - square * (start.square().sum(1) - 1)
    hits = (discriminant > 0.01 * square).nonzero().squeeze(1)
    length = (-middle[hits] - discriminant[hits].sqrt()) / square[hits]
    places = origins[hits] + length[:, None] * directions[hits]
    unit = ellipsoid.in_units(places - ellipsoid.center)
    normals = normalize((unit * torch.exp(-ellipsoid.log_radii)) @ rotation_from_quat(ellipsoid.quat).T, dim=1)
    onwards = directions[hits] - 2 * (directions[hits] * normals).sum(1, keepdim=True) * normals
    near = START_PER_EXTENT * scene.extent
    colors = traced_colors(scene, places, normalize(onwards, dim=1), near, (0.0, 0.0, 0.0))
    return (colors - mirrored.colors[rows][hits]).abs().mean()


@torch.no_grad()
def on_surface(ellipsoid: Ellipsoid, count: int) -> tuple[Tensor, Tensor]:
    """Places [count, 3] evenly over an ellipsoid that is nearly round, and outward unit normals [count, 3] there."""
    number = torch.arange(count, dtype=ellipsoid.center.dtype, device=ellipsoid.center.device)
    height = 1 - (2 * number + 1) / count
    flat, turn = (1 - height**2).sqrt(), GOLDEN_ANGLE_RAD * number
    unit = torch.stack([flat * turn.cos(), flat * turn.sin(), height], dim=1)
    turned = rotation_from_quat(ellipsoid.quat).T
    radii = torch.exp(ellipsoid.log_radii)
    return ellipsoid.center + (unit * radii) @ turned, normalize((unit / radii) @ turned, dim=1)


@torch.no_grad()
def surface_gaussians(like: Gaussians, ellipsoid: Ellipsoid, count: int) -> Gaussians:
    """Flat Gaussians all over an ellipsoid, each otherwise like the nearest one of a set [M]."""
    places, normals = on_surface(ellipsoid, count)
    nearest = torch.cdist(places, like.means).argmin(dim=1)
    area = 4 * math.pi * float(torch.exp(2 * ellipsoid.log_radii.mean()))
    spread = OVERLAP * math.sqrt(area / count)
    log_scales = torch.log(spread * places.new_tensor([1.0, 1.0, FLAT])).expand(count, 3).clone()
    half_way = torch.cat(
        [1 + normals[:, 2:], -normals[:, 1:2], normals[:, :1], torch.zeros_like(normals[:, :1])], dim=1
    )
    # Upside down there is no shortest way; any does.
    half_way[half_way.norm(dim=1) < 1e-3] = places.new_tensor([0.0, 1.0, 0.0, 0.0])
    rows = like.select(nearest)
    return rows.with_tensors({"means": places, "quats": normalize(half_way, dim=1), "log_scales": log_scales})
