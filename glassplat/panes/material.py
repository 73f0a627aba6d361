"""The first glass Gaussians, mirrors told from glass, and the virtual scene behind a mirror."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from glassplat.captures.view import View
from glassplat.render.planar import Planar
from glassplat.scene.activations import logit
from glassplat.scene.camera import Camera
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes, crosses_pane, in_image
from glassplat.scene.scene import Scene

OVERLAP = 0.7
"""Standard deviation of a disc, in distances between neighbours; the discs blend into an even sheet."""
THICKNESS = 0.05
"""Standard deviation across the pane, as a share of that along it."""
OPAQUE_SHEET = 0.9
"""Opacity of discs that cover a pane which nobody trains."""


def glass_gaussians(
    planes: Planes, *, count: int = 1000, seed: int = 0, opacity: float = 0.5, mark: float = 0.99
) -> Gaussians:
    """Glass Gaussians on every pane's rectangle.

    They are spread by a scrambled Sobol sequence, so that chance leaves no holes. At the default
    opacity the sheet shows a mask of about 0.8 from the first step on, and training thins it out where
    the rectangle is larger than the pane.

    Args:
        planes: the panes.
        count: Gaussians on each pane.
        seed: of the places.
        opacity: of each Gaussian, in (0, 1).
        mark: m of each Gaussian, in (0, 1); the paper's 1 has no finite logit.
    """
    panes = [_pane_discs(planes, index, count=count, seed=seed) for index in range(len(planes))]
    if not panes:
        return Gaussians.empty(channels=("logit_mark",))
    means, quats, log_scales = (torch.cat(tensors) for tensors in zip(*panes, strict=True))
    number = len(means)
    return Gaussians(
        means=means,
        quats=quats,
        log_scales=log_scales,
        logit_opacities=torch.full((number,), logit(opacity)),
        sh=torch.zeros(number, 0, 3),
        channels={"logit_mark": torch.full((number,), logit(mark))},
    ).to(planes.centers.device)


def with_pane(scene: Scene, pane: Planes) -> Scene:
    """The scene with one more pane, its rectangle evenly covered with glass.

    Args:
        scene: any; Gaussians that do not say how bright they are in a pane are as bright as they are.
        pane: a single plane.

    Raises:
        ValueError: the scene has a pane of that label.
    """
    if set(pane.labels) & set(scene.planes.labels):
        raise ValueError(f"the scene has a pane {pane.labels[0]} already; its panes are {list(scene.planes.labels)}")
    pane = pane.to(scene.primary.means.device)
    glass = glass_gaussians(pane, opacity=OPAQUE_SHEET)
    return replace(
        scene,
        primary=with_intensity(scene.primary),
        planes=scene.planes.joined(pane) if len(scene.planes) else pane,
        glass=scene.glass.joined(glass) if len(scene.glass) else glass,
    )


def with_intensity(gaussians: Gaussians) -> Gaussians:
    """The Gaussians with an intensity of 1 in what panes mirror, unless they have one."""
    if "log_intensity" in gaussians.channels:
        return gaussians
    return replace(gaussians, channels={**gaussians.channels, "log_intensity": torch.zeros_like(gaussians.means[:, 0])})


def _pane_discs(planes: Planes, index: int, *, count: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Means [M, 3], quats [M, 4] and log scales [M, 3] of the discs on one pane."""
    half = planes.half_sizes[index].detach().cpu()
    places = SobolEngine(dimension=2, scramble=True, seed=seed + index).draw(count)
    tangent, bitangent = (axis[index].detach().cpu() for axis in planes.axes())
    in_plane = (2 * places - 1) * half
    means = planes.centers[index].detach().cpu() + in_plane @ torch.stack([tangent, bitangent])

    frame = torch.stack([tangent, bitangent, planes.normals[index].detach().cpu()], dim=1)
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(frame.double().numpy()).as_quat()
    quat = torch.tensor([w, x, y, z], dtype=torch.float32)
    along = OVERLAP * math.sqrt(float(4 * half.prod()) / count)
    log_scales = torch.tensor([along, along, THICKNESS * along]).log()
    return means, quat.repeat(len(means), 1), log_scales.repeat(len(means), 1)


