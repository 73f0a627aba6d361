"""Changes of the set of Gaussians: clone, split and prune (3DGS), relocate (3DGS-MCMC), and opacity perturbation.

Every change is an `Edit`: for each row of the new set the old row it comes from, whether it is a new Gaussian, and
the tensors in which it differs from that old row. Strategies build edits and `apply_edit` carries them out.

In MCMC nothing is cloned, split or pruned by thresholds on gradients. Dead Gaussians are relocated onto live ones, a
few new ones are added in the same way, and noise on the positions lets the transparent ones explore.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from glassplat.captures.view import PointCloud
from glassplat.kernels.screen_statistics import Sums, Views, add_views
from glassplat.kernels.trace.bvh import morton_codes
from glassplat.scene import SH_ZERO, logit
from glassplat.scene.camera import rotation_from_quat
from glassplat.scene.gaussians import DISC_SCALES, Gaussians
from glassplat.training.options import DefaultDensify, McmcDensify

NEIGHBOURS = 3
"""Number of nearest points whose mean distance is the size of a first Gaussian (3DGS)."""
SMALLEST_SCALE = 1e-6
"""Minimum standard deviation, as a share of the cloud's size, for coinciding points."""
DARKEST = 0.25
"""Minimum colour of a point, of 255: a channel that starts at 0 would get no gradient."""


def gaussians_from_points(
    points: PointCloud, *, sh_degree: int = 3, opacity: float = 0.1, spread: float = 1.0
) -> Gaussians:
    """One isotropic Gaussian for every point, in Morton order, so that neighbours in space are neighbours in memory.

    The standard deviation is `spread` times the mean distance to the three nearest points, the constant SH coefficient
    reproduces the point's colour (0 as `DARKEST`), all other coefficients are zero. The channel `log_intensity` starts
    at zero (intensity one).

    Args:
        points: at least one.
        sh_degree: highest degree to make room for, 0 to 3; degree 0 is active.
        opacity: of every Gaussian, in (0, 1).
        spread: standard deviation as a share of that distance, positive.

    Raises:
        ValueError: no points, a position that is not finite, or an argument out of range.
    """
    if not len(points):
        raise ValueError("there are no points to start from; expected at least one")
    if not torch.isfinite(points.positions).all():
        count = int((~torch.isfinite(points.positions)).any(dim=1).sum())
        raise ValueError(f"{count} of {len(points)} points are not finite; remove them first")
    if not 0 <= sh_degree <= 3 or not 0 < opacity < 1:
        raise ValueError(f"sh_degree is {sh_degree} and opacity {opacity}; expected 0..3 and a number between 0 and 1")
    if not spread > 0:
        raise ValueError(f"spread is {spread}; expected a positive share of the distance between points")
    # In float64, to avoid rounding of the cloud's size.
    order = morton_order(points.positions.double()).source
    means = points.positions[order]
    count, device = len(points), means.device
    sh = torch.zeros(count, (sh_degree + 1) ** 2, 3, device=device, dtype=torch.float32)
    sh[:, 0] = (points.colors[order].float().clamp(min=DARKEST) / 255 - 0.5) / SH_ZERO
    return Gaussians(
        means=means,
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0], device=device, dtype=torch.float32).repeat(count, 1),
        log_scales=torch.log(spread * _spacing(means)).float()[:, None].repeat(1, 3),
        logit_opacities=torch.full((count,), logit(opacity), device=device, dtype=torch.float32),
        sh=sh,
        channels={"log_intensity": torch.zeros(count, device=device, dtype=torch.float32)},
        active_sh_degree=0,
    )


def as_discs(spheres: Gaussians, *, seed: int = 0) -> Gaussians:
    """Discs as large as the spheres, with random orientations, as the surface is not known yet."""
    generator = torch.Generator().manual_seed(seed)
    quats = torch.randn(spheres.quats.shape, generator=generator, dtype=torch.float32).to(spheres.quats)
    log_scales = spheres.log_scales[:, :DISC_SCALES].contiguous()
    return replace(spheres, quats=torch.nn.functional.normalize(quats, dim=1), log_scales=log_scales)


