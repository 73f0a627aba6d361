"""Initial panes: a rectangle for every annotated pane (TR-Gaussians, Section III-C1 and Appendix A)."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from glassplat.errors import count_noun
from glassplat.panes import PlaneFit, PlaneFitError, masks, search
from glassplat.panes.material import virtual_points
from glassplat.panes.objective import MIDDLE_TOLERANCE, JointObjective, Objective, edge_matches, pane_rectangle
from glassplat.scene import logit
from glassplat.scene.camera import Camera, NumpyCamera
from glassplat.scene.panes import Planes, connected_components, name_labels

Array = NDArray[np.float64]
log = logging.getLogger("glassplat.panes")

LEAST_MATCHING, LEAST_OF_MEDIAN = 0.3, 0.5
"""Minimum share of a mask's outline that must meet the others, absolute and relative to the median over the masks."""
EDGES_PER_VIEW = 100
"""Number of points of a mask's outline that are compared with the other masks."""
IMPRECISE_DISTANCE = 1e5
"""Distance of the cameras from the origin, in the distances between them, beyond which no mask is called wrong: there,
single precision moves cameras by a percent of these distances."""


def report_masks(label: int, plane: masks.FramedPlanes, views: Sequence[masks.PaneView]) -> None:
    """Logs how well each mask of a pane fits the others on its plane, and warns of those that do not fit, by name."""
    matching, overlap = matching_outline_shares(plane, views), masks.agreement_per_view(plane, views)
    shares = ["nothing to compare" if np.isnan(share) else f"{share:.0%}" for share in matching]
    found = [f"{view.name} {share}" for view, share in zip(views, shares, strict=True)]
    areas = ", ".join(f"{name} ({area:.2f})" for name, area in zip(found, overlap, strict=True))
    log.debug("pane %d: outlines of the masks that meet those of the others (and overlap): %s", label, areas)
    log.info(
        "pane %d: %d masks, which overlap by %.2f to %.2f on its plane", label, len(views), min(overlap), max(overlap)
    )
    outliers = outlier_masks(matching).nonzero()[0]
    centers = np.stack([view.center for view in views])
    is_far = np.linalg.norm(centers.mean(axis=0)) > IMPRECISE_DISTANCE * np.ptp(centers, axis=0).max()
    if len(outliers) and not is_far:
        log.warning(
            "pane %d: %d of its %d masks do not fit the others, their outlines hardly meet on any plane: %s; "
            "check that each belongs to its photograph, and that label %d is the same flat pane in it",
            label, len(outliers), len(views), ", ".join(found[number] for number in outliers), label,
        )  # fmt: skip


def outlier_masks(matching: Array) -> NDArray[np.bool_]:
    """[V] bool: masks that do not fit the others, from `matching_outline_shares`; possibly all of them."""
    known = matching[~np.isnan(matching)]
    limit = max(LEAST_MATCHING, LEAST_OF_MEDIAN * float(np.median(known))) if len(known) else 0.0
    return np.asarray(matching < limit)


def matching_outline_shares(plane: masks.FramedPlanes, views: Sequence[masks.PaneView]) -> Array:
    """[V] share of each mask's outline that meets those of the others on one plane; NaN if nothing is compared.

    The overlap of areas does not identify wrong masks: masks of a pane from other positions overlap by half or more,
    and a post that occludes half of a pane costs as much. Occluded outlines meet nothing. The outline of a wrong mask
    meets none of the others either, and none of them meets it.
    """
    views = [_without_shared_edges(view) for view in views]
    tolerance = max(MIDDLE_TOLERANCE, *(1 / view.diagonal for view in views))
    matches = edge_matches(plane, views, edges_per_view=EDGES_PER_VIEW)
    matching = 1 / (1 + matches.residuals(plane.frames, tolerance)[0] ** 2)
    compared = matches.compared[0] & ~np.isnan(matching)
    shares = np.full(len(views), np.nan)
    for number in range(len(views)):
        used = compared & (matches.sources == number)
        used[number] |= compared[number]
        if used.any():
            shares[number] = matching[used].mean()
    return shares


