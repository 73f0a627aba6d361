"""The first panes: a rectangle for every annotated pane (TR-Gaussians, Section III-C1 and Appendix A)."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.panes import PlaneFit, PlaneFitError
from glassplat.panes.masks import (
    FramedPlanes,
    PaneView,
    PlaneEquations,
    agreement_of_each,
    mask_agreement,
    pane_views,
    plane_candidates,
)
from glassplat.panes.objective import MIDDLE, Objective, edge_matches, pane_rectangle
from glassplat.panes.search import Fit, best_plane, best_supported, tilt_uncertainty
from glassplat.scene import logit
from glassplat.scene.camera import Camera
from glassplat.scene.panes import Planes

Array = NDArray[np.float64]
log = logging.getLogger("glassplat.panes")

LEAST_MEETING, LEAST_OF_MEDIAN = 0.3, 0.5
"""A mask does not fit if its outline meets the others by less than this, or by less than this share of the median."""
EDGES_PER_VIEW = 100


def report_masks(label: int, plane: FramedPlanes, views: Sequence[PaneView]) -> None:
    """Logs how well each mask of a pane fits the others on its plane, and warns of those that do not, by name."""
    meeting, overlap = meeting_of_each(plane, views), agreement_of_each(plane.planes, views)
    found = [f"{view.name} {_percent(share)}" for view, share in zip(views, meeting, strict=True)]
    areas = ", ".join(f"{told} ({area:.2f})" for told, area in zip(found, overlap, strict=True))
    log.info("pane %d: outlines of the masks that meet those of the others (and overlap): %s", label, areas)
    odd = odd_ones(meeting).nonzero()[0]
    if len(odd):
        log.warning(
            "pane %d: %d of its %d masks do not fit the others, their outlines hardly meet on any plane: %s; check "
            "that each belongs to its photograph, and that label %d means the same flat pane in it",
            label, len(odd), len(views), ", ".join(found[number] for number in odd), label,
        )  # fmt: skip


def _percent(share: float) -> str:
    return "nothing to compare" if np.isnan(share) else f"{share:.0%}"


def odd_ones(meeting: Array) -> NDArray[np.bool_]:
    """[V] which masks do not fit the others, from what `meeting_of_each` says; all of them may not."""
    known = meeting[~np.isnan(meeting)]
    limit = max(LEAST_MEETING, LEAST_OF_MEDIAN * float(np.median(known))) if len(known) else 0.0
    return np.asarray(meeting < limit)


def meeting_of_each(plane: FramedPlanes, views: Sequence[PaneView]) -> Array:
    """[V] share of each mask's outline that meets those of the others on one plane; NaN where nothing is compared.

    The overlap of the areas does not tell: masks of one pane from elsewhere overlap by half and more, and a post that
    hides half of a pane costs as much. Outlines that are hidden meet nothing, but those of a wrong mask do not either,
    nor do the others meet them.
    """
    views = [_without_shared_edges(view) for view in views]
    tolerance = max(MIDDLE, *(1 / view.diagonal for view in views))
    matches = edge_matches(plane.planes, views, edges_per_view=EDGES_PER_VIEW)
    met = 1 / (1 + matches.residuals(plane.frames, tolerance)[:, 0] ** 2)
    compared = matches.compared[:, 0] & ~np.isnan(met)
    shares = np.full(len(views), np.nan)
    for number in range(len(views)):
        concerned = compared & (matches.sources == number)
        concerned[number] |= compared[number]
        if concerned.any():
            shares[number] = met[concerned].mean()
    return shares


def _without_shared_edges(view: PaneView) -> PaneView:
    """The view without what other panes may hide: no edge between them counts, and no distance is known there."""
    from scipy import ndimage

    beside: NDArray[np.bool_] = ndimage.binary_dilation(view.hidden, iterations=2)
    column, row = np.floor(view.edge).astype(np.int64).T
    kept = ~beside[np.minimum(row, beside.shape[0] - 1), np.minimum(column, beside.shape[1] - 1)]
    distance = np.where(beside, np.nan, view.distance)
    return replace(view, edge=view.edge[kept], outward=view.outward[kept], distance=distance)


LEAST_APART = 0.01
"""Distance between annotated cameras below which nothing is tried, in scene extents."""
MOST_DOUBT = 5.0
"""Degrees by which a plane may be turned without its masks telling before it is refused."""


@dataclass(frozen=True)
class _Pane:
    """One fitted pane, in NumPy."""

    center: Array
    normal: Array
    tangent: Array
    half_sizes: Array


def fit_planes(
    centers: Tensor,
    annotations: Sequence[tuple[Camera, Tensor]],
    *,
    extent: float,
    measured: Tensor | None = None,
    names: Sequence[str] | None = None,
    labels: Sequence[int] | None = None,
    options: PlaneFit | None = None,
) -> Planes:
    """A reflection plane for every pane that the masks name, in the order of their labels.

    As in the paper, candidates are points that project near a mask's edge, RANSAC draws planes
    through them, and rotating calipers bound the rectangle. Beyond the paper, the masks themselves
    choose among the planes and place the best one exactly: on the pane's own plane, and on no other,
    the masks of all views coincide (`consistency`), and their edges do (`edges`). RANSAC alone often prefers a
    wall or the floor. No points are needed: further planes are drawn through the masks.

    Gaussians may mislead, so that each pane is fitted to the measured points as well, and of both planes the one is
    kept that masks and measured points support better (`plane_evidence`).

    Args:
        centers: [N, 3] centres of the primary Gaussians, or SfM points.
        annotations: cameras and their label images [H, W]; 0 is no pane.
        extent: radius of the capture in world units.
        measured: [M, 3] SfM points, where `centers` are those of Gaussians; None where there are none.
        names: of the annotated photographs, for messages.
        labels: the panes to fit; all that the masks name if None.
        options: how to fit; the defaults if None.

    Returns:
        Planes whose normals point to the side that most annotated cameras are on.

    Raises:
        PlaneFitError: no mask names a pane, or a pane has too few views or views from one place, or its
            masks agree on no plane or on many.
    """
    options = options or PlaneFit()
    named = sorted({int(label) for _, image in annotations for label in image.unique()} - {0})
    labels = named if labels is None else labels
    if not named:
        raise PlaneFitError(
            f"none of the {len(annotations)} masks names a pane; expected pixels with labels 1, 2, ... in at least two"
        )
    clouds = {"the points" if measured is None else "the Gaussians": _usable(centers)}
    if measured is not None:
        clouds = {"the measured points": _usable(measured)} | clouds
    panes = []
    for label in labels:
        views = pane_views(annotations, label, most=options.most_views, names=names)
        try:
            panes.append(_fit_pane(label, clouds, views, extent=extent, options=options))
        except PlaneFitError as error:
            if len(labels) == 1:
                raise
            without = f"Or do without it: with label {label} erased from the masks, it is learned like all else"
            raise PlaneFitError(f"{error}. {without}") from error
    return _planes(panes, labels, options).to(centers.device)


def _usable(positions: Tensor) -> Array:
    points: Array = positions.detach().cpu().double().numpy()
    return points[np.isfinite(points).all(axis=1)]


def _fit_pane(
    label: int, clouds: Mapping[str, Array], views: Sequence[PaneView], *, extent: float, options: PlaneFit
) -> _Pane:
    """The pane on the plane, of those fitted to each cloud, that masks and the first cloud support best."""
    _check_views(label, views, extent)
    objectives = {}
    for source, points in clouds.items():
        chosen = points[plane_candidates(points, views, band=options.band)]
        objectives[source] = Objective(views, chosen, extent, options.inlier_distance * extent)
    try:
        fits = _fits(label, objectives, options)
        found = best_supported(label, fits, next(iter(objectives.values())))
        report_masks(label, found, views)
        return _pane(found.planes, views, options.margin)
    except ValueError as error:
        raise PlaneFitError(
            f"pane {label}, annotated in {len(views)} views: {error}. Check that label {label} means the same flat "
            "pane in every mask, and annotate more views, from places well apart, that show its outline inside of the "
            "image with nothing standing before it"
        ) from error


def _fits(label: int, objectives: Mapping[str, Objective], options: PlaneFit) -> list[Fit]:
    """A plane for each objective that leads to one.

    Raises:
        ValueError: none does; the first one's reason.
    """
    fits, errors = [], []
    for source, objective in objectives.items():
        rng = np.random.default_rng((options.seed, label))
        found = best_plane(objective, hypotheses=options.hypotheses, refine=options.refined, rng=rng)
        try:
            _check_agreement(found.planes, objective.views, options.least_agreement)
            _check_certainty(found, objective)
        except ValueError as error:
            errors.append(error)
        else:
            fits.append(Fit(source, found))
    if not fits:
        raise errors[0]
    return fits


def _check_views(label: int, views: Sequence[PaneView], extent: float) -> None:
    if len(views) < 2:
        raise PlaneFitError(
            f"pane {label} is annotated in {len(views)} view(s), but its plane shows only between views: "
            "annotate at least two more views of it, taken from places well apart"
        )
    if len(views) == 2:
        log.warning("pane %d is annotated in two views only; its plane may be off by degrees, a third helps", label)
    _check_places(label, views, extent)
    _check_outline(label, views)


def _check_places(label: int, views: Sequence[PaneView], extent: float) -> None:
    eyes = np.stack([view.center for view in views])
    apart = float(np.linalg.norm(eyes - eyes[0], axis=1).max())
    if apart < LEAST_APART * extent:
        raise PlaneFitError(
            f"pane {label}: its {len(views)} annotated views were taken from places at most {apart:.3g} apart in a "
            f"capture of radius {extent:.3g}, and its plane shows only between places: annotate views "
            "of it from farther apart"
        )


def _check_outline(label: int, views: Sequence[PaneView]) -> None:
    showing = sum(len(view.edge) > 0 for view in views)
    if showing < 2:
        raise PlaneFitError(
            f"pane {label}: its outline lies inside of the image in {showing} of {len(views)} annotated views, "
            "expected at least two: annotate views that show where it ends, from places well apart"
        )


def _check_certainty(found: FramedPlanes, objective: Objective) -> None:
    degrees = float(np.degrees(tilt_uncertainty(found, objective, MIDDLE)[0]))
    if degrees <= MOST_DOUBT:
        return
    raise ValueError(
        f"the plane could turn by {min(degrees, 90):.0f} degrees before its masks tell; too little of its outline lies "
        f"inside of the images, and {len(objective.points)} points lie along it"
    )


def _check_agreement(plane: PlaneEquations, views: Sequence[PaneView], least: float) -> None:
    agreement = float(mask_agreement(plane, views)[0])
    if agreement < least:
        raise ValueError(
            f"no plane brings its masks together; on the best one they overlap by {agreement:.2f}, "
            f"expected at least {least:.2f}"
        )


def _pane(plane: PlaneEquations, views: Sequence[PaneView], margin: float) -> _Pane:
    eyes = np.stack([view.center for view in views])
    normal = plane.normals[0]
    if (np.sign(plane.distances(eyes)[0])).sum() < 0:
        normal = -normal
    axes = np.linalg.svd(normal[None])[2][1:]
    rectangle = pane_rectangle(plane, views, axes)
    foot = plane.normals[0] * plane.offsets[0]
    return _Pane(
        center=foot + rectangle.center @ axes,
        normal=normal,
        tangent=rectangle.axis @ axes,
        half_sizes=margin * rectangle.half_sizes,
    )


def _planes(panes: Sequence[_Pane], labels: Sequence[int], options: PlaneFit) -> Planes:
    def stacked(rows: list[Array]) -> Tensor:
        return torch.tensor(np.stack(rows), dtype=torch.float32)

    glass = options.glass_reflectance
    planes = Planes(
        centers=stacked([pane.center for pane in panes]),
        raw_normals=stacked([pane.normal for pane in panes]),
        logit_reflectances=torch.full((len(labels),), logit(glass)),
        tangents=stacked([pane.tangent for pane in panes]),
        half_sizes=stacked([pane.half_sizes for pane in panes]),
        labels=tuple(labels),
    )
    return with_mirrors(planes, options.mirror_labels, options.mirror_reflectance)


def with_mirrors(planes: Planes, labels: tuple[int, ...], reflectance: float) -> Planes:
    """The planes with some of them, by label, made mirrors of a base reflectance that stays."""
    kept = tuple(label for label in planes.labels if label in labels)
    mirrors = torch.tensor([label in kept for label in planes.labels], device=planes.centers.device)
    fixed = torch.full_like(planes.logit_reflectances, logit(reflectance))
    return replace(planes, logit_reflectances=torch.where(mirrors, fixed, planes.logit_reflectances), mirrors=kept)
