"""Evidence of the axes of camera poses; with the wrong ones the scene lies behind every camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from glassplat.captures.view import View
from glassplat.scene.camera import Camera
from glassplat.scene.panes import in_image

Item = TypeVar("Item")
LEAST_SEEN = 0.05
"""Largest share that counts as nothing seen; stray points lie in front of some camera whatever the axes."""
MOST_SEEN = 0.5
MOST_CAMERAS, MOST_POINTS, MOST_MASKS = 64, 2000, 24
LEAST_SIGHTINGS = 3
LEAST_CROSSING = 1e-3
"""Smallest eigenvalue of the mean of I - d d^T for which rays towards a pane are taken to cross."""
BOX_MARGIN = 0.5
"""How far outside the box of a mask the pane's middle may lie, in sizes of the box; photographs cut panes off."""


@dataclass(frozen=True)
class AxesEvidence:
    """Evidence in the data for the direction in which the cameras look.

    Attributes:
        as_read: share of the points that some camera sees, or of the masks that contain the middle of their pane.
        flipped: the same for cameras whose y and z axes are turned round.
        source: "points" or "masks".
    """

    as_read: float
    flipped: float
    source: str

    @property
    def contradicts(self) -> bool:
        """Return whether the axes are wrong and the other ones right."""
        return self.as_read < LEAST_SEEN and self.flipped > MOST_SEEN

    @property
    def fits_neither(self) -> bool:
        """Return whether the poses make no sense with either axes."""
        return self.as_read < LEAST_SEEN and self.flipped < LEAST_SEEN


class _Sighting(NamedTuple):
    """One pane in one view: the middle of its pixels [2] and its box, both corners [2, 2], in pixels."""

    camera: Camera
    middle: Tensor
    box: Tensor


def axes_evidence(views: Sequence[View], measured: Tensor | None) -> AxesEvidence | None:
    """Judges axes by masks, or by points where the masks say nothing; None where neither does.

    Masks come first: in a room photographed all around, cameras that look the wrong way see as many points.

    Args:
        views: the training views.
        measured: [P, 3] points that were triangulated; None for random ones.
    """
    evidence = evidence_of_masks(views)
    if evidence is not None or measured is None or not len(measured):
        return evidence
    return evidence_of_points([view.camera for view in views], measured)


def evidence_of_points(cameras: Sequence[Camera], points: Tensor) -> AxesEvidence:
    """Judges axes by measured points [P, 3]: every one of them was seen by a camera."""
    some_cameras = [_double(camera) for camera in _spread(cameras, MOST_CAMERAS)]
    some_points = points[_indices(len(points), MOST_POINTS)].double()
    return AxesEvidence(
        _share_of_points(some_cameras, some_points),
        _share_of_points([flip_axes(camera) for camera in some_cameras], some_points),
        "points",
    )


def evidence_of_masks(views: Sequence[View]) -> AxesEvidence | None:
    """Judges axes by annotated views: the rays through the middles of one pane's masks meet in the pane.

    None where the views say nothing: fewer than three show any one pane, or their rays are parallel. At most 24
    of the views are looked at.
    """
    annotated = _spread([view for view in views if view.is_annotated], MOST_MASKS)
    shares = [
        (len(sightings), _share_of_masks(sightings), _share_of_masks([_flip_sighting(s) for s in sightings]))
        for sightings in _sightings(annotated).values()
        if len(sightings) >= LEAST_SIGHTINGS
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
    """The same camera with y and z turned round: what OpenGL axes are to OpenCV axes, and back."""
    turn = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=camera.cam_from_world.dtype))
    return replace(camera, cam_from_world=turn @ camera.cam_from_world)


def _double(camera: Camera) -> Camera:
    return replace(camera, cam_from_world=camera.cam_from_world.double())


def _indices(count: int, most: int) -> Tensor:
    """At most so many of the indices below a count, evenly spread."""
    return torch.linspace(0, count - 1, min(count, most), dtype=torch.float32).round().long()


def _spread(items: Sequence[Item], most: int) -> list[Item]:
    return [items[int(index)] for index in _indices(len(items), most)]


def _share_of_points(cameras: Sequence[Camera], points: Tensor) -> float:
    """Share of the points that lie in the image of at least one camera."""
    seen = torch.zeros(len(points), dtype=torch.bool)
    for camera in cameras:
        seen |= in_image(points, camera)
    return float(seen.double().mean())


def _sightings(views: Sequence[View]) -> dict[int, list[_Sighting]]:
    """Every pane of every view, by label."""
    found: dict[int, list[_Sighting]] = {}
    for view in views:
        labels = view.pane_labels
        if labels is None:
            continue
        for label in torch.unique(labels[labels > 0]).tolist():
            pixels = torch.nonzero(labels == label).flip(1).double() + 0.5
            box = torch.stack([pixels.amin(dim=0), pixels.amax(dim=0)])
            found.setdefault(label, []).append(_Sighting(_double(view.camera), pixels.mean(dim=0), box))
    return found


def _flip_sighting(sighting: _Sighting) -> _Sighting:
    return sighting._replace(camera=flip_axes(sighting.camera))


def _share_of_masks(sightings: Sequence[_Sighting]) -> float | None:
    """Share of the views in whose mask the pane's middle lies, in front of the camera; None if no rays cross."""
    middle = _meeting_point(sightings)
    if middle is None:
        return None
    hits = 0
    for camera, _, box in sightings:
        pixel, depth = camera.project(middle[None])
        margin = BOX_MARGIN * (box[1] - box[0] + 1)
        hits += bool(depth > 0) and bool((pixel[0] >= box[0] - margin).all() and (pixel[0] <= box[1] + margin).all())
    return hits / len(sightings)


def _meeting_point(sightings: Sequence[_Sighting]) -> Tensor | None:
    """[3] the point closest to the rays through the middles, on the rays or behind the cameras."""
    projectors, targets = [], []
    for camera, middle, _ in sightings:
        intrinsics = camera.intrinsics
        direction = torch.cat([(middle - intrinsics[2:]) / intrinsics[:2], torch.ones(1, dtype=middle.dtype)])
        direction = torch.nn.functional.normalize(direction @ camera.cam_from_world[:3, :3], dim=0)
        projectors.append(torch.eye(3, dtype=middle.dtype) - torch.outer(direction, direction))
        targets.append(projectors[-1] @ camera.center)
    mean = torch.stack(projectors).mean(dim=0)
    if float(torch.linalg.eigvalsh(mean)[0]) < LEAST_CROSSING:
        return None
    return torch.linalg.solve(mean, torch.stack(targets).mean(dim=0))