def _without_shared_edges(view: masks.PaneView) -> masks.PaneView:
    """The view without edges that other panes may occlude; distances next to other panes become NaN."""
    from scipy import ndimage

    near_others: NDArray[np.bool_] = ndimage.binary_dilation(view.hidden, iterations=2)
    column, row = np.floor(view.edge).astype(np.int64).T
    kept = ~near_others[np.minimum(row, near_others.shape[0] - 1), np.minimum(column, near_others.shape[1] - 1)]
    distance = np.where(near_others, np.nan, view.distance)
    return replace(view, edge=view.edge[kept], outward=view.outward[kept], distance=distance)


LEAST_CAMERA_SPREAD = 0.01
"""Distance between annotated cameras below which no plane is fitted, in scene extents."""
UNCERTAIN_DEG, TOO_UNCERTAIN_DEG = 2.5, 5.0
"""Tilt uncertainties of a plane, in degrees, above which more masks are requested, and above which it is refused. For
24 of 27 panes it is at most 1.5. Beyond, weak evidence misleads: a small mirror with 3.6, marked in four photographs
from nearly the same position, was off by 29."""
MOST_CONTRADICTION = 0.7
"""Value of `contradiction` above which a plane is refused."""
MOST_EXCESS = 0.04
"""Maximum excess of the `contradiction` of a plane shared with other panes over that of a pane's own. It is 0.03 for
two well measured panes at an angle of 2 degrees, 0.05 at 3 degrees, and 0.03 where chance preferred a plane to the true
one."""

MOST_SURFACE_ANGLE, MOST_SURFACE_OFFSET = float(np.radians(8)), 0.05
"""Maximum angle between the planes of two panes, and distance of the one's middle from the other's plane in scene
extents, for which a joint plane is tried."""

MOST_CAMERAS = 100
"""Maximum number of cameras that decide which points are seen through a pane."""


class FittedRectangle(NamedTuple):
    """One fitted pane, as NumPy arrays."""

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
    unmarked: Sequence[tuple[str, Camera]] = (),
) -> Planes:
    """A reflection plane for every pane in the masks, in the order of the labels.

    As in the paper, candidates are points that project near a mask's edge, RANSAC draws planes through them, and
    rotating calipers bound the rectangle. Beyond the paper, the masks rank the planes and refine the best one: only on
    the pane's own plane do the masks of all views (`mask_agreement`) and their edges (`edge_matches`) coincide. RANSAC
    alone often prefers a wall or the floor. Points are optional, because further planes are drawn through the masks.

    Gaussians may mislead, so each pane is fitted to the measured points as well. Of the two planes, the one with better
    support by masks and measured points is kept (`highest_scoring_plane`). Panes of one front share a plane, fitted to
    the masks of all (`JointObjective`), unless it fits one of them worse than its own. A pane that mirrors many points,
    such as a mirror with ragged masks, is positioned by them (`plane_of_mirror_images`).

    Args:
        centers: [N, 3] centres of the primary Gaussians, or SfM points.
        annotations: cameras and their label images [H, W]; 0 means no pane.
        extent: radius of the capture in world units.
        measured: [M, 3] SfM points, if `centers` are those of Gaussians; None if there are none.
        names: of the annotated photographs, for messages.
        labels: of the panes to fit; all labels in the masks if None.
        options: of the fit; the defaults if None.
        unmarked: names and cameras of photographs without masks. They help to find points seen through a pane, and
            error messages name the best ones to mark.

    Returns:
        Planes whose normals point to the side of most annotated cameras.

    Raises:
        PlaneFitError: no mask contains a pane, a pane has too few views or views from one position only, or its masks
            agree on no plane or on many.
    """
    options = options or PlaneFit()
    named = sorted({int(label) for _, image in annotations for label in image.unique()} - {0})
    labels = named if labels is None else labels
    if not named:
        raise PlaneFitError("no mask names a pane; expected pixels with labels 1, 2, ... in at least two")
    clouds = {"the points" if measured is None else "the Gaussians": _finite_points(centers)}
    if measured is not None:
        clouds = {"the measured points": _finite_points(measured)} | clouds
    found = []
    for label in labels:
        views = masks.pane_views(annotations, label, most_views=options.most_views, names=names)
        with _with_advice(label, len(labels)):
            found.append(_fit_pane(label, clouds, views, extent=extent, options=options))
    cameras = [camera for camera, _ in annotations] + [camera for _, camera in unmarked]
    cloud = next(iter(clouds.values()))
    panes = []
    for pane in _share_planes(found, options.seed):
        with _with_advice(pane.label, len(labels)):
            panes.append(_finish_pane(_place_by_mirror_images(pane, cloud, cameras, options), options, unmarked))
    return to_planes(panes, labels, options).to(centers.device)