log = logging.getLogger("glassplat.panes")

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
MIRROR_SLOPE, MIRROR_CORRELATION = 0.5, 0.25
"""Above these values a pane is taken for a mirror; glass shows slopes near its reflectance, a tenth."""
LEAST_COVERAGE = 0.95
"""Coverage of the mirrored image from which a pixel counts; a rough first scene has holes, which are no dark things."""
WINDOW = 0.15
"""Side of the window whose mean is taken off, as a share of the image width: it removes differences in brightness."""
FEWEST_PIXELS, LEAST_SHARE = 200, 0.03
"""Of a pane's annotated pixels, how many must be covered by what it would mirror for it to be judged: by a hundredth
of a glass front, chosen by what is known of its surroundings, it may well look like a mirror."""


class Likeness(NamedTuple):
    """How the photographs of a pane depend on what the plane would mirror there.

    slope: change of the photograph per change of the mirrored image; 1 for a mirror, R0 for glass.
    correlation: of the two, over pixels and channels.
    """

    slope: float
    correlation: float

    @property
    def is_mirror(self) -> bool:
        """Whether the photograph shows the mirrored scene itself."""
        return self.slope > MIRROR_SLOPE and self.correlation > MIRROR_CORRELATION


def mirror_labels(scene: Scene, views: Sequence[View]) -> tuple[int, ...]:
    """Labels of the panes that are mirrors, judged on the annotated views.

    Nothing is transmitted by a mirror, so its photograph is the mirrored scene; through glass it is mostly what
    stands behind, which has nothing to do with the mirrored scene. A rough first scene is enough to tell.

    Args:
        scene: primary Gaussians after the first stage, with fitted planes and glass.
        views: training views; those without pane labels are passed over.
    """
    return mirrors_among(scene.planes.labels, [pane_pixels(scene, view) for view in views if view.is_annotated])


def mirrors_among(labels: Sequence[int], views: Sequence[Mapping[int, PanePixels]]) -> tuple[int, ...]:
    """Labels of the panes that are mirrors, by the `pane_pixels` of the annotated views."""
    found = []
    for label in labels:
        mirrored = torch.cat([view[label].mirrored for view in views])
        like = likeness(mirrored, torch.cat([view[label].photographed for view in views]))
        share = len(mirrored) / max(sum(view[label].shown for view in views), 1)
        log.info("pane %d: slope %.2f, correlation %.2f, of %.1f %% of it", label, *like, 100 * share)
        if len(mirrored) >= FEWEST_PIXELS and share >= LEAST_SHARE and like.is_mirror:
            found.append(label)
    return tuple(found)


class PanePixels(NamedTuple):
    """What is known of a pane in one view.

    mirrored, photographed [P, 3]: colours about their local means, where what would be mirrored is known; shown: how
    many pixels show the pane.
    """

    mirrored: Tensor
    photographed: Tensor
    shown: int


@torch.no_grad()
def pane_pixels(scene: Scene, view: View) -> Mapping[int, PanePixels]:
    """The pixels of each pane in one view, by label."""
    mirrored, coverage, seen = mirrored_image(scene, view.camera)
    photo = scene.exposures.undone(view.photo.to(mirrored.device).to(mirrored.dtype) / 255, view.name)
    labels = None if view.pane_labels is None else view.pane_labels.to(mirrored.device)
    told = torch.ones_like(seen) if view.ignored is None else ~view.ignored.to(seen.device)
    pixels = {}
    for label in scene.planes.labels:
        pane = told & (seen if labels is None else labels == label)
        region = pane & (coverage > LEAST_COVERAGE)
        pixels[label] = PanePixels(
            mirrored=about_local_mean(mirrored, region)[region],
            photographed=about_local_mean(photo, region)[region],
            shown=int(pane.sum()),
        )
    return pixels


