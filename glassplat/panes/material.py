"""Mirrors told from glass, what seems to be behind panes, and what they mirror unseen."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.captures.view import View, evenly
from glassplat.kernels.adam import Update, adam
from glassplat.kernels.maths.images import linear_from_srgb
from glassplat.render.layers import gather_pixels, gathered_mirrored, window_means, window_sums
from glassplat.render.planar import FirstPass, Planar
from glassplat.render.splat import Splat
from glassplat.scene import SH_ZERO, logit
from glassplat.scene.camera import Camera, mirror_matrices
from glassplat.scene.panes import Planes, crosses_pane, in_image, nearest_pixels
from glassplat.scene.scene import Scene

log = logging.getLogger("glassplat.panes")

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
MIRROR_SLOPE, MIRROR_CORRELATION = 0.35, 0.3
"""Above both an aligned pane is taken for a mirror. In linear radiance the slope was at most 0.20 of 15 panes of glass
in ten captures, a dark television among them, at most 0.30 of 29 in sixteen more, and 0.52 and more of fifteen mirrors;
one of glass whose plane was off by 6 degrees came to 0.48. In sRGB, whose curve is steep where it is dark, the
television came to 0.35 and 0.38."""
SURE_SLOPE, SURE_CORRELATION = 0.6, 0.15
"""The same for a mirror beyond doubt, which may correlate less: one that shows more detail than a rough first scene has
came to 0.25 and 0.30, with slopes of 0.89 and 0.98. Where a pane in its plane is glass, it takes such a slope: one of a
front came to 0.42, of 16 % of it."""
LEAST_COVERAGE = 0.95
"""Coverage of the mirrored image from which a pixel counts; a rough first scene has holes, which are no dark things."""
WINDOW = 0.15
"""Side of the window whose mean is taken off, as a share of the image width: it removes differences in brightness."""
FEWEST_PIXELS, LEAST_SHARE = 200, 0.1
"""Of a pane's pixels, how many must be covered by what it would mirror for it to be judged: by a few hundredths of a
glass front, chosen by what is known of its surroundings, it may look like a mirror. Of mirrors 15 % and more are."""
INNER_SHARE = 0.8
"""Share of a rectangle's sides that is compared: its rim shows the frame, mirrored as well as directly."""
MOST_PHOTOGRAPHS, REDUCED_WIDTH = 40, 200
"""How many photographs tell mirrors from glass, and their largest width in pixels."""
TILTS_DEG, TILT_PHOTOGRAPHS = (-3.0, -1.5, 0.0, 1.5, 3.0), 8
"""Tilts about either axis that are tried before a plane is aligned, and how many photographs judge them."""
ALIGN_STEPS, ALIGN_RATE = 60, 2e-3
"""Steps of Adam, one photograph each, and their rate: radians, and shares of the scene extent."""
LEAST_GAIN_OF_ALIGNING, PERFECT = 1.15, 0.999
"""How many times as well photographs must agree with an aligned plane, and a correlation that counts as perfect. They
agree best with planes off by up to 0.5 degrees or 1.5 % of the extent; masks know better, or not at all
(lab/panes.md)."""
POLISH_STEPS, POLISH_ROUNDS, POLISH_PHOTOGRAPHS = (4e-3, 2e-3, 1e-3), 4, 16
"""Of a mirror: radians and shares of the extent by which it is moved, how often at most by each, and how many
photographs judge that at least, if there are so many."""
FEWEST_IN_VIEW = 100
"""Compared pixels with which a photograph has a say."""


class Likeness(NamedTuple):
    """Dependence of a pane's photographs on what the plane would mirror there, in linear radiance.

    slope: change of the photograph per change of the mirrored image; 1 for a mirror, about R0 for glass.
    correlation: of the two, over pixels and channels.
    """

    slope: float
    correlation: float

    @property
    def is_mirror(self) -> bool:
        """Return whether the photograph shows the mirrored scene itself."""
        usual = self.slope > MIRROR_SLOPE and self.correlation > MIRROR_CORRELATION
        return usual or (self.slope > SURE_SLOPE and self.correlation > SURE_CORRELATION)