@contextmanager
def _with_advice(label: int, count: int) -> Iterator[None]:
    """Adds advice to the error about a pane without a plane, if it is one of several."""
    try:
        yield
    except PlaneFitError as error:
        if count == 1:
            raise
        without = f"Or erase label {label} from the masks: then the pane is learned like everything else"
        raise PlaneFitError(f"{error}. {without}") from error


def _finite_points(positions: Tensor) -> Array:
    points: Array = positions.detach().cpu().double().numpy()
    return points[np.isfinite(points).all(axis=1)]


class _UndeterminedError(ValueError):
    """The masks of a pane do not determine its plane."""


@dataclass(frozen=True)
class _PanePlane:
    """A pane and its plane, before its rectangle is fitted.

    Attributes:
        label: of the pane.
        evidence: its masks and the points along its edge, measured ones if there are any.
        plane: the best plane, H = 1.
        fault: reason not to trust this plane; None if it is trusted.
        is_settled: true if more than its own masks determined the plane: other panes on it, or points that it mirrors.
    """

    label: int
    evidence: Objective
    plane: masks.FramedPlanes
    fault: ValueError | None = None
    is_settled: bool = False

    @property
    def has_two_views(self) -> bool:
        """Return whether only two views show it."""
        return len(self.evidence.views) == 2

    @property
    def is_undetermined(self) -> bool:
        """Return whether its own masks do not determine its plane reliably."""
        is_ambiguous = self.fault is None and self.has_two_views and not self.is_settled
        return is_ambiguous or isinstance(self.fault, _UndeterminedError)


def _fit_pane(
    label: int, clouds: Mapping[str, Array], views: Sequence[masks.PaneView], *, extent: float, options: PlaneFit
) -> _PanePlane:
    """The pane on the plane of its masks, or on that of the masks with gaps filled if these contradict it.

    Gaps between parts of a pane lie on its plane. But the edges of a post occluding it meet on a plane of their own,
    and may tilt the pane's plane towards that.
    """
    _check_views(label, views, extent)
    found = _fit_plane(label, clouds, views, extent=extent, options=options)
    filled = [masks.without_gaps(view) for view in views]
    if all(other is view for other, view in zip(filled, views, strict=True)):
        return found
    whole = _fit_plane(label, clouds, filled, extent=extent, options=options)
    if whole.fault is not None or _tilt_degrees(whole.plane, whole.evidence) > UNCERTAIN_DEG:
        return found
    if found.fault is None and _excess_contradiction(whole, found.plane) <= MOST_EXCESS:
        return found
    log.info(
        "pane %d: without the gaps of its masks, where it may be occluded, its plane is %.2f degrees away; "
        "using that plane", label, np.degrees(search.angle(found.plane, whole.plane)),
    )  # fmt: skip
    return whole


def _fit_plane(
    label: int, clouds: Mapping[str, Array], views: Sequence[masks.PaneView], *, extent: float, options: PlaneFit
) -> _PanePlane:
    """The pane on the plane that masks and the first cloud support best, of those fitted with each cloud."""
    objectives = {}
    for source, points in clouds.items():
        chosen = points[masks.plane_candidates(points, views, band=options.band)]
        objectives[source] = Objective(views, chosen, extent, options.inlier_distance * extent)
    evidence = next(iter(objectives.values()))
    sound, faulty = [], []
    for source, objective in objectives.items():
        rng = np.random.default_rng((options.seed, label))
        plane = search.best_plane(objective, hypotheses=options.hypotheses, refine=options.refined, rng=rng)
        fault = _find_fault(plane, objective, options)
        sound += [search.PlaneCandidate(source, plane)] if fault is None else []
        faulty += [] if fault is None else [_PanePlane(label, evidence, plane, fault)]
    return _PanePlane(label, evidence, search.highest_scoring_plane(label, sound, evidence)) if sound else faulty[0]