def _spacing(means: Tensor) -> Tensor:
    """[P] float64 mean distance to the nearest other points, with a floor; 1 for a single point."""
    positions = means.double().numpy()
    neighbours = min(NEIGHBOURS, len(positions) - 1)
    extent = float(np.linalg.norm(positions.max(axis=0) - positions.min(axis=0))) or 1.0
    if neighbours == 0:
        return torch.full((1,), extent, dtype=torch.float64)
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(positions).query(positions, k=neighbours + 1)
    return torch.from_numpy(np.maximum(distances[:, 1:].mean(axis=1), SMALLEST_SCALE * extent))


def morton_order(means: Tensor) -> Edit:
    """The edit that sorts Gaussians at `means` [N, 3] into Morton order; equal positions keep their order.

    A tile of an image fetches Gaussians that are close in space, so cache lines and wide loads are used better.
    """
    source = torch.argsort(morton_codes(means), stable=True)
    return Edit(source, torch.zeros_like(source, dtype=torch.bool))


Moments = dict[str, tuple[Tensor, Tensor]]
"""Adam's first and second moment by dotted parameter name (`primary.means`), shaped like the parameter."""


@dataclass(frozen=True)
class Edit:
    """Recipe for making a new set of M Gaussians from an old one.

    Attributes:
        source: [M] int64 row of the old set that each new row copies.
        fresh: [M] bool; true where the row is a new Gaussian, whose moments start at zero.
        replaced: tensors whose values differ from the copies, by name, one row per new Gaussian.
    """

    source: Tensor
    fresh: Tensor
    replaced: Mapping[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name, tensor in {"fresh": self.fresh, **self.replaced}.items():
            if tensor.shape[0] != len(self):
                raise ValueError(
                    f"{name} has {tensor.shape[0]} rows where source has {len(self)}; expected one per new Gaussian"
                )

    def __len__(self) -> int:
        return self.source.shape[0]

    def edited_tensor(self, gaussians: Gaussians, name: str) -> Tensor:
        """The tensor `name` of the new set, without making the rest of it."""
        return self.replaced[name] if name in self.replaced else gaussians.tensors()[name][self.source]

    def then(self, following: Edit) -> Edit:
        """This edit and, on its result, `following`, as one edit of the original set."""
        replaced = {name: tensor[following.source] for name, tensor in self.replaced.items()}
        fresh = self.fresh[following.source] | following.fresh
        return Edit(self.source[following.source], fresh, replaced | dict(following.replaced))


def keep(mask: Tensor) -> Edit:
    """Keeps the Gaussians where `mask` [N] is true, in their order."""
    source = mask.nonzero().squeeze(1)
    return Edit(source, torch.zeros_like(source, dtype=torch.bool))


def clone(count: int, index: Tensor) -> Edit:
    """Keeps all `count` Gaussians and appends a copy of each one in `index` [I]."""
    everything = torch.arange(count, device=index.device)
    source = torch.cat([everything, index])
    return Edit(source, torch.arange(source.shape[0], device=index.device) >= count)


LEAST_OBSTRUCTING_OPACITY = 0.1
"""Opacity of a Gaussian at a camera's position above which it is removed."""
FREE_SHARE, SURFACE_POINTS = 0.15, 3
"""Gaussians closer to a camera than this share of the distance to its third nearest SfM point are in mid-air."""
LARGE_SHARE = 0.4
"""Gaussians longer than this share of the distance to the nearest camera are large for it."""


@torch.no_grad()
def gaussians_near_cameras(gaussians: Gaussians, positions: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
    """[N] bool each: Gaussians that obstruct the view from one of the positions, and suspicious ones.

    A Gaussian is drawn if its centre is in front of the camera. One that surrounds the cameras is therefore drawn in
    some views and not in others: it may be visible to two cameras only in a pane, and cover the whole image of a
    third. Discs have no volume and obstruct nothing.

    Suspicious are Gaussians so close to a camera that no surface can be there: a small one on the camera path is a few
    pixels wide in distant views, where it explains noise, and covers the image of a camera in between. So are those
    whose longest standard deviation is large for the distance to the nearest camera. Their projection is linearised at
    the centre. If a camera sees the centre at a right angle to its axis, the image of such a Gaussian may cover a
    whole view that it does not reach in space.

    Args:
        gaussians: the set.
        positions: [P, 3] positions of cameras.
        points: [M, 3] SfM points; with fewer than three, nothing counts as too close.
    """
    means, longest = gaussians.means, gaussians.log_scales.amax(dim=1).exp()
    obstructing, floating = torch.zeros(2, len(gaussians), dtype=torch.bool, device=means.device)
    nearest, points = torch.full_like(longest, math.inf), points.to(means)
    reach = math.sqrt(-2 * math.log(LEAST_OBSTRUCTING_OPACITY)) * longest
    for position in positions.to(means):
        distance = (means - position).norm(dim=1)
        nearest = torch.minimum(nearest, distance)
        if len(points) >= SURFACE_POINTS:
            surface = (points - position).norm(dim=1).topk(SURFACE_POINTS, largest=False).values[-1]
            floating |= distance < FREE_SHARE * surface
        if not gaussians.are_discs:
            close = (distance < reach).nonzero().squeeze(1)
            obstructing[close] |= _opacities_at(gaussians.select(close), position) > LEAST_OBSTRUCTING_OPACITY
    return obstructing, floating | (longest > LARGE_SHARE * nearest)


def _opacities_at(ellipsoids: Gaussians, position: Tensor) -> Tensor:
    """[N] opacity of each Gaussian at a position [3]."""
    offset = (position - ellipsoids.means)[:, None] @ rotation_from_quat(ellipsoids.quats)
    squared = (offset.squeeze(1) / ellipsoids.log_scales.exp()).square().sum(dim=1)
    return torch.sigmoid(ellipsoids.logit_opacities) * torch.exp(-squared / 2)


CHILDREN = 2
"""Gaussians that replace one that is split."""
SHRINK = 1.6
"""Factor by which their axes are shorter."""


@torch.no_grad()
def split(gaussians: Gaussians, index: Tensor, *, generator: torch.Generator) -> Edit:
    """Replaces each Gaussian in `index` [I] by smaller ones drawn from it (3DGS, Section 5.2).

    The survivors come first, in their order; then the first child of every parent and the second of every parent.

    Args:
        gaussians: the set that is edited.
        index: rows to split, each at most once.
        generator: source of the children's positions, on the device of `gaussians`.
    """
    count = len(gaussians)
    survives = torch.ones(count, dtype=torch.bool, device=index.device)
    survives[index] = False
    parents = index.repeat(CHILDREN)
    source = torch.cat([survives.nonzero().squeeze(1), parents])
    fresh = torch.arange(source.shape[0], device=index.device) >= count - index.shape[0]

    means, log_scales = gaussians.means[source], gaussians.log_scales[source]
    # Offsets from the centre that are distributed as the Gaussian.
    deviations = gaussians.deviations[parents]
    unit = torch.randn(deviations.shape, generator=generator, dtype=deviations.dtype, device=deviations.device)
    turn = rotation_from_quat(gaussians.quats[parents])
    means[fresh] += (turn @ (unit * deviations)[..., None]).squeeze(-1)
    log_scales[fresh] -= math.log(SHRINK)
    return Edit(source, fresh, {"means": means, "log_scales": log_scales})


@torch.no_grad()
def apply_edit(
    gaussians: Gaussians, moments: Moments, edit: Edit, *, part: str = "primary"
) -> tuple[Gaussians, Moments]:
    """The edited Gaussians and moments, without gradients; the arguments are not modified.

    Args:
        gaussians: the set that is edited.
        moments: moments of any number of parameters; those of other scene parts pass through as they are, and a tensor
            without moments (not trained yet) keeps none.
        edit: what to do.
        part: the scene part that `gaussians` is, first half of the names in `moments`.
    """
    edited = gaussians.with_tensors({name: edit.edited_tensor(gaussians, name) for name in gaussians.tensors()})

    def rows_of(moment: Tensor) -> Tensor:
        rows = moment[edit.source]
        rows[edit.fresh] = 0
        return rows

    owned = {f"{part}.{name}" for name in gaussians.tensors()}
    return edited, {name: (rows_of(m), rows_of(v)) if name in owned else (m, v) for name, (m, v) in moments.items()}


@torch.no_grad()
def append(gaussians: Gaussians, moments: Moments, new: Gaussians) -> tuple[Gaussians, Moments]:
    """The primary Gaussians followed by `new` ones with the same tensors, whose moments are zero."""
    old_tensors, new_tensors = gaussians.tensors(), new.tensors()
    joined = gaussians.with_tensors({name: torch.cat([old_tensors[name], new_tensors[name]]) for name in old_tensors})

    def extended(name: str, moment: Tensor) -> Tensor:
        return torch.cat([moment, torch.zeros_like(new_tensors[name.removeprefix("primary.")])])

    owned = {f"primary.{name}" for name in old_tensors}
    return joined, {
        name: (extended(name, m), extended(name, v)) if name in owned else (m, v) for name, (m, v) in moments.items()
    }


@torch.no_grad()
def zero_moments(moments: Moments, names: Collection[str], rows: Tensor | None = None) -> Moments:
    """The moments with those of some parameters zeroed, because their values were replaced.

    Args:
        moments: moments by dotted parameter name.
        names: dotted names of the replaced parameters; names without moments are passed over.
        rows: boolean mask or indices of the replaced rows; all rows if None.
    """

    def cleared(moment: Tensor) -> Tensor:
        remaining = moment.clone()
        remaining[... if rows is None else rows] = 0
        return remaining

    return {name: (cleared(m), cleared(v)) if name in names else (m, v) for name, (m, v) in moments.items()}


class ScreenStatistics(Sums):
    """Statistics of each Gaussian over the views since the last densification.

    Gradients are in normalised device coordinates, in which the image spans [-1, 1], so that thresholds do not depend
    on the resolution. Sums and counts have two rows, over all views and over those that see the Gaussian directly.
    Mirror images are averaged separately, and the larger mean counts; a joint mean would be too small, because objects
    are farther away in a mirror, or are seen directly only from afar. The divisor for mirror images is at least the
    number of direct views, since reflections in glass are weak.

    Attributes:
        gradient_sum: [2, N] sum over views of the norm of the loss gradient with respect to the centre on screen.
        absgrad_sum: [2, N] the same for the sum of absolute per-pixel contributions.
        view_count: [2, N] number of views that saw the Gaussian, with the weights of `ScreenPass`. A pane reduces
            gradients by the share of the light that it leaves; with a weight of 1, weak reflections would never be
            densified.
    """

    @staticmethod
    def zeros(count: int, *, device: torch.device | str = "cpu") -> ScreenStatistics:
        """Empty statistics of `count` Gaussians."""
        return ScreenStatistics(*torch.zeros(3, 2, count, device=device, dtype=torch.float32))

    def select(self, kept: Tensor) -> ScreenStatistics:
        """The rows where `kept` [N] is true."""
        return ScreenStatistics(*(sums[:, kept] for sums in self))

    def with_empty_rows(self, count: int) -> ScreenStatistics:
        """The rows, followed by `count` empty ones."""
        return ScreenStatistics(*(torch.nn.functional.pad(sums, (0, count)) for sums in self))

    def add(self, views: Views) -> None:
        """Adds the views of one training step, in place."""
        add_views(self, views)

    @torch.no_grad()
    def add_traced(self, means_gradient: Tensor, ray_weights: Tensor) -> None:
        """Adds a training step with ray tracing, in place (EnvGS, Section 5.1).

        The gradient times half the distance corresponds to a screen gradient in normalised device coordinates; without
        this factor, distant parts would get too few Gaussians.

        Args:
            means_gradient: [N, 3] gradient of one view's loss with respect to the centres.
            ray_weights: [N, 2] contributions to the rays: the sums of blending weights, and of weights times distances
                in world units.
        """
        weights, products = ray_weights.unbind(dim=1)
        norms = means_gradient.norm(dim=-1)
        equivalents = 0.5 * torch.where(weights > 0, products / weights, 0) * norms
        self.gradient_sum.add_(equivalents)
        self.absgrad_sum.add_(equivalents)
        self.view_count.add_(norms > 0)

    def merge(self, other: ScreenStatistics) -> None:
        """Adds statistics of the same Gaussians from other views, in place."""
        for total, added in zip(self, other, strict=True):
            total += added

    @property
    def mean_gradient(self) -> Tensor:
        """[N] the larger of two mean gradient norms, 0 if no view saw the Gaussian: over direct views, and over mirror
        images, as many of these as there are direct views at least.
        """
        return self._mean(self.gradient_sum)

    @property
    def mean_absgrad(self) -> Tensor:
        """[N] mean norm of the absolute gradient over the views that saw the Gaussian, as `mean_gradient`."""
        return self._mean(self.absgrad_sum)

    def _mean(self, total: Tensor) -> Tensor:
        (over_all, direct), (views, direct_views) = total, self.view_count
        mirrored, images = over_all - direct, torch.maximum(views - direct_views, direct_views)
        return torch.maximum(direct / direct_views.clamp(min=1), mirrored / images.clamp(min=1))


@torch.no_grad()
def densify(
    options: DefaultDensify,
    gaussians: Gaussians,
    moments: Moments,
    statistics: ScreenStatistics,
    *,
    extent: float,
    generator: torch.Generator,
    part: str = "primary",
    prune_large: bool = False,
) -> tuple[Gaussians, Moments]:
    """A set of Gaussians and their moments after cloning, splitting and pruning.

    Statistics start again at `ScreenStatistics.zeros` afterwards.

    Args:
        options: thresholds and times.
        gaussians: the set to edit.
        moments: optimiser moments by dotted name; those of other parts pass through.
        statistics: statistics since the last call, one row per Gaussian.
        extent: radius of the capture in world units.
        generator: source of randomness, on the device of `gaussians`.
        part: the scene part that `gaussians` is.
        prune_large: also remove oversized Gaussians, as 3DGS does after the first opacity reset.
    """
    if statistics.view_count.shape[1] != len(gaussians):
        raise ValueError(
            f"statistics hold {statistics.view_count.shape[1]} columns for {len(gaussians)} Gaussians; "
            "start new statistics whenever the set has changed"
        )
    large = gaussians.log_scales.amax(dim=1) > math.log(options.dense_fraction * extent)
    scores = statistics.mean_gradient / options.gradient_threshold
    if options.split_by == "absgrad":
        scores = torch.where(large, statistics.mean_absgrad / options.absgrad_threshold, scores)
    chosen = _select_to_grow(options, scores)
    after_split = split(gaussians, (chosen & large).nonzero().squeeze(1), generator=generator)
    # Unsplit rows moved forward by the number of split rows before them.
    row_after_split = (~(chosen & large)).cumsum(dim=0) - 1
    grown = after_split.then(clone(len(after_split), row_after_split[chosen & ~large]))
    pruned = torch.sigmoid(grown.edited_tensor(gaussians, "logit_opacities")) < options.prune_opacity
    if prune_large:
        longest = grown.edited_tensor(gaussians, "log_scales").amax(dim=1)
        pruned |= longest > math.log(options.prune_scale_fraction * extent)
    return apply_edit(gaussians, moments, grown.then(keep(~pruned)), part=part)


def _select_to_grow(options: DefaultDensify, scores: Tensor) -> Tensor:
    """[N] bool: Gaussians to clone or split, whose need is at least 1; with a cap, those with the largest need."""
    chosen = scores >= 1
    if options.cap is None:
        return chosen
    room = max(options.cap - scores.shape[0], 0)
    order = torch.where(chosen, scores, -1).argsort(descending=True, stable=True)
    selected = torch.zeros_like(chosen)
    selected[order[:room]] = True
    return chosen & selected


@torch.no_grad()
def reset_opacity(
    gaussians: Gaussians, moments: Moments, *, ceiling: float = 0.01, part: str = "primary"
) -> tuple[Gaussians, Moments]:
    """Lowers every opacity to at most `ceiling` and zeroes the moments of opacities (3DGS, Section 5.2). Opacities
    that the photographs support grow back; the other Gaussians are pruned.
    """
    lowered = gaussians.logit_opacities.clamp(max=logit(ceiling))
    return gaussians.with_tensors({"logit_opacities": lowered}), zero_moments(moments, (f"{part}.logit_opacities",))


DEAD_OPACITY = 0.005
"""Maximum opacity of Gaussians to relocate."""
NOISE_SHARPNESS = 100.0
"""Steepness of the noise's decline above that opacity."""
MOST_COPIES = 51
"""Maximum number of Gaussians at one position, for which the sum of `shared_contribution` is exact."""
MOST_LOGIT = 16.0
"""Opacity 1 - 1e-7, the limit of float32. The terms of the alternating sum grow with the logit."""


@torch.no_grad()
def relocate_and_grow(
    options: McmcDensify, gaussians: Gaussians, moments: Moments, *, cap: int, generator: torch.Generator
) -> tuple[Gaussians, Moments]:
    """A set of Gaussians and their moments after relocation and growth, which change renders very little.

    Moments are zeroed for moved and new rows, and for the live ones at their new positions, whose opacity and size
    changed.

    Args:
        options: thresholds and times.
        gaussians: the primary ones.
        moments: optimiser moments by dotted name; those of other parts pass through.
        cap: maximum number of Gaussians; a larger set does not shrink.
        generator: source of randomness, on the device of `gaussians`.
    """
    relocated, moments = apply_edit(gaussians, moments, relocate(gaussians, generator))
    return apply_edit(relocated, moments, grow(options, relocated, cap, generator))


def relocate(gaussians: Gaussians, generator: torch.Generator) -> Edit:
    """Moves every dead Gaussian onto a live one, drawn with a probability proportional to its opacity.

    Without live ones, nothing moves; if more than `MOST_COPIES` would share a position, the surplus stays dead.
    """
    live = _is_live(gaussians)
    dead = (~live).nonzero().squeeze(1)
    targets = sample_by_opacity(gaussians, live, dead.shape[0], generator)
    fits = rank_among_equals(targets) < MOST_COPIES - 1
    source = torch.arange(len(gaussians), device=dead.device)
    source[dead[: targets.shape[0]][fits]] = targets[fits]
    return share_among_copies(gaussians, source)


def grow(options: McmcDensify, gaussians: Gaussians, cap: int, generator: torch.Generator) -> Edit:
    """Appends new Gaussians up to the growth factor and the cap, placed as relocated ones are."""
    count = len(gaussians)
    # Rounded up, so that small sets can grow.
    room = max(min(cap, math.ceil(options.growth * count)) - count, 0)
    targets = sample_by_opacity(gaussians, _is_live(gaussians), room, generator)
    targets = targets[rank_among_equals(targets) < MOST_COPIES - 1]
    return share_among_copies(gaussians, torch.cat([torch.arange(count, device=targets.device), targets]))


@torch.no_grad()
def sgld_noise(
    options: McmcDensify, gaussians: Gaussians, *, rate: float, extent: float, generator: torch.Generator
) -> Tensor:
    """[N, 3] offsets of the centres in world units: the noise term of the paper's Langevin dynamics.

    noise_rate * rate * sigmoid(-100 (opacity - 0.005)) * covariance @ eta, eta standard normal.
    The published factor multiplies an area by a rate that is a length, both in world units (`noise_units`), and so
    depends on the capture's; else both are in scene extents, which is the same where the extent is one.

    Args:
        options: amplitude and units of the noise.
        gaussians: the set whose centres are moved.
        rate: learning rate of the positions per scene extent, as it stands at this step.
        extent: radius of the capture in world units.
        generator: source of randomness, on the device of `gaussians`.
    """
    shape, dtype = gaussians.means.shape, gaussians.means.dtype
    unit = torch.randn(shape, generator=generator, dtype=dtype, device=gaussians.means.device)
    rotations = rotation_from_quat(gaussians.quats)
    variances = gaussians.deviations.square()
    along_axes = (rotations.transpose(1, 2) @ unit[..., None]).squeeze(-1) * variances
    directions = (rotations @ along_axes[..., None]).squeeze(-1)
    directions = directions * extent if options.noise_units == "world" else directions / extent
    opacities = torch.sigmoid(gaussians.logit_opacities)
    gate = torch.sigmoid(-NOISE_SHARPNESS * (opacities - DEAD_OPACITY))
    return options.noise_rate * rate * gate[:, None] * directions


def _is_live(gaussians: Gaussians) -> Tensor:
    """[N] bool: Gaussians that are opaque enough to stay."""
    return torch.sigmoid(gaussians.logit_opacities) > DEAD_OPACITY


def sample_by_opacity(gaussians: Gaussians, live: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """[count] rows drawn with replacement, in proportion to their opacity; none at all if `live` [N] is all false."""
    rows = live.nonzero().squeeze(1)
    if not rows.shape[0]:
        return rows
    cumulative = torch.sigmoid(gaussians.logit_opacities[rows].double()).cumsum(dim=0)
    unit = torch.rand(count, generator=generator, dtype=torch.float64, device=rows.device)
    # A product rounded up to the total would give an index past the last row.
    found = torch.searchsorted(cumulative, unit * cumulative[-1], right=True).clamp(max=rows.shape[0] - 1)
    return rows[found]


def rank_among_equals(values: Tensor) -> Tensor:
    """[I] number of equal values before each one in `values` [I]."""
    ordered, order = values.sort(stable=True)
    ranks = torch.empty_like(values)
    ranks[order] = torch.arange(values.shape[0], device=values.device) - torch.searchsorted(ordered, ordered)
    return ranks


def share_among_copies(gaussians: Gaussians, source: Tensor) -> Edit:
    """The edit in which new rows copy the rows `source` [M], and copies of a row share its contribution."""
    copies = torch.bincount(source, minlength=len(gaussians))[source]
    shared = copies > 1
    logit_opacities, log_scales = gaussians.logit_opacities[source], gaussians.log_scales[source]
    opacities, shrink = shared_contribution(logit_opacities[shared], copies[shared])
    logit_opacities[shared] = opacities
    log_scales[shared] += shrink[:, None]
    return Edit(source, shared, {"logit_opacities": logit_opacities, "log_scales": log_scales})


def shared_contribution(logit_opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and size with which N copies at one position render like the Gaussian they replace (3DGS-MCMC).

    The opacity o' satisfies 1 - (1 - o')^N = o, so that the centre stays as opaque. The size keeps the integral of
    the composited profile sum_i o' G (1 - o' G)^(i-1) along a line through the centre: sigma' / sigma is o over
    sum_{i=1..N} sum_{k<i} binom(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1). Summed over i first, the binomials become
    binom(N, j) with j = k + 1, which leaves one sum.

    Args:
        logit_opacities: [I] raw opacities of the Gaussians that are replaced.
        copies: [I] int64 number N of Gaussians at the place, 1 to `MOST_COPIES`.

    Returns:
        Raw opacities [I] of the copies, and [I] what to add to their log scales.
    """
    # log(1 - o) is -softplus of the logit, without the cancellation of forming 1 - o.
    depth = torch.nn.functional.softplus(logit_opacities.double().clamp(max=MOST_LOGIT))
    each = depth / copies
    opacities = -torch.expm1(-each)
    coefficients = _profile_coefficients().to(copies.device)[copies]
    integral = torch.zeros_like(opacities)
    for column in reversed(range(MOST_COPIES)):
        integral = (integral + coefficients[:, column]) * opacities
    shrink = torch.log(-torch.expm1(-depth)) - torch.log(integral)
    return (torch.log(opacities) + each).to(logit_opacities.dtype), shrink.to(logit_opacities.dtype)


@cache
def _profile_coefficients() -> Tensor:
    """[MOST_COPIES + 1, MOST_COPIES] float64: entry (N, j - 1) is binom(N, j) (-1)^(j-1) / sqrt(j)."""
    orders = range(1, MOST_COPIES + 1)
    rows = [[math.comb(n, j) * (-1) ** (j - 1) / math.sqrt(j) for j in orders] for n in range(MOST_COPIES + 1)]
    return torch.tensor(rows, dtype=torch.float64)


@torch.no_grad()
def perturb_opacities(
    gaussians: Gaussians, selected: Tensor, *, generator: torch.Generator, amplitude: float, bounds: tuple[float, float]
) -> Gaussians:
    """Adds uniform noise to the opacities of Gaussians visible through a pane.

    If the transmission still contains part of the reflection, the depth and gradient losses are in equilibrium; random
    changes of opacities disturb it.

    Args:
        gaussians: the primary Gaussians.
        selected: [N] bool, those visible through a pane (`crosses_pane`).
        generator: source of the noise, on the device of `gaussians`.
        amplitude: the noise is uniform in [-amplitude, amplitude] and acts on the activated opacity.
        bounds: range the new opacities are clamped to. The paper does not give it; the lower bound
            lies above the pruning threshold and where a Gaussian still gets a gradient, so that
            those that were wrongly lowered can return.

    Returns:
        The Gaussians; the caller has to zero the opacity moments of those selected.
    """
    opacities = torch.sigmoid(gaussians.logit_opacities)
    unit = torch.rand(opacities.shape, generator=generator, dtype=opacities.dtype, device=opacities.device)
    noisy = (opacities + amplitude * (2 * unit - 1)).clamp(*bounds)
    logit_opacities = torch.where(selected, torch.logit(noisy), gaussians.logit_opacities)
    return gaussians.with_tensors({"logit_opacities": logit_opacities})