class JudgedPane(NamedTuple):
    """A pane that may be a mirror.

    pane: a single plane, where it fits the photographs best if it is a mirror; like: how like one it is there;
    compared: how many pixels tell; shown: how many show the pane.
    """

    pane: Planes
    like: Likeness
    compared: int
    shown: int

    @property
    def is_known(self) -> bool:
        """Return whether enough is known of what it would mirror."""
        return self.compared >= FEWEST_PIXELS and self.compared >= LEAST_SHARE * self.shown

    @property
    def is_mirror(self) -> bool:
        """Return whether it is one, as far as enough is known."""
        return self.is_known and self.like.is_mirror


class Photograph(NamedTuple):
    """A photograph reduced to what tells mirrors from glass.

    camera: of its size; pixels [H, W, 3] in [0, 1], at the scene's exposure; valid [H, W] bool, which of them count;
    labels [H, W] of panes, None where it is not annotated.
    """

    camera: Camera
    pixels: Tensor
    valid: Tensor
    labels: Tensor | None


class ComparedPart(NamedTuple):
    """A part of a photograph in which a pane may mirror.

    camera: of the photograph; region [H, W] bool; pixels [P, 3] of the region, about their local means.
    """

    camera: Camera
    region: Tensor
    pixels: Tensor


def photographs_of(scene: Scene, views: Sequence[View]) -> list[Photograph]:
    """At most `MOST_PHOTOGRAPHS` of the views, evenly spread, none wider than `REDUCED_WIDTH`."""
    return [reduced_photograph(scene, view) for view in evenly(views, MOST_PHOTOGRAPHS)]


def reduced_photograph(scene: Scene, view: View) -> Photograph:
    """A view, not wider than `REDUCED_WIDTH`."""
    device = scene.primary.means.device
    camera = view.camera.to(device)
    factor = min(1.0, REDUCED_WIDTH / camera.width)
    size = (max(round(factor * camera.height), 1), max(round(factor * camera.width), 1))
    pixels = scene.exposures.undone(view.photo.to(device).float() / 255, view.name)
    pixels = torch.nn.functional.interpolate(pixels.movedim(-1, 0)[None], size, mode="area")[0].movedim(0, -1)
    valid = torch.ones_like(pixels[..., 0]) if view.ignored is None else 1.0 - view.ignored.to(device).float()
    if view.ignored is not None:
        valid = torch.nn.functional.interpolate(valid[None, None], size, mode="area")[0, 0]
    labels = None if view.pane_labels is None else view.pane_labels.to(device)
    if labels is not None:
        labels = torch.nn.functional.interpolate(labels[None, None].float(), size, mode="nearest-exact")[0, 0]
    return Photograph(camera.resize(size[1], size[0]), pixels, valid == 1, labels)


def judged_pane(scene: Scene, label: int, photographs: Sequence[Photograph]) -> JudgedPane:
    """Likeness of a pane to a mirror, where it is most like one.

    Nothing is transmitted by a mirror, so its photograph is the mirrored scene; through glass it is mostly what
    stands behind, which has nothing to do with the mirrored scene. A rough first scene is enough to tell, if the plane
    is exact: one that is tilted by a degree mirrors by two. So the plane is aligned first, as if it were a mirror's:
    the best of a few tilts, then gradient ascent of the correlation. Where that gains little, the plane stays.

    Args:
        scene: primary Gaussians after the first stage, with fitted planes and glass.
        label: of the pane.
        photographs: of the training views.
    """
    pane = scene.planes.select([scene.planes.labels.index(label)])
    pane = replace(pane, centers=pane.centers.detach(), raw_normals=pane.normals.detach())
    fitted = replace(scene, planes=replace(pane, half_sizes=INNER_SHARE * pane.half_sizes))
    regions = [compared_region(fitted, photograph) for photograph in photographs]
    telling = [
        ComparedPart(photograph.camera, region, about_local_mean(photograph.pixels, region)[region])
        for photograph, region in zip(photographs, regions, strict=True)
        if int(region.sum()) >= FEWEST_IN_VIEW
    ]
    inner = aligned_pane(fitted, telling) if telling else fitted
    pairs = [compared_pixels(inner, photograph) for photograph in photographs]
    shown = sum(shown for _, _, shown in pairs)
    mirrored, photographed = torch.cat([pair[0] for pair in pairs]), torch.cat([pair[1] for pair in pairs])
    like = likeness(mirrored, photographed)
    log.debug(
        "pane %d: slope %.2f, correlation %.2f, of %.1f %% of it, on a plane %.2f degrees from the fitted one",
        label, *like, 100 * len(mirrored) / max(shown, 1), degrees_between(inner.planes.normals[0], pane.normals[0]),
    )  # fmt: skip
    judged = JudgedPane(inner.planes, like, len(mirrored), shown)
    if inner is not fitted and judged.is_mirror:
        inner = polished_pane(inner, telling)
    return judged._replace(pane=replace(inner.planes, half_sizes=pane.half_sizes))


