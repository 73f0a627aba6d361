"""Materials of panes: mirror or glass, virtual Gaussians behind panes, mirrored lamps and unseen surroundings."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.captures.view import View, sample_evenly
from glassplat.kernels.adam import Update, adam
from glassplat.kernels.maths.images import linear_from_srgb
from glassplat.kernels.records import DAZZLING
from glassplat.options import BLACK, WHITE
from glassplat.render.layers import gather_mirrored_pixels, gather_pixels, window_means, window_sums
from glassplat.render.panes import blend_conversions
from glassplat.render.planar import DirectPass, Planar
from glassplat.render.splat import Splat
from glassplat.scene import SH_ZERO, logit
from glassplat.scene.camera import Camera, mirror_matrices
from glassplat.scene.panes import Planes, crosses_pane, in_image, nearest_pixels
from glassplat.scene.scene import Scene

log = logging.getLogger("glassplat.panes")

MIRROR_SLOPE, MIRROR_CORRELATION = 0.35, 0.3
"""An aligned pane above both is classified as a mirror. In linear radiance, the slope was at most 0.20 for 15 panes of
glass in ten captures, including a dark television, and at most 0.30 for 29 in sixteen more. It was at least 0.52 for
fifteen mirrors, and 0.48 for glass whose plane was off by 6 degrees. In sRGB, whose curve is steep in dark regions, it
was 0.35 and 0.38 for the television."""
SURE_SLOPE, SURE_CORRELATION = 0.6, 0.15
"""The same for a clear mirror, which may correlate less: one that shows more detail than a coarse first scene contains
had correlations of 0.25 and 0.30, with slopes of 0.89 and 0.98. If a coplanar pane is glass, this slope is required:
one glass pane of a front had 0.42, measured on 16 % of its pixels."""
LEAST_COVERAGE = 0.95
"""Coverage of the mirrored image above which a pixel counts: holes in a coarse first scene are not dark objects."""
MEAN_WINDOW = 0.15
"""Side of the window whose mean is subtracted, to remove differences in brightness; as a share of the image width."""
FEWEST_PIXELS, LEAST_SHARE = 200, 0.1
"""Minimum number and share of a pane's pixels whose mirrored image is covered, for a classification. A few percent of a
glass front, selected by the known part of its surroundings, may look like a mirror. Mirrors have at least 15 %."""
INNER_SHARE = 0.8
"""Share of a rectangle's sides that is compared, because its rim shows the frame, mirrored as well as directly."""
MOST_PHOTOGRAPHS, REDUCED_WIDTH = 40, 200
"""Maximum number of photographs used to distinguish mirrors from glass, and their maximum width in pixels."""
TILTS_DEG, TILT_PHOTOGRAPHS = (-3.0, -1.5, 0.0, 1.5, 3.0), 8
"""Tilts about either axis tried before a plane is aligned, and the minimum number of photographs that rank them."""
ALIGN_STEPS, ALIGN_RATE = 60, 2e-3
"""Steps of Adam, one photograph each, and the learning rate in radians and shares of the scene extent."""
LEAST_GAIN_OF_ALIGNING, PERFECT = 1.15, 0.999
"""Minimum ratio of the agreement of photographs with an aligned plane to that with the fitted one, and a correlation
that counts as perfect. Photographs agree best with planes off by up to 0.5 degrees or 1.5 % of the extent; masks are
more accurate, or useless (lab/panes.md)."""
POLISH_STEPS, POLISH_ROUNDS, POLISH_PHOTOGRAPHS = (4e-3, 2e-3, 1e-3), 4, 16
"""For mirrors: step sizes in radians and shares of the extent, maximum number of rounds with each, and minimum number
of photographs to evaluate them, if available."""
FEWEST_IN_VIEW = 100
"""Minimum number of compared pixels for a photograph to count."""