class MirroredImage(NamedTuple):
    """What the panes would mirror at full strength.

    color [H, W, 3]; coverage [H, W], how much of it is covered by Gaussians; seen [H, W] bool, where there is a pane.
    """

    color: Tensor
    coverage: Tensor
    seen: Tensor


def mirrored_image(scene: Scene, camera: Camera) -> MirroredImage:
    """Renders before black and before white, whose difference is what is not covered."""
    before_black, before_white = (
        Planar(background=color, intensity=False)(scene, camera).layers["reflection"] for color in (BLACK, WHITE)
    )
    seen = before_white.amax(dim=-1) > 0
    return MirroredImage(before_black, torch.where(seen, 1 - (before_white - before_black).mean(dim=-1), 0), seen)


@torch.no_grad()
def mirrored_coverage(scene: Scene, pane: Planes, camera: Camera) -> tuple[float, int]:
    """How much of what a pane could mirror in a view is covered by Gaussians, and how much it is; pixels."""
    mirrored = mirrored_image(replace(scene, planes=pane), camera)
    return float(mirrored.coverage.sum()), int(mirrored.seen.sum())


def about_local_mean(image: Tensor, region: Tensor) -> Tensor:
    """An image [H, W, 3] minus its mean over the part of a square window that lies in the region [H, W]."""
    reach = max(round(WINDOW * image.shape[1] / 2), 1)
    inside = region.to(image.dtype)[..., None]
    sums = window_sums(torch.cat([image * inside, inside], dim=-1), reach)
    return image - (sums[..., :3] / sums[..., 3:].clamp(min=1)).to(image.dtype)


def window_sums(image: Tensor, reach: int) -> Tensor:
    """[H, W, D] float64 sums over the square of pixels up to `reach` away, cut off at the image's border.

    Differences of running sums, one axis after the other: as much work for a window of any size.
    """
    sums = image.double()
    for axis in (0, 1):
        running = torch.cat([torch.zeros_like(sums.narrow(axis, 0, 1)), sums.cumsum(axis)], dim=axis)
        places = torch.arange(image.shape[axis], device=image.device)
        after, before = (places + reach + 1).clamp(max=len(places)), (places - reach).clamp(min=0)
        sums = running.index_select(axis, after) - running.index_select(axis, before)
    return sums


def likeness(mirrored: Tensor, photographed: Tensor) -> Likeness:
    """Regression of photographed on mirrored values [P, 3], both about their means."""
    covariance = (mirrored * photographed).sum()
    spread, target_spread = (mirrored * mirrored).sum(), (photographed * photographed).sum()
    tiny = torch.finfo(mirrored.dtype).tiny
    correlation = covariance / torch.sqrt((spread * target_spread).clamp(min=tiny))
    return Likeness(float(covariance / spread.clamp(min=tiny)), float(correlation))


MOST_SEEN_DIRECTLY = 0.5
"""A Gaussian is virtual when fewer than this share of the views that hold it see it past the mirrors."""


@torch.no_grad()
def virtual_points(points: Tensor, mirrors: Planes, cameras: Sequence[Camera]) -> Tensor:
    """[N] bool: which points are the mirror image of something, because most views see them through a mirror.

    Nothing real is seen through a mirror, so these can go as soon as the mirror reflects. Left in place they would keep
    explaining what it shows, and its reflectance would sink to let them.

    Args:
        points: [N, 3] world positions.
        mirrors: planes that transmit nothing.
        cameras: the training views.
    """
    if len(mirrors) == 0:
        return torch.zeros(points.shape[0], dtype=torch.bool, device=points.device)
    held, through = (torch.zeros(points.shape[0], device=points.device) for _ in range(2))
    for camera in (camera.to(points.device) for camera in cameras):
        inside = in_image(points, camera)
        held += inside
        through += inside & crosses_pane(points, mirrors, camera.center)
    return through > (1 - MOST_SEEN_DIRECTLY) * held