def degrees_between(normal: Tensor, other: Tensor) -> float:
    """Angle between two unit vectors [3]."""
    return math.degrees(math.atan2(float(torch.linalg.cross(normal, other).norm()), float((normal * other).sum())))


@torch.no_grad()
def pane_shown(scene: Scene, photograph: Photograph, mirrored: MirroredImage) -> Tensor:
    """[H, W] bool: the pixels that show the inner part of the scene's only pane, and count."""
    shown = mirrored.seen & photograph.valid
    return shown if photograph.labels is None else shown & (photograph.labels == scene.planes.labels[0])


@torch.no_grad()
def compared_region(scene: Scene, photograph: Photograph) -> Tensor:
    """[H, W] bool: those of them where it is known what the pane would mirror."""
    mirrored = mirrored_image(scene, photograph.camera)
    return pane_shown(scene, photograph, mirrored) & (mirrored.coverage > LEAST_COVERAGE)


@torch.no_grad()
def compared_pixels(scene: Scene, photograph: Photograph) -> tuple[Tensor, Tensor, int]:
    """Mirrored and photographed radiance [P, 3] of the scene's only pane, about local means, and how many show it.

    Pixels of which it is not known what the pane would mirror are shown, but not compared.
    """
    mirrored = mirrored_image(scene, photograph.camera)
    shown = pane_shown(scene, photograph, mirrored)
    region = shown & (mirrored.coverage > LEAST_COVERAGE)
    first, second = (
        about_local_mean(linear_from_srgb(image), region)[region] for image in (mirrored.color, photograph.pixels)
    )
    return first, second, int(shown.sum())