def _find_fault(plane: masks.FramedPlanes, objective: Objective, options: PlaneFit) -> ValueError | None:
    """The reason not to trust the plane of a pane; None if there is none."""
    agreement = float(masks.mask_agreement(plane, objective.views)[0])
    if agreement < options.least_agreement:
        return ValueError(
            f"no plane brings its masks together; on the best one they overlap by {agreement:.2f}, "
            f"expected at least {options.least_agreement:.2f}"
        )
    contradiction = float(search.contradiction(plane, objective)[0])
    if contradiction > MOST_CONTRADICTION:
        return ValueError(
            f"the outlines of its masks meet on no plane; on the best one {contradiction:.2f} of the evidence "
            f"contradicts it, expected at most {MOST_CONTRADICTION}"
        )
    degrees = _tilt_degrees(plane, objective)
    return _UndeterminedError(_tilt_message(degrees, objective)) if degrees > TOO_UNCERTAIN_DEG else None


def _share_planes(found: Sequence[_PanePlane], seed: int) -> list[_PanePlane]:
    """The panes; those of one front share a plane, fitted to the masks of all.

    A pane whose plane is undetermined, because its outlines are few or cut off, may take that of another pane.
    """
    panes = {pane.label: pane for pane in found}
    for labels in _groups_in_one_surface(found):
        joint = _fit_joint_plane([panes[label] for label in labels], seed)
        panes |= {pane.label: pane for pane in joint}
    trusted = [pane for pane in panes.values() if pane.fault is None and not pane.has_two_views]
    return [_choose_plane(pane, trusted) if pane.is_undetermined else pane for pane in panes.values()]


def _choose_plane(pane: _PanePlane, trusted: Sequence[_PanePlane]) -> _PanePlane:
    """The pane on the best plane of another pane that fits about as well as its own; unchanged if there is none."""
    excesses = [_excess_contradiction(pane, other.plane) for other in trusted]
    if not excesses or min(excesses) > MOST_EXCESS:
        return pane
    other = trusted[int(np.argmin(excesses))]
    reason = pane.fault or "two views alone leave it open"
    log.warning("pane %d gets the plane of pane %d, on which its masks meet: %s", pane.label, other.label, reason)
    return replace(pane, plane=other.plane, fault=None, is_settled=True)