class MirrorRegression(NamedTuple):
    """Regression of a pane's photographs on the image mirrored by its plane, in linear radiance.

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


class MirrorCandidate(NamedTuple):
    """A pane that may be a mirror.

    pane: a single plane, aligned to the photographs as if it were a mirror; regression: of the photographs, with that
    plane; compared: number of pixels compared; shown: number of pixels that show the pane.
    """

    pane: Planes
    regression: MirrorRegression
    compared: int
    shown: int

    @property
    def is_known(self) -> bool:
        """Return whether enough of its mirrored image is covered by Gaussians."""
        return self.compared >= FEWEST_PIXELS and self.compared >= LEAST_SHARE * self.shown

    @property
    def is_mirror(self) -> bool:
        """Return whether it is a mirror; false if not enough is known."""
        return self.is_known and self.regression.is_mirror


class Photograph(NamedTuple):
    """A downscaled photograph, used to distinguish mirrors from glass.

    camera: scaled to its size; pixels [H, W, 3] in [0, 1], at the scene's exposure; valid [H, W] bool, pixels that
    count; labels [H, W] of panes, None if it is not annotated; clipped [H, W] bool, pixels that its own exposure may
    have clipped.
    """

    camera: Camera
    pixels: Tensor
    valid: Tensor
    labels: Tensor | None
    clipped: Tensor


class ComparedPart(NamedTuple):
    """A part of a photograph in which a pane may show a reflection.

    camera: of the photograph; region [H, W] bool; pixels [P, 3] of the region, minus their local means.
    """

    camera: Camera
    region: Tensor
    pixels: Tensor


def reduced_photographs(scene: Scene, views: Sequence[View]) -> list[Photograph]:
    """At most `MOST_PHOTOGRAPHS` of the views, evenly spread, none wider than `REDUCED_WIDTH`."""
    return [reduced_photograph(scene, view) for view in sample_evenly(views, MOST_PHOTOGRAPHS)]


def reduced_photograph(scene: Scene, view: View) -> Photograph:
    """A view, downscaled to at most `REDUCED_WIDTH`."""
    device = scene.primary.means.device
    camera = view.camera.to(device)
    factor = min(1.0, REDUCED_WIDTH / camera.width)
    size = (max(round(factor * camera.height), 1), max(round(factor * camera.width), 1))
    photo = (view.photo.to(device).float() / 255).movedim(-1, 0)
    photo = torch.nn.functional.interpolate(photo[None], size, mode="area")[0].movedim(0, -1)
    pixels, clipped = scene.exposures.apply_inverse(photo, view.name), photo.amin(dim=-1) > CLIPPED
    valid = torch.ones_like(pixels[..., 0], dtype=torch.bool)
    if view.ignored is not None:
        ignored = view.ignored.to(device)[None, None].float()
        valid = torch.nn.functional.interpolate(ignored, size, mode="area")[0, 0] == 0
    labels = None if view.pane_labels is None else view.pane_labels.to(device)
    if labels is not None:
        labels = torch.nn.functional.interpolate(labels[None, None].float(), size, mode="nearest-exact")[0, 0]
    return Photograph(camera.resize(size[1], size[0]), pixels, valid, labels, clipped)


def mirror_candidate(scene: Scene, label: int, photographs: Sequence[Photograph]) -> MirrorCandidate:
    """Likeness of a pane to a mirror, on the plane that maximises it.

    A mirror transmits nothing, so its photograph is the mirrored scene. Glass mostly shows objects behind it, which are
    unrelated to the mirrored scene. A coarse first scene suffices to distinguish them, if the plane is accurate: a tilt
    of one degree turns the reflection by two. So the plane is aligned first, as if it were a mirror's: the best of a
    few tilts, then gradient ascent on the correlation. If the gain is small, the fitted plane is kept.

    Args:
        scene: primary Gaussians after the first stage, with fitted planes and glass.
        label: of the pane.
        photographs: of the training views.
    """
    pane = scene.planes.select([scene.planes.labels.index(label)])
    pane = replace(pane, centers=pane.centers.detach(), raw_normals=pane.normals.detach())
    fitted = replace(scene, planes=replace(pane, half_sizes=INNER_SHARE * pane.half_sizes))
    regions = [compared_region(fitted, photograph)[-1] for photograph in photographs]
    parts = [
        ComparedPart(photograph.camera, region, subtract_local_mean(photograph.pixels, region)[region])
        for photograph, region in zip(photographs, regions, strict=True)
        if int(region.sum()) >= FEWEST_IN_VIEW
    ]
    aligned = align_pane(fitted, parts) if parts else fitted
    pairs = [compared_pixels(aligned, photograph) for photograph in photographs]
    shown = sum(shown for _, _, shown in pairs)
    mirrored, photographed = torch.cat([pair[0] for pair in pairs]), torch.cat([pair[1] for pair in pairs])
    regression = regress_on_mirrored(mirrored, photographed)
    log.debug(
        "pane %d: slope %.2f, correlation %.2f, of %.1f %% of it, on a plane %.2f degrees from the fitted one",
        label, *regression, 100 * len(mirrored) / max(shown, 1),
        degrees_between(aligned.planes.normals[0], pane.normals[0]),
    )  # fmt: skip
    candidate = MirrorCandidate(aligned.planes, regression, len(mirrored), shown)
    if aligned is not fitted and candidate.is_mirror:
        aligned = polish_pane(aligned, parts)
    return candidate._replace(pane=replace(aligned.planes, half_sizes=pane.half_sizes))


def degrees_between(normal: Tensor, other: Tensor) -> float:
    """Angle between two unit vectors [3]."""
    return math.degrees(math.atan2(float(torch.linalg.cross(normal, other).norm()), float((normal * other).sum())))


@torch.no_grad()
def compared_region(scene: Scene, photograph: Photograph) -> tuple[Tensor, Tensor, Tensor]:
    """[H, W, 3] the mirrored image of the scene's only pane, and [H, W] bool each: the valid pixels that show the inner
    part of the pane, and those of them at which Gaussians cover the mirrored image.
    """
    mirrored = mirrored_image(scene, photograph.camera)
    shown = mirrored.seen & photograph.valid
    shown = shown if photograph.labels is None else shown & (photograph.labels == scene.planes.labels[0])
    return mirrored.color, shown, shown & (mirrored.coverage > LEAST_COVERAGE)


@torch.no_grad()
def compared_pixels(scene: Scene, photograph: Photograph) -> tuple[Tensor, Tensor, int]:
    """Mirrored and photographed radiance [P, 3] of the scene's only pane, minus local means, and its pixel count.

    Pixels whose mirrored image is not covered by Gaussians are counted, but not compared.
    """
    mirrored, shown, region = compared_region(scene, photograph)
    images = (mirrored, photograph.pixels)
    first, second = (subtract_local_mean(linear_from_srgb(image), region)[region] for image in images)
    return first, second, int(shown.sum())


def align_pane(scene: Scene, parts: Sequence[ComparedPart]) -> Scene:
    """The scene with its only pane moved to where it is most like a mirror; unchanged if the gain is small."""
    tilts, means = [math.radians(degrees) for degrees in TILTS_DEG], scene.primary.means
    candidates = [means.new_tensor([first, second, 0.0]) for first in tilts for second in tilts]
    some = parts[:: max(1, len(parts) // TILT_PHOTOGRAPHS)]
    found = mean_correlations([move_pane(scene, offsets) for offsets in candidates], some)
    offsets = candidates[found.index(max(found))]
    moments, steps = (torch.zeros_like(offsets), torch.zeros_like(offsets)), 0
    for step in range(ALIGN_STEPS):
        moving = offsets.clone().requires_grad_()
        # A stride coprime to the number of parts visits all of them, neighbours far apart.
        likeness = mirror_correlation(move_pane(scene, moving), parts[step * 7919 % len(parts)])
        if not likeness.requires_grad:  # The moved pane is out of this view.
            continue
        (gradient,) = torch.autograd.grad(-likeness, moving)
        steps += 1
        # Not `torch.optim`: its first optimiser imports PyTorch's compiler, which takes longer than the alignment.
        adam([Update(offsets, gradient, *moments, ALIGN_RATE * (1 - step / ALIGN_STEPS), steps)], eps=1e-8)
    aligned = move_pane(scene, offsets)
    # On Fisher's scale, the step from 0.9 to 0.97 is about as large as that from 0.3 to 0.7.
    other, own = (math.atanh(max(-PERFECT, min(r, PERFECT))) for r in mean_correlations([aligned, scene], parts))
    return aligned if other > LEAST_GAIN_OF_ALIGNING * own else scene


@torch.no_grad()
def polish_pane(scene: Scene, parts: Sequence[ComparedPart]) -> Scene:
    """The scene with its only pane moved to where photographs agree best nearby, by a search along one axis at a time.

    Gradient ascent, one photograph a step, leaves a mirror up to 2 % of the extent away from that optimum, and training
    recovers only a part of it.
    """
    chosen = parts[:: max(1, len(parts) // POLISH_PHOTOGRAPHS)]

    def likeness(offsets: Tensor) -> float:
        return mean_correlations([move_pane(scene, offsets)], chosen)[0]

    best = scene.primary.means.new_zeros(3)
    most, axes = likeness(best), torch.eye(3, dtype=torch.float32).to(best)
    for step in POLISH_STEPS:
        for _ in range(POLISH_ROUNDS):
            before = most
            for change in step * torch.cat([axes, -axes]):
                if (found := likeness(best + change)) > most:
                    best, most = best + change, found
            if most == before:
                break
    return move_pane(scene, best)


def move_pane(scene: Scene, offsets: Tensor) -> Scene:
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


MIRROR_RENDERER = Planar(BLACK, intensity=False, reflection_gradient="planes")
"""Renders the image mirrored by a pane."""


def mirror_correlation(scene: Scene, part: ComparedPart, direct: DirectPass | None = None) -> Tensor:
    """Correlation of the image mirrored by the scene's only pane with a part of a photograph.

    `direct` is the direct pass, if it has been rendered already.
    """
    (mirrored,) = MIRROR_RENDERER.reflections(scene, part.camera, (BLACK,), direct)
    return correlation(subtract_local_mean(mirrored, part.region)[part.region], part.pixels)


def correlation(one: Tensor, other: Tensor) -> Tensor:
    """Correlation of two sets of values, both minus their means; 0 where one is constant. Differentiable."""
    spreads = (one * one).sum() * (other * other).sum()
    return (one * other).sum() / torch.sqrt(spreads.clamp(min=torch.finfo(one.dtype).tiny))


@torch.no_grad()
def mean_correlations(scenes: Sequence[Scene], parts: Sequence[ComparedPart]) -> list[float]:
    """Means of `mirror_correlation` over one or more parts, for scenes that differ only in their pane."""
    sums = [0.0] * len(scenes)
    for part in parts:
        direct = MIRROR_RENDERER.direct_pass(scenes[0], part.camera)
        for number, scene in enumerate(scenes):
            sums[number] += float(mirror_correlation(scene, part, direct))
    return [total / len(parts) for total in sums]


class MirroredImage(NamedTuple):
    """Image that the panes would mirror at full strength.

    color [H, W, 3]; coverage [H, W] of it by Gaussians; seen [H, W] bool, pixels of panes.
    """

    color: Tensor
    coverage: Tensor
    seen: Tensor


def mirrored_image(scene: Scene, camera: Camera) -> MirroredImage:
    """Renders the reflection over black and over white; their difference is the part not covered."""
    over_black, over_white = Planar(intensity=False).reflections(scene, camera, (BLACK, WHITE))
    seen = over_white.amax(dim=-1) > 0
    return MirroredImage(over_black, torch.where(seen, 1 - (over_white - over_black).mean(dim=-1), 0), seen)


def subtract_local_mean(image: Tensor, region: Tensor) -> Tensor:
    """An image [H, W, 3] minus its mean over the part of a square window that lies in the region [H, W]."""
    reach = max(round(MEAN_WINDOW * image.shape[1] / 2), 1)
    return image - window_means(image, region, reach).to(image.dtype)


def regress_on_mirrored(mirrored: Tensor, photographed: Tensor) -> MirrorRegression:
    """Regression of photographed on mirrored values [P, 3], both minus their means."""
    spread = (mirrored * mirrored).sum().clamp(min=torch.finfo(mirrored.dtype).tiny)
    slope = (mirrored * photographed).sum() / spread
    return MirrorRegression(float(slope), float(correlation(mirrored, photographed)))


MAJORITY = 0.5
"""Share of the views that show a Gaussian, or its mirrored position, above which most of them do."""


@torch.no_grad()
def virtual_points(points: Tensor, mirrors: Planes, cameras: Sequence[Camera]) -> Tensor:
    """[N] bool: points that are mirror images, because most views see them through a mirror.

    Nothing real is seen through a mirror, so these can be removed as soon as the mirror reflects. Otherwise they would
    continue to explain its image, and its reflectance would decrease instead.

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
    return through > MAJORITY * held