def aligned_pane(scene: Scene, telling: Sequence[ComparedPart]) -> Scene:
    """The scene with its only pane turned and shifted to where it is most like a mirror; itself if that gains little.

    Args:
        scene: with one pane.
        telling: parts of photographs to compare it with.
    """
    offsets = tilted_best(scene, telling[:: max(1, len(telling) // TILT_PHOTOGRAPHS)])
    moments, taken = (torch.zeros_like(offsets), torch.zeros_like(offsets)), 0
    for step in range(ALIGN_STEPS):
        moving = offsets.clone().requires_grad_()
        # Strides that share no factor with the number visit all of them, neighbours far apart.
        like = agreement(moved_pane(scene, moving), telling[step * 7919 % len(telling)])
        if not like.requires_grad:
            continue
        (slope,) = torch.autograd.grad(-like, moving)
        taken += 1
        # Not `torch.optim`, whose first optimiser imports PyTorch's compiler, which takes longer than all of this.
        adam([Update(offsets, slope, *moments, ALIGN_RATE * (1 - step / ALIGN_STEPS), taken)], eps=1e-8)
    aligned = moved_pane(scene, offsets)
    return aligned if agrees_better(aligned, scene, telling) else scene


@torch.no_grad()
def polished_pane(scene: Scene, telling: Sequence[ComparedPart]) -> Scene:
    """The scene with its only pane where photographs agree best nearby: ever smaller steps along one axis at a time.

    Gradient ascent, one photograph a step, leaves a mirror up to 2 % of the extent away from that place, and training
    brings back only a part of it.
    """
    some = telling[:: max(1, len(telling) // POLISH_PHOTOGRAPHS)]

    def agreed(offsets: Tensor) -> float:
        return mean_agreements([moved_pane(scene, offsets)], some)[0]

    best = scene.primary.means.new_zeros(3)
    most, axes = agreed(best), torch.eye(3, dtype=torch.float32).to(best)
    for step in POLISH_STEPS:
        for _ in range(POLISH_ROUNDS):
            before = most
            for change in step * torch.cat([axes, -axes]):
                if (found := agreed(best + change)) > most:
                    best, most = best + change, found
            if most == before:
                break
    return moved_pane(scene, best)


@torch.no_grad()
def agrees_better(aligned: Scene, fitted: Scene, telling: Sequence[ComparedPart]) -> bool:
    """Return whether photographs agree so much better with the aligned pane that the fitted plane must be wrong."""
    found = mean_agreements([aligned, fitted], telling)
    # By Fisher's transform, from 0.9 to 0.97 is as far as from 0.3 to 0.7.
    other, own = (math.atanh(max(-PERFECT, min(value, PERFECT))) for value in found)
    return other > LEAST_GAIN_OF_ALIGNING * own


@torch.no_grad()
def tilted_best(scene: Scene, telling: Sequence[ComparedPart]) -> Tensor:
    """[3] the offsets of `moved_pane` whose tilts, of those in `TILTS_DEG`, agree best with photographs."""
    means = scene.primary.means
    tilts = [math.radians(degrees) for degrees in TILTS_DEG]
    candidates = [means.new_tensor([first, second, 0.0]) for first in tilts for second in tilts]
    found = mean_agreements([moved_pane(scene, offsets) for offsets in candidates], telling)
    return candidates[found.index(max(found))]


def moved_pane(scene: Scene, offsets: Tensor) -> Scene:
    """The scene with its only pane tilted and shifted.

    Args:
        scene: with one pane.
        offsets: [3] tilts along tangent and bitangent, radians; shift along the normal, scene extents.
    """
    pane = scene.planes
    tangent, bitangent = pane.axes()
    normals = pane.normals + offsets[0] * tangent + offsets[1] * bitangent
    return replace(
        scene,
        planes=replace(
            pane,
            raw_normals=torch.nn.functional.normalize(normals, dim=-1),
            centers=pane.centers + offsets[2] * scene.extent * pane.normals,
        ),
    )


MIRRORING = Planar(BLACK, intensity=False, reflection_gradient="planes")
"""Renders what a pane mirrors."""


def agreement(scene: Scene, part: ComparedPart, first: FirstPass | None = None) -> Tensor:
    """Correlation of what the scene's only pane mirrors with a part of a photograph.

    `first` is what is seen directly, if that is known already.
    """
    (mirrored,) = MIRRORING.reflections(scene, part.camera, (BLACK,), first)
    one, other = about_local_mean(mirrored, part.region)[part.region], part.pixels
    tiny = torch.finfo(one.dtype).tiny
    return (one * other).sum() / torch.sqrt(((one * one).sum() * (other * other).sum()).clamp(min=tiny))


@torch.no_grad()
def mean_agreements(scenes: Sequence[Scene], telling: Sequence[ComparedPart]) -> list[float]:
    """Mean of `agreement` over parts of photographs, at least one: of each of several scenes that differ in where their
    only pane stands.
    """
    sums = [0.0] * len(scenes)
    for part in telling:
        first = MIRRORING.first_pass(scenes[0], part.camera)
        for number, scene in enumerate(scenes):
            sums[number] += float(agreement(scene, part, first))
    return [total / len(telling) for total in sums]


class MirroredImage(NamedTuple):
    """Image that the panes would mirror at full strength.

    color [H, W, 3]; coverage [H, W], how much of it is covered by Gaussians; seen [H, W] bool, where there is a pane.
    """

    color: Tensor
    coverage: Tensor
    seen: Tensor


def mirrored_image(scene: Scene, camera: Camera) -> MirroredImage:
    """Renders before black and before white, whose difference is what is not covered."""
    before_black, before_white = Planar(intensity=False).reflections(scene, camera, (BLACK, WHITE))
    seen = before_white.amax(dim=-1) > 0
    return MirroredImage(before_black, torch.where(seen, 1 - (before_white - before_black).mean(dim=-1), 0), seen)


@torch.no_grad()
def mirrored_coverage(scene: Scene, pane: Planes, camera: Camera) -> tuple[float, int]:
    """Pixels of a view in which a pane could mirror, and how many of them Gaussians cover."""
    mirrored = mirrored_image(replace(scene, planes=pane), camera)
    return float(mirrored.coverage.sum()), int(mirrored.seen.sum())


def about_local_mean(image: Tensor, region: Tensor) -> Tensor:
    """An image [H, W, 3] minus its mean over the part of a square window that lies in the region [H, W]."""
    reach = max(round(WINDOW * image.shape[1] / 2), 1)
    return image - window_means(image, region, reach).to(image.dtype)


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
    held, through = (torch.zeros(points.shape[0], device=points.device, dtype=torch.float32) for _ in range(2))
    for camera in (camera.to(points.device) for camera in cameras):
        inside = in_image(points, camera)
        held += inside
        through += inside & crosses_pane(points, mirrors, camera.center)
    return through > (1 - MOST_SEEN_DIRECTLY) * held


HIDDEN = 1.1
"""Depth beyond the mean one of its pixel, as a ratio, at which a Gaussian is seen through what should hide it."""
OPEN = 0.85
"""Depth up to which, as a ratio to the mean one of its pixel, a view shows that nothing is there; beyond its inverse
something stands before it."""
OFTEN, ALWAYS = 0.5, 0.9
"""Shares of the views that show a Gaussian behind panes in which it is hidden: often, and as good as always."""
LEAST_STEADY, LEAST_CONFIRMED = 0.9, 0.4
"""Shares of what may be reflections of which one at least must be reached: those always hidden of those often hidden,
and those whose places in front are those of surfaces, as far as views look at them. Of ten fronts of glass behind which
reflections had been built each reached one (0.60 to 0.97, 0.12 to 1.00), of six before real things, many of them far
away and of uncertain depth, none did (0.47 to 0.69, 0.02 to 0.25)."""
FEWEST_LOOKED_AT, FAIRLY_STEADY = 0.1, 0.7
"""Shares of which one at least must be reached before surfaces in front confirm anything: those always hidden whose
places views look at, of all that are always hidden; and those always hidden of those often hidden. A real front before
a street came to 0.01, all of it confirmed, and to 0.51. Of twelve fronts with reflections behind them the one
photographed from the front came to 0.03 and 0.85, the others to 0.11 and more. Below the second share, surfaces confirm
only what views look at: with the rest, a room of 0.59 lost three decibels of its transmission in a short run."""


@torch.no_grad()
def reflections_behind(scene: Scene, panes: Planes, cameras: Sequence[Camera]) -> Tensor:
    """[N] bool: which primary Gaussians stand behind glass for what it mirrors.

    Before a pane reflects, what it mirrors is built where it seems to be, and stays there as long as it explains the
    photographs as well. Most of it seems to be farther away than what is really there, and shows through that. So a
    Gaussian is meant if most views hold it behind the panes, and nearly all in which these are not hidden hold it
    beyond the mean depth; and if its mirror image is possible, and not in a place that views look straight through.
    None is meant where many more are hidden in some views alone, and views past the panes find surfaces in too few of
    these places, or look at hardly any: then they are real things. Where somewhat more are, and surfaces are found,
    only those are meant whose places views look at.

    Args:
        scene: with panes or without.
        panes: of glass, all in one plane.
        cameras: the training views.
    """
    means = scene.primary.means
    (mirror,) = mirror_matrices(panes.centers[:1], panes.normals[:1])
    images = means @ mirror[:3, :3].T + mirror[:3, 3]
    shown, hidden, direct, vacant, before = means.new_zeros(5, len(means))
    for camera in (camera.to(means.device) for camera in cameras):
        depth = Splat()(scene, camera).layers["depth"]
        ratio, inside = relative_depths(means, camera, depth)
        surface = camera.center + (means - camera.center) / ratio[:, None]
        crossing = inside & crosses_pane(means, panes, camera.center) & crosses_pane(surface, panes, camera.center)
        shown += crossing
        hidden += crossing & (ratio > HIDDEN)
        ratio, inside = relative_depths(images, camera, depth)
        looking = inside & ~crosses_pane(images, panes, camera.center)
        direct += looking
        vacant += looking & (ratio < OPEN)
        before += looking & (ratio > 1 / OPEN)
    often = virtual_points(means, panes, cameras) & (hidden > OFTEN * shown) & (vacant <= 0.5 * direct)
    always = often & (hidden > ALWAYS * shown)
    looked_at = always & (direct > 0)
    confirmed = looked_at & (vacant + before <= 0.5 * direct)
    meant = torch.where(always.sum() >= FAIRLY_STEADY * often.sum(), always, looked_at)
    return meant & mostly_reflections(often.sum(), always.sum(), looked_at.sum(), confirmed.sum())


def mostly_reflections(often: Tensor, always: Tensor, looked_at: Tensor, confirmed: Tensor) -> Tensor:
    """[] bool: what is hidden behind a front of glass is mostly what it mirrors. All arguments count Gaussians.

    Args:
        often: hidden in most views.
        always: hidden in nearly all.
        looked_at: those of them whose places in front are in some view.
        confirmed: those of these whose places are those of surfaces.
    """
    is_confirmed = (looked_at > 0) & (confirmed >= LEAST_CONFIRMED * looked_at)
    is_known = (looked_at >= FEWEST_LOOKED_AT * always) | (always >= FAIRLY_STEADY * often)
    return (always >= LEAST_STEADY * often) | (is_confirmed & is_known)


def relative_depths(points: Tensor, camera: Camera, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Depths [N] of points over those in an image [H, W] at their pixels, and [N] bool which lie in the image.

    The ratio is 1 where the image holds nothing.
    """
    pixels, depths = camera.project(points)
    there = depth[nearest_pixels(pixels, camera)]
    return torch.where(there > 0, depths / there, 1), in_image(points, camera)


CLIPPED = 0.98
"""Value of the darkest channel from which a pixel may be brighter than it can show."""
LAMP_SHARE = 0.6
"""Of what photographs show directly of a lamp, how much is clipped; of what they show of its image, how much lies where
a pane mirrors it."""
LEAST_GAIN, MOST_GAIN = 1.5, 30.0
"""Radiance of a lamp, where white is 1."""
LEAST_BRIGHT = 0.8
"""Of the pixels in which a pane mirrors a lamp, how many are bright enough for one."""
IMAGE_BRIGHTNESS = 0.5
"""Of the darkest channel of a lamp's image, sRGB: what is darker a pane mirrors of white things."""
LAMP_RIM = 0.012
"""How far from where it should be an image is looked for, as a share of the image width."""
FEWEST_SEEN = 0.3
"""Pixels, of all photographs together, below which nothing is told."""


class Lamps(NamedTuple):
    """Lamps that panes mirror.

    images [N] bool: primary Gaussians behind the panes that show them; gains [N]: factors on how bright primary
    Gaussians are where they are mirrored, 1 for all but lamps.
    """

    images: Tensor
    gains: Tensor


@torch.no_grad()
def mirrored_lamps(scene: Scene, panes: Planes, photographs: Sequence[Photograph]) -> Lamps | None:
    """Lamps that panes of glass mirror, with the radiance that their reflections have; None without any.

    A photograph cannot say how much brighter than white a lamp is, but its reflection at a few hundredths can. Before
    that is known, the first scene has built the reflection behind the glass, as bright as it looks, and there it stays,
    because it explains the photographs. So lamps are found by what is clipped wherever it is seen directly, and so
    bright wherever a pane mirrors it that no reflection of white would do. What stands behind the pane where it
    mirrors a lamp, and nowhere else, is its image.

    Args:
        scene: with the panes.
        panes: of glass.
        photographs: those that tell.
    """
    alone = replace(scene, planes=panes)
    lamps = _lamps_among(alone, photographs)
    if not bool(lamps.any()):
        return None
    lit = [_lit_pixels(alone, lamps, photograph.camera) for photograph in photographs]
    images = _images_of(alone, lit, photographs)
    if not bool(images.any()):
        return None
    dark = torch.full_like(scene.primary.logit_opacities, logit(1e-3))
    opacities = torch.where(images, torch.minimum(dark, scene.primary.logit_opacities), scene.primary.logit_opacities)
    without = replace(alone, primary=scene.primary.with_tensors({"logit_opacities": opacities}))
    return Lamps(images, torch.where(lamps, _gains_of(without, lit, photographs), 1))


def _lamps_among(scene: Scene, photographs: Sequence[Photograph]) -> Tensor:
    """[N] bool: what is clipped where it is seen directly, and brighter than white where it is mirrored."""
    clipped, direct, bright, mirrored = scene.primary.means.new_zeros(4, len(scene.primary))
    for photograph in photographs:
        strength = Planar(nearest_only=True)(scene, photograph.camera).layers["strength"]
        past, through = photograph.valid & (strength <= 0), photograph.valid & (strength > 0)
        darkest = photograph.pixels.amin(dim=-1)
        shown = gather_pixels(scene, photograph.camera, torch.stack([past & (darkest > CLIPPED), past], dim=-1).float())
        enough = linear_from_srgb(darkest.clamp(0, 1)) > LEAST_GAIN * strength
        there = gathered_mirrored(scene, photograph.camera, torch.stack([through & enough, through], dim=-1).float())
        clipped, direct = clipped + shown[:, 0], direct + shown[:, 1]
        bright, mirrored = bright + there[:, 0], mirrored + there[:, 1]
    enough_seen = (direct > FEWEST_SEEN) & (mirrored > FEWEST_SEEN)
    return enough_seen & (clipped > LAMP_SHARE * direct) & (bright > LEAST_BRIGHT * mirrored)


class LitPixels(NamedTuple):
    """[H, W] bool each: where a view shows a pane, and where this mirrors mostly lamps."""

    glass: Tensor
    lit: Tensor


def _lit_pixels(scene: Scene, lamps: Tensor, camera: Camera) -> LitPixels:
    """Those of a view, of lamps [N] bool."""
    sh = torch.zeros_like(scene.primary.sh)
    sh[:, 0] = (lamps.float()[:, None] - 0.5) / SH_ZERO
    painted = replace(scene.primary.with_tensors({"sh": sh}), active_sh_degree=0)
    frame = Planar(intensity=False, nearest_only=True)(replace(scene, primary=painted), camera)
    glass = frame.layers["strength"] > 0
    return LitPixels(glass, glass & (frame.layers["reflection"].amin(dim=-1) > 0.5))


def _images_of(scene: Scene, seen: Sequence[LitPixels], photographs: Sequence[Photograph]) -> Tensor:
    """[N] bool: what is bright, behind the panes, and mostly where these mirror lamps."""
    means = scene.primary.means
    near, through = means.new_zeros(2, len(means))
    for photograph, (glass, lit) in zip(photographs, seen, strict=True):
        rim = max(round(LAMP_RIM * glass.shape[1]), 1)
        lit = glass & (window_sums(lit[..., None], rim)[..., 0] > 0)
        shown = gather_pixels(scene, photograph.camera, torch.stack([lit, glass], dim=-1).float())
        shown = shown * crosses_pane(means, scene.planes, photograph.camera.to(means.device).center)[:, None]
        near, through = near + shown[:, 0], through + shown[:, 1]
    bright = (scene.primary.sh[:, 0] * SH_ZERO + 0.5).amin(dim=-1) > IMAGE_BRIGHTNESS
    return bright & (through > FEWEST_SEEN) & (near > LAMP_SHARE * through)


def _gains_of(scene: Scene, seen: Sequence[LitPixels], photographs: Sequence[Photograph]) -> Tensor:
    """[N] radiance that the photographs leave to the reflections of lamps over what they have; 1 where none is seen."""
    left, had = scene.primary.means.new_zeros(2, len(scene.primary))
    for photograph, (_, lit) in zip(photographs, seen, strict=True):
        layers = Planar(nearest_only=True)(scene, photograph.camera).layers
        strength = layers["strength"].clamp(min=1e-2)[..., None]
        behind = linear_from_srgb(layers["transmission"].clamp(0, 1))
        radiance = (linear_from_srgb(photograph.pixels.clamp(0, 1)) - (1 - strength) * behind) / strength
        values = torch.stack([radiance.clamp(min=0), linear_from_srgb(layers["reflection"].clamp(min=0))]).mean(dim=-1)
        sums = gathered_mirrored(scene, photograph.camera, (values * (lit & photograph.valid)).movedim(0, -1))
        left, had = left + sums[:, 0], had + sums[:, 1]
    gains = (left / had.clamp(min=1e-6)).clamp(1, MOST_GAIN)
    return torch.where(had > 0, gains, 1)


UNCOVERED = 0.5
"""Coverage of the mirrored image below which it counts as a hole."""
HOLE_CAMERAS, RAYS_ACROSS, CELLS_ACROSS = 24, 40, 40
"""Cameras that look for holes, rays across an image, and cells across the room with a place each."""
BEYOND = 0.05
"""Of the Gaussians, how many are farther from the middle of the cameras than the end of the room."""


class Unseen(NamedTuple):
    """Places [P, 3] that panes mirror and no photograph shows, their likely colour [3], sRGB, and their distance."""

    places: Tensor
    color: Tensor
    cell: float


@torch.no_grad()
def unseen_places(scene: Scene, panes: Planes, cameras: Sequence[Camera]) -> Unseen:
    """Places at the end of the room that panes mirror, and where no Gaussian stands.

    A pane cannot mirror nothing. What is dark in its image for want of Gaussians, the transmission has too much of.

    Args:
        scene: with the panes.
        panes: of glass.
        cameras: of the photographs; some of them are enough.
    """
    device = scene.primary.means.device
    cameras = [camera.to(device) for camera in evenly(cameras, HOLE_CAMERAS)]
    middle = torch.stack([camera.center for camera in cameras]).mean(dim=0)
    away = (scene.primary.means - middle).norm(dim=1).sort().values
    radius = away[int((1 - BEYOND) * (len(away) - 1))]
    places, colors = [], [torch.zeros(0, 3, device=device, dtype=torch.float32)]
    for camera in cameras:
        for row in range(len(panes)):
            pane = panes.select([row])
            image = mirrored_image(replace(scene, planes=pane), camera)
            colors.append(image.color[image.seen & (image.coverage > LEAST_COVERAGE)].clamp(0, 1))
            places.append(_ends_of_rays(pane, camera, image.seen & (image.coverage < UNCOVERED), middle, radius))
    found, known = torch.cat(places), torch.cat(colors)
    # In the axes of a camera, so that it does not matter which way the world is turned.
    size = 2 * radius / CELLS_ACROSS
    cells = ((found - middle) @ cameras[0].cam_from_world[:3, :3].T / size).floor().long()
    _, cell = torch.unique(cells, dim=0, return_inverse=True)
    first = torch.full_like(cell, len(found)).scatter_reduce_(0, cell, torch.arange(len(found), device=device), "amin")
    color = known.mean(dim=0) if len(known) else known.new_full((3,), 0.5)
    return Unseen(found[first[first < len(found)]], color, float(size))


def _ends_of_rays(pane: Planes, camera: Camera, hole: Tensor, middle: Tensor, radius: Tensor) -> Tensor:
    """[P, 3] where rays through some pixels of a hole [H, W] leave a sphere, once the pane has mirrored them."""
    step = max(camera.width // RAYS_ACROSS, 1)
    row, column = (hole[::step, ::step].nonzero() * step + 0.5).to(middle).unbind(dim=1)
    x, y = (column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy
    ray = torch.stack([x, y, torch.ones_like(x)], dim=1) @ camera.cam_from_world[:3, :3]
    normal, toward = pane.normals[0], ray @ pane.normals[0]
    start = camera.center + (((pane.centers[0] - camera.center) @ normal) / toward)[:, None] * ray - middle
    ray = torch.nn.functional.normalize(ray - 2 * toward[:, None] * normal, dim=1)
    along = (start * ray).sum(dim=1)
    squared = along.square() - start.square().sum(dim=1) + radius.square()
    length = squared.clamp(min=0).sqrt() - along
    return (middle + start + length[:, None] * ray)[(squared > 0) & (length > 0)]
