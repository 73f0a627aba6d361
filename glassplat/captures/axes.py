"""Check of the axis convention of camera poses; with the wrong one the scene lies behind every camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from glassplat.captures.view import View, sample_evenly
from glassplat.scene.camera import Camera, nearest_to_lines
from glassplat.scene.panes import in_image

LEAST_SEEN, MOST_SEEN = 0.05, 0.5
"""Largest share that counts as nothing seen, because some stray points lie in front of a camera with either axes, and
share above which the scene is seen."""
MOST_CAMERAS, MOST_POINTS, MOST_MASKS, LEAST_SIGHTINGS = 64, 2000, 24, 3
"""Maximum numbers of cameras, points and masks examined, and minimum number of masks of a pane that locate it."""
BOX_MARGIN = 0.5
"""Tolerance around a mask's box for the pane's centre, in sizes of the box; photographs may crop panes."""


@dataclass(frozen=True)
class AxesEvidence:
    """Evidence in the data for the viewing direction of the cameras.

    Attributes:
        as_read: share of the points that some camera sees, or of the masks that contain their pane's centre.
        flipped: the same share with the y and z axes of the cameras negated.
        source: "points" or "masks".
    """

    as_read: float
    flipped: float
    source: str

    @property
    def contradicts(self) -> bool:
        """Return whether the axes as read are wrong and the flipped ones right."""
        return self.as_read < LEAST_SEEN and self.flipped > MOST_SEEN

    @property
    def fits_neither(self) -> bool:
        """Return whether the poses contradict the data with either axes."""
        return self.as_read < LEAST_SEEN and self.flipped < LEAST_SEEN


class _Sighting(NamedTuple):
    """One pane in one view: the mean of its pixels [2] and the two corners of its box [2, 2], in pixels."""

    camera: Camera
    middle: Tensor
    box: Tensor


def axes_evidence(views: Sequence[View], measured: Tensor | None) -> AxesEvidence | None:
    """Evaluates the axes by masks, or by points if the masks are inconclusive; None without evidence.

    Masks take precedence: in a room photographed all around, flipped cameras see as many points.

    Args:
        views: the training views.
        measured: [P, 3] triangulated points; None if the points are random.
    """
    evidence = evidence_of_masks(views)
    if evidence is not None or measured is None or not len(measured):
        return evidence
    return evidence_of_points([view.camera for view in views], measured)


def evidence_of_points(cameras: Sequence[Camera], points: Tensor) -> AxesEvidence:
    """Evaluates the axes by measured points [P, 3], each of which was visible to some camera."""
    some_cameras = [camera.to(torch.float64) for camera in sample_evenly(cameras, MOST_CAMERAS)]
    some_points = points[sample_evenly(range(len(points)), MOST_POINTS)].double()
    return AxesEvidence(
        _share_of_points(some_cameras, some_points),
        _share_of_points([flip_axes(camera) for camera in some_cameras], some_points),
        "points",
    )


def evidence_of_masks(views: Sequence[View]) -> AxesEvidence | None:
    """Evaluates the axes by annotated views: rays through the centres of a pane's masks meet in the pane.

    None if the views are inconclusive: no pane is visible in three of them, or the rays are parallel. At most 24 views
    are read.
    """
    annotated = sample_evenly([view for view in views if view.is_annotated], MOST_MASKS)
    shares = [
        (len(seen), _share_of_masks(seen), _share_of_masks([s._replace(camera=flip_axes(s.camera)) for s in seen]))
        for seen in _sightings(annotated).values()
        if len(seen) >= LEAST_SIGHTINGS
    ]
    known = [(count, mine, other) for count, mine, other in shares if mine is not None and other is not None]
    if not known:
        return None
    total = sum(count for count, _, _ in known)
    return AxesEvidence(
        sum(count * mine for count, mine, _ in known) / total,
        sum(count * other for count, _, other in known) / total,
        "masks",
    )


def flip_axes(camera: Camera) -> Camera:
    """The same camera with y and z negated: converts between OpenGL and OpenCV axes."""
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=camera.cam_from_world.dtype))
    return replace(camera, cam_from_world=turn @ camera.cam_from_world)


def _share_of_points(cameras: Sequence[Camera], points: Tensor) -> float:
    """Share of the points that project into the image of at least one camera."""
    seen = torch.zeros(len(points), dtype=torch.bool)
    for camera in cameras:
        seen |= in_image(points, camera)
    return float(seen.double().mean())


def _sightings(views: Sequence[View]) -> dict[int, list[_Sighting]]:
    """Sightings of all panes in all views, by label."""
    found: dict[int, list[_Sighting]] = {}
    for view in views:
        labels = view.pane_labels
        if labels is None:
            continue
        for label in torch.unique(labels[labels > 0]).tolist():
            pixels = torch.nonzero(labels == label).flip(1).double() + 0.5
            box = torch.stack([pixels.amin(dim=0), pixels.amax(dim=0)])
            found.setdefault(label, []).append(_Sighting(view.camera.to(torch.float64), pixels.mean(dim=0), box))
    return found


def _share_of_masks(sightings: Sequence[_Sighting]) -> float | None:
    """Share of the views whose mask contains the pane's centre, in front of the camera; None if no rays cross."""
    middle = _intersect_rays(sightings)
    if middle is None:
        return None
    hits = 0
    for camera, _, box in sightings:
        pixel, depth = camera.project(middle[None])
        margin = BOX_MARGIN * (box[1] - box[0] + 1)
        hits += bool(depth > 0) and bool((pixel[0] >= box[0] - margin).all() and (pixel[0] <= box[1] + margin).all())
    return hits / len(sightings)


def _intersect_rays(sightings: Sequence[_Sighting]) -> Tensor | None:
    """[3] the least-squares intersection of the lines through the mask centres; it may lie behind the cameras."""
    directions = []
    for camera, middle, _ in sightings:
        intrinsics = camera.intrinsics
        direction = torch.cat([(middle - intrinsics[2:]) / intrinsics[:2], torch.ones(1, dtype=middle.dtype)])
        directions.append(torch.nn.functional.normalize(direction @ camera.cam_from_world[:3, :3], dim=0))
    return nearest_to_lines(torch.stack([camera.center for camera, _, _ in sightings]), torch.stack(directions))