def _place_by_mirror_images(pane: _PanePlane, cloud: Array, cameras: Sequence[Camera], options: PlaneFit) -> _PanePlane:
    """The pane on the plane that mirrors points seen through it onto others; unchanged if there is no clear one.

    Its masks limit the loss on that plane as for a plane shared with other panes (`MOST_EXCESS`).
    """
    if pane.is_settled or not (pane.fault is None or pane.is_undetermined):
        return pane
    try:
        outlined = _fit_rectangle(pane.plane, pane.evidence.views, options.margin)
    except ValueError:
        return pane
    some = cameras[:: -(-len(cameras) // MOST_CAMERAS)]
    some = [replace(camera, cam_from_world=camera.cam_from_world.float()) for camera in some]
    panes = to_planes([outlined], [pane.label], options)
    seen = virtual_points(torch.from_numpy(cloud).float(), panes, some).numpy()
    behind, others, extent = cloud[seen], cloud[~seen], pane.evidence.extent
    images = search.plane_of_mirror_images(pane.plane, outlined.center, behind, others, extent)
    if images is None or not images.is_clear:
        return pane
    if _excess_contradiction(pane, images.plane) > MOST_EXCESS:
        return pane
    log.info(
        "pane %d: %.0f points seen through it are mirror images of others on a plane %.2f degrees from that of its "
        "masks, which has %.0f; using that plane",
        pane.label, images.pairs, np.degrees(search.angle(pane.plane, images.plane)), images.before,
    )  # fmt: skip
    return replace(pane, plane=images.plane, fault=None, is_settled=True)


def _excess_contradiction(pane: _PanePlane, plane: masks.FramedPlanes) -> float:
    """The excess of the `contradiction` of a plane over that of the pane's own plane."""
    return float((search.contradiction(plane, pane.evidence) - search.contradiction(pane.plane, pane.evidence))[0])


def _groups_in_one_surface(found: Sequence[_PanePlane]) -> list[list[int]]:
    """Groups of labels of panes with trusted planes that may lie in one surface, directly or through other panes."""
    panes = {pane.label: pane for pane in found if pane.fault is None}

    def may_share(one: int, other: int) -> bool:
        first, second = panes[one], panes[other]
        if search.angle(first.plane, second.plane) > MOST_SURFACE_ANGLE:
            return False
        # One of the planes may be tilted about its own middle, and so miss the other's middle by far.
        pairs = (first, second), (second, first)
        rises = [abs(a.plane.distances(b.evidence.anchors(b.plane))) for a, b in pairs]
        return float(np.min(rises)) <= MOST_SURFACE_OFFSET * first.evidence.extent

    return [group for group in connected_components(list(panes), may_share) if len(group) > 1]


def _fit_joint_plane(panes: Sequence[_PanePlane], seed: int) -> list[_PanePlane]:
    """The panes that a joint plane fits about as well as their own planes, on that plane."""
    panes = list(panes)
    while len(panes) > 1:
        objective = JointObjective([pane.evidence for pane in panes])
        rng = np.random.default_rng((seed, *(pane.label for pane in panes)))
        plane = search.best_joint_plane(objective, masks.join_planes([pane.plane for pane in panes]), rng)
        excesses = [_excess_contradiction(pane, plane) for pane in panes]
        if max(excesses) <= MOST_EXCESS:
            labels, turned = name_labels(pane.label for pane in panes), max(search.angle(p.plane, plane) for p in panes)
            log.info("panes %s lie in one plane, within %.2f degrees", labels, np.degrees(turned))
            return [replace(pane, plane=plane, is_settled=True) for pane in panes]
        del panes[int(np.argmax(excesses))]
    return panes


def _finish_pane(pane: _PanePlane, options: PlaneFit, unmarked: Sequence[tuple[str, Camera]]) -> FittedRectangle:
    """The pane with its rectangle.

    Raises:
        PlaneFitError: its plane is not trusted, or its masks agree nowhere on it.
    """
    views = pane.evidence.views
    try:
        if pane.fault is not None:
            raise pane.fault
        if not pane.is_settled and (reason := _uncertainty_message(pane)):
            photographs = _photographs_to_mark(views, unmarked)
            log.warning("pane %d: %s; annotate it from places farther apart%s", pane.label, reason, photographs)
        report_masks(pane.label, pane.plane, views)
        return _fit_rectangle(pane.plane, views, options.margin)
    except ValueError as error:
        raise PlaneFitError(
            f"pane {pane.label}, annotated in {len(views)} views: {error}. Check that label {pane.label} is the "
            f"same flat pane in every mask, and annotate more views, from positions far apart, that show its "
            f"whole outline inside the image, unoccluded{_photographs_to_mark(views, unmarked)}"
        ) from error


def _uncertainty_message(pane: _PanePlane) -> str:
    """The reason to doubt a pane's own plane, for a message; empty if there is none."""
    if pane.has_two_views:
        return "two annotated views alone often leave its plane off by tens of degrees"
    degrees = _tilt_degrees(pane.plane, pane.evidence)
    return f"{_tilt_message(degrees, pane.evidence)}, and may be off by far more" if degrees > UNCERTAIN_DEG else ""


MOST_NAMED = 3
"""Maximum number of photographs named in an error or a warning."""
WELL_INSIDE = 0.2
"""Minimum distance of a pane's middle from the border of an image that shows it well, as a share of the sides."""


def _photographs_to_mark(views: Sequence[masks.PaneView], unmarked: Sequence[tuple[str, Camera]]) -> str:
    """Names of photographs without masks that should show the pane well from other positions, for a message."""
    middle = _triangulate_middle(views)
    centers = [view.center for view in views]
    names: list[str] = []
    cameras = [(name, NumpyCamera.from_camera(camera)) for name, camera in unmarked]
    held = [(name, camera.center) for name, camera in cameras if camera.contains(middle, margin=-WELL_INSIDE)]
    while held and len(names) < MOST_NAMED:
        apart = [min(_parallax_angle(middle, center, other) for other in centers) for _, center in held]
        name, center = held.pop(int(np.argmax(apart)))
        names.append(name)
        centers.append(center)
    return f": {', '.join(names)} should show it well" if names else ""


def _triangulate_middle(views: Sequence[masks.PaneView]) -> Array:
    """[3] the point closest, in least squares, to the rays through the middles of the masks."""
    system, right = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        ray = view.directions(view.middle)[0]
        across: Array = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        system = system + across
        right = right + across @ view.center
    return np.asarray(np.linalg.lstsq(system, right, rcond=None)[0])


def _parallax_angle(middle: Array, center: Array, other: Array) -> float:
    """Angle in radians between the directions from a point to two cameras."""
    first, second = center - middle, other - middle
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))


