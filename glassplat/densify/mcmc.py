"""Densification as sampling: Gaussians move to where others are opaque (3DGS as Markov Chain Monte Carlo, 2024).

Nothing is cloned, split or pruned by thresholds on gradients. Dead Gaussians are relocated onto live ones, a few new
ones are added in the same way, and noise on the positions lets the transparent ones explore.
"""

from __future__ import annotations

import math
from functools import cache

import torch
from torch import Tensor

from glassplat.densify.edit import Edit, Moments, apply_edit
from glassplat.densify.options import McmcDensify
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.pose import rotation_from_quat

MOST_COPIES = 51
"""Gaussians that may share one place, the first one included; the sum of `shared_contribution` is exact up to here."""
MOST_LOGIT = 16.0
"""Opacity 1 - 1e-7, all that float32 tells from 1. The terms of the alternating sum grow with the logit."""


@torch.no_grad()
def resampled(
    options: McmcDensify,
    gaussians: Gaussians,
    moments: Moments,
    *,
    cap: int,
    generator: torch.Generator,
    part: str = "primary",
) -> tuple[Gaussians, dict[str, tuple[Tensor, Tensor]]]:
    """A set of Gaussians and their moments after relocation and growth; what it renders stays nearly the same.

    The moments are zeroed for every row that moved or is new, and for the live ones they were placed on, whose
    opacity and size changed.

    Args:
        options: when and how.
        gaussians: the set to edit.
        moments: optimiser moments by dotted name; those of other parts pass through.
        cap: largest number of Gaussians to grow to; a set that is larger stays as large.
        generator: source of randomness, on the device of `gaussians`.
        part: the scene part that `gaussians` is.
    """
    relocated, moments = apply_edit(gaussians, moments, relocation(options, gaussians, generator), part=part)
    return apply_edit(relocated, moments, addition(options, relocated, cap, generator), part=part)


def relocation(options: McmcDensify, gaussians: Gaussians, generator: torch.Generator) -> Edit:
    """Moves every dead Gaussian onto a live one, drawn with a probability proportional to its opacity.

    Without live ones nothing moves; where more than `MOST_COPIES` would share a place, the surplus stays dead.
    """
    live = _live(options, gaussians)
    dead = (~live).nonzero().squeeze(1)
    targets = drawn_by_opacity(gaussians, live, dead.shape[0], generator)
    fits = rank_among_equals(targets) < MOST_COPIES - 1
    source = torch.arange(len(gaussians), device=dead.device)
    source[dead[: targets.shape[0]][fits]] = targets[fits]
    return shared_among_copies(gaussians, source)


def addition(options: McmcDensify, gaussians: Gaussians, cap: int, generator: torch.Generator) -> Edit:
    """Appends new Gaussians up to the growth factor and the cap, placed as relocated ones are."""
    count = len(gaussians)
    # Rounded up, because a set of a few Gaussians would never grow otherwise.
    room = max(min(cap, math.ceil(options.growth * count)) - count, 0)
    targets = drawn_by_opacity(gaussians, _live(options, gaussians), room, generator)
    targets = targets[rank_among_equals(targets) < MOST_COPIES - 1]
    return shared_among_copies(gaussians, torch.cat([torch.arange(count, device=targets.device), targets]))


@torch.no_grad()
def exploring_noise(
    options: McmcDensify, gaussians: Gaussians, *, rate: float, extent: float, generator: torch.Generator
) -> Tensor:
    """[N, 3] offsets of the centres in world units: the noise term of the paper's Langevin dynamics.

    noise_rate * rate * sigmoid(-noise_sharpness (opacity - dead_opacity)) * covariance @ eta, eta standard normal.
    The published factor multiplies an area by a rate that is a length, both in world units (`noise_units`), and so
    depends on the capture's; else both are in scene extents, which is the same where the extent is one.

    Args:
        options: how strong it is, and where.
        gaussians: the set whose centres are moved.
        rate: learning rate of the positions per scene extent, as it stands at this step.
        extent: radius of the capture in world units.
        generator: source of randomness, on the device of `gaussians`.
    """
    shape, kind = gaussians.means.shape, gaussians.means.dtype
    unit = torch.randn(shape, generator=generator, dtype=kind, device=gaussians.means.device)
    rotations = rotation_from_quat(gaussians.quats)
    variances = gaussians.deviations.square()
    along_axes = (rotations.transpose(1, 2) @ unit[..., None]).squeeze(-1) * variances
    directions = (rotations @ along_axes[..., None]).squeeze(-1)
    directions = directions * extent if options.noise_units == "world" else directions / extent
    opacities = torch.sigmoid(gaussians.logit_opacities)
    gate = torch.sigmoid(-options.noise_sharpness * (opacities - options.dead_opacity))
    return options.noise_rate * rate * gate[:, None] * directions


def _live(options: McmcDensify, gaussians: Gaussians) -> Tensor:
    """[N] bool: which Gaussians are opaque enough to stay."""
    return torch.sigmoid(gaussians.logit_opacities) > options.dead_opacity


def drawn_by_opacity(gaussians: Gaussians, live: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """[count] rows drawn with replacement, in proportion to their opacity; none at all if `live` [N] is all false."""
    rows = live.nonzero().squeeze(1)
    if not rows.shape[0]:
        return rows
    cumulative = torch.sigmoid(gaussians.logit_opacities[rows].double()).cumsum(dim=0)
    unit = torch.rand(count, generator=generator, dtype=torch.float64, device=rows.device)
    # A product that rounds up to the total would fall behind the last row.
    found = torch.searchsorted(cumulative, unit * cumulative[-1], right=True).clamp(max=rows.shape[0] - 1)
    return rows[found]


def rank_among_equals(values: Tensor) -> Tensor:
    """[I] how many equal values come before each one in `values` [I]."""
    ordered, order = values.sort(stable=True)
    ranks = torch.empty_like(values)
    ranks[order] = torch.arange(values.shape[0], device=values.device) - torch.searchsorted(ordered, ordered)
    return ranks


def shared_among_copies(gaussians: Gaussians, source: Tensor) -> Edit:
    """The edit in which new rows copy the rows `source` [M], and copies of one row share what it contributed."""
    copies = torch.bincount(source, minlength=len(gaussians))[source]
    shared = copies > 1
    logit_opacities, log_scales = gaussians.logit_opacities[source], gaussians.log_scales[source]
    opacities, shrink = shared_contribution(logit_opacities[shared], copies[shared])
    logit_opacities[shared] = opacities
    log_scales[shared] += shrink[:, None]
    return Edit(source, shared, {"logit_opacities": logit_opacities, "log_scales": log_scales})


def shared_contribution(logit_opacities: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and size with which N copies at one place render like the one Gaussian they replace (relocation there).

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