HIDDEN_DEPTH_RATIO = 1.1
"""Ratio of a Gaussian's depth to the mean depth of its pixel above which other surfaces should occlude it."""
EMPTY_DEPTH_RATIO = 0.85
"""Ratio of a position's depth to the mean depth of its pixel below which a view shows that the position is empty; above
the inverse it is occluded."""
ALWAYS_HIDDEN = 0.9
"""Minimum share of the views that show a Gaussian behind panes in which it is hidden, to count as always hidden."""
LEAST_ALWAYS_HIDDEN, LEAST_CONFIRMED = 0.9, 0.4
"""Minimum shares of possible reflections, at least one of which must be reached: always hidden ones among those often
hidden, and ones whose mirrored positions lie on surfaces among those with mirrored positions in view. Each of ten glass
fronts with reflections built behind them reached one (0.60 to 0.97, 0.12 to 1.00). Of six fronts with real objects
behind them, many far away and of uncertain depth, none did (0.47 to 0.69, 0.02 to 0.25)."""
FEWEST_IN_SOME_VIEW, MANY_ALWAYS_HIDDEN = 0.1, 0.7
"""Minimum shares, at least one of which must be reached for surfaces in front to confirm reflections: always hidden
Gaussians with mirrored positions in view among all that are always hidden; and always hidden ones among those often
hidden. A real front facing a street had 0.01, all of it confirmed, and 0.51. Of twelve fronts with reflections behind
them, the one photographed from the front had 0.03 and 0.85, the others at least 0.11. Below the second share, only
those in view are confirmed: with the rest, a room with 0.59 lost 3 dB of its transmission in a short run."""