def _check_views(label: int, views: Sequence[masks.PaneView], extent: float) -> None:
    if len(views) < 2:
        raise PlaneFitError(
            f"pane {label} is annotated in {count_noun(len(views), 'view')}, but a plane can only be found from "
            "several views: annotate at least two more, from positions far apart"
        )
    centers = np.stack([view.center for view in views])
    apart = float(np.linalg.norm(centers - centers[0], axis=1).max())
    if apart < LEAST_CAMERA_SPREAD * extent:
        raise PlaneFitError(
            f"pane {label}: its {len(views)} annotated views were taken at most {apart:.3g} apart in a capture "
            f"of radius {extent:.3g}: annotate views from farther apart"
        )
    showing = sum(len(view.edge) > 0 for view in views)
    if showing < 2:
        raise PlaneFitError(
            f"pane {label}: its outline lies inside the image in {showing} of {len(views)} annotated views, "
            "expected at least two: annotate views that show its border, from positions far apart"
        )


def _tilt_degrees(found: masks.FramedPlanes, objective: Objective) -> float:
    """Tilt uncertainty of a plane in degrees (see `search.tilt_uncertainty`)."""
    return float(np.degrees(search.tilt_uncertainty(found, objective, MIDDLE_TOLERANCE)[0]))


def _tilt_message(degrees: float, objective: Objective) -> str:
    """Description of a plane with the given tilt uncertainty, for a message."""
    return (
        f"the masks determine the plane only to {min(degrees, 90):.0f} degrees: they show too little of its "
        f"outline or were taken too close together, and {len(objective.points)} points lie along it"
    )


def _fit_rectangle(plane: masks.FramedPlanes, views: Sequence[masks.PaneView], margin: float) -> FittedRectangle:
    centers = np.stack([view.center for view in views])
    normal = plane.normals[0]
    if (np.sign(plane.distances(centers)[0])).sum() < 0:
        normal = -normal
    axes = np.linalg.svd(normal[None])[2][1:]
    rectangle = pane_rectangle(plane, views, axes)
    foot = plane.normals[0] * plane.offsets[0]
    return FittedRectangle(
        center=foot + rectangle.center @ axes,
        normal=normal,
        tangent=rectangle.axis @ axes,
        half_sizes=margin * rectangle.half_sizes,
    )


def to_planes(panes: Sequence[FittedRectangle], labels: Sequence[int], options: PlaneFit) -> Planes:
    """The planes of rectangles, with the reflectances of glass and mirrors."""
    stacked = (torch.tensor(np.stack(rows), dtype=torch.float32) for rows in zip(*panes, strict=True))
    centers, normals, tangents, half_sizes = stacked
    logits = torch.full((len(labels),), logit(options.glass_reflectance), dtype=torch.float32)
    planes = Planes(centers, normals, logits, tangents, half_sizes, tuple(labels))
    return with_mirrors(planes, options.mirror_labels, options.mirror_reflectance)


def with_mirrors(planes: Planes, labels: tuple[int, ...], reflectance: float) -> Planes:
    """The planes, with those of the given labels made mirrors of fixed base reflectance."""
    kept = tuple(label for label in planes.labels if label in labels)
    mirrors = torch.tensor([label in kept for label in planes.labels], dtype=torch.bool, device=planes.centers.device)
    fixed = torch.full_like(planes.logit_reflectances, logit(reflectance))
    return replace(planes, logit_reflectances=torch.where(mirrors, fixed, planes.logit_reflectances), mirrors=kept)