@torch.no_grad()
def reflections_behind(scene: Scene, panes: Planes, cameras: Sequence[Camera]) -> Tensor:
    """[N] bool: primary Gaussians behind panes of glass, all in one plane, that represent their reflections.

    Before a pane reflects, training builds its reflections at their virtual positions, where they stay as long as they
    explain the photographs equally well. Most of them are farther away than the real surfaces, and show through these.
    So a Gaussian is selected if it is behind the panes in most views, and beyond the mean depth in nearly all of those
    in which the panes are not occluded. Also, views must not show its mirrored position to be empty. None is selected
    if many more Gaussians are hidden in some views only, and views past the panes find surfaces at too few of the
    mirrored positions, or see hardly any of them: then they are real objects. If only somewhat more are, and surfaces
    are found, those with mirrored positions in view are selected.

    The cameras are those of the training views; the scene's own panes, if it has any, have no influence.
    """
    means = scene.primary.means
    (mirror,) = mirror_matrices(panes.centers[:1], panes.normals[:1])
    images = means @ mirror[:3, :3].T + mirror[:3, 3]
    shown, hidden, direct_views, empty, occluded = means.new_zeros(5, len(means))
    for camera in (camera.to(means.device) for camera in cameras):
        depth = Splat()(scene, camera).layers["depth"]
        ratio, inside = relative_depths(means, camera, depth)
        surface = camera.center + (means - camera.center) / ratio[:, None]
        crossing = inside & crosses_pane(means, panes, camera.center) & crosses_pane(surface, panes, camera.center)
        shown += crossing
        hidden += crossing & (ratio > HIDDEN_DEPTH_RATIO)
        ratio, inside = relative_depths(images, camera, depth)
        in_view = inside & ~crosses_pane(images, panes, camera.center)
        direct_views += in_view
        empty += in_view & (ratio < EMPTY_DEPTH_RATIO)
        occluded += in_view & (ratio > 1 / EMPTY_DEPTH_RATIO)
    often = virtual_points(means, panes, cameras) & (hidden > MAJORITY * shown) & (empty <= MAJORITY * direct_views)
    always = often & (hidden > ALWAYS_HIDDEN * shown)
    in_some_view = always & (direct_views > 0)
    confirmed = in_some_view & (empty + occluded <= MAJORITY * direct_views)
    selected = torch.where(always.sum() >= MANY_ALWAYS_HIDDEN * often.sum(), always, in_some_view)
    return selected & are_mostly_reflections(often.sum(), always.sum(), in_some_view.sum(), confirmed.sum())


def are_mostly_reflections(often: Tensor, always: Tensor, in_some_view: Tensor, confirmed: Tensor) -> Tensor:
    """[] bool: Gaussians hidden behind a glass front are mostly its reflections. All arguments are counts of Gaussians.

    Args:
        often: hidden in most views.
        always: hidden in nearly all.
        in_some_view: those of them whose mirrored positions are in some view.
        confirmed: those of these whose mirrored positions lie on surfaces.
    """
    is_confirmed = (in_some_view > 0) & (confirmed >= LEAST_CONFIRMED * in_some_view)
    is_known = (in_some_view >= FEWEST_IN_SOME_VIEW * always) | (always >= MANY_ALWAYS_HIDDEN * often)
    return (always >= LEAST_ALWAYS_HIDDEN * often) | (is_confirmed & is_known)


def relative_depths(points: Tensor, camera: Camera, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Ratios [N] of points' depths to a depth image [H, W] at their pixels, and [N] bool: points inside the image.

    The ratio is 1 where the depth image is empty.
    """
    pixels, depths = camera.project(points)
    there = depth[nearest_pixels(pixels, camera)]
    return torch.where(there > 0, depths / there, 1), in_image(points, camera)


CLIPPED = 0.98
"""Value of the darkest channel above which a pixel may be clipped."""
LAMP_SHARE = 0.6
"""Minimum share of a lamp's directly visible pixels that are clipped, and of its mirror image's pixels that lie where a
pane mirrors it."""
MOST_GAIN = 30.0
"""Maximum radiance of a lamp, where white is 1; the minimum is `DAZZLING`."""
LEAST_BRIGHT = 0.8
"""Minimum share of the pixels in which a pane mirrors a lamp that are bright enough for one."""
IMAGE_BRIGHTNESS = 0.5
"""Minimum sRGB value of the darkest channel of a lamp's mirror image; white objects have darker ones."""
LAMP_RIM = 0.012
"""Distance from its expected position within which a mirror image is searched for, as a share of the image width."""
FEWEST_SEEN = 0.3
"""Minimum sum of a Gaussian's blending weights over the pixels of all photographs, for a decision."""


class Lamps(NamedTuple):
    """Lamps that panes mirror.

    images [N] bool: primary Gaussians behind the panes that represent their mirror images; gains [N]: factors on the
    radiance of primary Gaussians in reflections, 1 for all but lamps.
    """

    images: Tensor
    gains: Tensor


@torch.no_grad()
def mirrored_lamps(scene: Scene, panes: Planes, photographs: Sequence[Photograph], *, renderer: Planar) -> Lamps | None:
    """Lamps mirrored by panes of glass, with the radiance of their reflections; None if there are none.

    A photograph does not show how much brighter than white a lamp is, but its reflection, a few percent as bright,
    does. The first scene has built this reflection as Gaussians behind the glass, where they stay because they explain
    the photographs. So lamps are Gaussians that are clipped wherever they are seen directly, and too bright for a
    reflection of white wherever a pane mirrors them. Gaussians behind the pane that are seen only where it mirrors a
    lamp are its mirror image.

    The photographs are downscaled training views, and the renderer is that of the finished scene.
    """
    alone, renderer = replace(scene, planes=panes), replace(renderer, nearest_only=True)
    lamps = _detect_lamps(alone, photographs, renderer)
    if not bool(lamps.any()):
        return None
    lit = [_lit_pixels(alone, lamps, photograph.camera) for photograph in photographs]
    images = _lamp_images(alone, lit, photographs)
    if not bool(images.any()):
        return None
    dark = torch.full_like(scene.primary.logit_opacities, logit(1e-3))
    opacities = torch.where(images, torch.minimum(dark, scene.primary.logit_opacities), scene.primary.logit_opacities)
    without = replace(alone, primary=scene.primary.with_tensors({"logit_opacities": opacities}))
    return Lamps(images, torch.where(lamps, _lamp_gains(without, lit, photographs, renderer), 1))


def _detect_lamps(scene: Scene, photographs: Sequence[Photograph], renderer: Planar) -> Tensor:
    """[N] bool: Gaussians that are clipped where seen directly, and brighter than white where mirrored."""
    decode, _ = blend_conversions(renderer.blend)
    clipped, direct, bright, mirrored = scene.primary.means.new_zeros(4, len(scene.primary))
    for photograph in photographs:
        strength = renderer(scene, photograph.camera).layers["strength"]
        past, through = photograph.valid & (strength <= 0), photograph.valid & (strength > 0)
        darkest = photograph.pixels.amin(dim=-1)
        shown = gather_pixels(scene, photograph.camera, torch.stack([past & photograph.clipped, past], dim=-1).float())
        enough = decode(darkest.clamp(0, 1)) > DAZZLING * strength
        lit = torch.stack([through & enough, through], dim=-1).float()
        there = gather_mirrored_pixels(scene, photograph.camera, lit)
        clipped, direct = clipped + shown[:, 0], direct + shown[:, 1]
        bright, mirrored = bright + there[:, 0], mirrored + there[:, 1]
    enough_seen = (direct > FEWEST_SEEN) & (mirrored > FEWEST_SEEN)
    return enough_seen & (clipped > LAMP_SHARE * direct) & (bright > LEAST_BRIGHT * mirrored)


class LitPixels(NamedTuple):
    """[H, W] bool each: pixels of a view that show a pane, and those in which it mirrors mostly lamps."""

    glass: Tensor
    lit: Tensor


def _lit_pixels(scene: Scene, lamps: Tensor, camera: Camera) -> LitPixels:
    """The lit pixels of a view, for lamps [N] bool."""
    sh = torch.zeros_like(scene.primary.sh)
    sh[:, 0] = (lamps.float()[:, None] - 0.5) / SH_ZERO
    painted = replace(scene.primary.with_tensors({"sh": sh}), active_sh_degree=0)
    frame = Planar(intensity=False, nearest_only=True)(replace(scene, primary=painted), camera)
    glass = frame.layers["strength"] > 0
    return LitPixels(glass, glass & (frame.layers["reflection"].amin(dim=-1) > 0.5))


def _lamp_images(scene: Scene, seen: Sequence[LitPixels], photographs: Sequence[Photograph]) -> Tensor:
    """[N] bool: bright Gaussians behind the panes that are seen mostly where these mirror lamps."""
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


def _lamp_gains(scene: Scene, seen: Sequence[LitPixels], photographs: Sequence[Photograph], renderer: Planar) -> Tensor:
    """[N] ratios of the radiance that photographs leave to reflections of lamps to the rendered one; 1 if unseen."""
    decode, _ = blend_conversions(renderer.blend)
    observed, rendered = scene.primary.means.new_zeros(2, len(scene.primary))
    for photograph, (_, lit) in zip(photographs, seen, strict=True):
        layers = renderer(scene, photograph.camera).layers
        strength = layers["strength"].clamp(min=1e-2)[..., None]
        behind = decode(layers["transmission"].clamp(0, 1))
        radiance = (decode(photograph.pixels.clamp(0, 1)) - (1 - strength) * behind) / strength
        values = torch.stack([radiance.clamp(min=0), decode(layers["reflection"].clamp(min=0))]).mean(dim=-1)
        sums = gather_mirrored_pixels(scene, photograph.camera, (values * (lit & photograph.valid)).movedim(0, -1))
        observed, rendered = observed + sums[:, 0], rendered + sums[:, 1]
    gains = (observed / rendered.clamp(min=1e-6)).clamp(1, MOST_GAIN)
    return torch.where(rendered > 0, gains, 1)


HOLE_COVERAGE = 0.5
"""Coverage of the mirrored image below which it counts as a hole."""
HOLE_CAMERAS, RAYS_ACROSS, CELLS_ACROSS = 24, 40, 40
"""Number of cameras that find holes, of rays across an image, and of cells across the room, with one position each."""
SHARE_BEYOND_ROOM = 0.05
"""Share of the Gaussians that are farther from the middle of the cameras than the end of the room."""


class UnseenPositions(NamedTuple):
    """Positions [P, 3] that panes mirror and no photograph shows, their likely colour [3], sRGB, and their spacing."""

    positions: Tensor
    color: Tensor
    cell: float


@torch.no_grad()
def unseen_positions(scene: Scene, panes: Planes, cameras: Sequence[Camera]) -> UnseenPositions:
    """Positions at the end of the room that panes mirror and that no Gaussian covers.

    A pane always mirrors something. Where its image is dark for lack of Gaussians, the transmission is too bright.

    Args:
        scene: with the panes.
        panes: of glass.
        cameras: of the photographs; a subset of them is used.
    """
    device = scene.primary.means.device
    cameras = [camera.to(device) for camera in sample_evenly(cameras, HOLE_CAMERAS)]
    middle = torch.stack([camera.center for camera in cameras]).mean(dim=0)
    away = (scene.primary.means - middle).norm(dim=1).sort().values
    radius = away[int((1 - SHARE_BEYOND_ROOM) * (len(away) - 1))]
    positions, colors = [], [torch.zeros(0, 3, device=device, dtype=torch.float32)]
    for camera in cameras:
        for row in range(len(panes)):
            pane = panes.select([row])
            image = mirrored_image(replace(scene, planes=pane), camera)
            colors.append(image.color[image.seen & (image.coverage > LEAST_COVERAGE)].clamp(0, 1))
            positions.append(_ends_of_rays(pane, camera, image.seen & (image.coverage < HOLE_COVERAGE), middle, radius))
    found, known = torch.cat(positions), torch.cat(colors)
    # In the axes of a camera, so that the result does not depend on the orientation of the world.
    size = 2 * radius / CELLS_ACROSS
    cells = ((found - middle) @ cameras[0].cam_from_world[:3, :3].T / size).floor().long()
    _, cell = torch.unique(cells, dim=0, return_inverse=True)
    first = torch.full_like(cell, len(found)).scatter_reduce_(0, cell, torch.arange(len(found), device=device), "amin")
    color = known.mean(dim=0) if len(known) else known.new_full((3,), 0.5)
    return UnseenPositions(found[first[first < len(found)]], color, float(size))


def _ends_of_rays(pane: Planes, camera: Camera, hole: Tensor, middle: Tensor, radius: Tensor) -> Tensor:
    """[P, 3] points where rays through pixels of a hole [H, W], mirrored by the pane, leave a sphere."""
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
