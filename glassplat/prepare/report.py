"""Report on the photographs: figures, and advice where something could be better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from glassplat.errors import first_names
from glassplat.prepare.photographs import FEWEST, Photograph
from glassplat.prepare.reconstruction import Solution, image_numbers

FEW_FEATURES = 500
SHORT_TRACK = 3.0
LARGE_ERROR = 1.5
USUAL_FOCALS = (0.4, 3.0)
"""In longer image sides."""


@dataclass(frozen=True)
class Report:
    """A preparation in figures.

    Attributes:
        photographs: how many there were.
        registered: how many were placed, all connected with each other.
        missing: names of the files that were not.
        groups: sizes of the groups of photographs that were placed, each by itself; each photograph counts once.
        points: measured places in the scene.
        reprojection_error: mean distance of a point from where photographs show it, in pixels.
        track_length: mean number of photographs that a point was measured in.
        features: of the middle photograph.
        cameras: each lens in words.
        attempt: the settings that this came from.
        attempts: how many were made.
        advice: what would make it better, full sentences.
    """

    photographs: int
    registered: int
    missing: tuple[str, ...]
    groups: tuple[int, ...]
    points: int
    reprojection_error: float
    track_length: float
    features: int
    cameras: tuple[str, ...]
    attempt: str
    attempts: int
    advice: tuple[str, ...]

    @property
    def share(self) -> float:
        """Of the photographs, those that were placed."""
        return self.registered / self.photographs

    def lines(self) -> list[str]:
        """The report for people."""
        missing = f" (not: {first_names(list(self.missing), 8)})" if self.missing else ""
        return [
            f"{self.registered} of {self.photographs} photographs placed{missing}, with {self.attempt}",
            f"{self.points} points, each in {self.track_length:.1f} photographs on average, "
            f"{self.reprojection_error:.2f} pixels off",
            *(f"camera: {camera}" for camera in self.cameras),
            *(f"advice: {line}" for line in self.advice),
        ]

    def as_json(self) -> dict[str, Any]:
        """The report for programs."""
        return asdict(self)


def report_of(solution: Solution) -> Report:
    """The figures of a solution; one without any model has zeros."""
    photographs = solution.database.photographs
    missing = solution.missing()
    model = solution.models[0] if solution.models else None
    features = int(np.median(solution.database.feature_counts()))
    figures = Report(
        photographs=len(photographs),
        registered=solution.registered,
        missing=tuple(one.path.name for one in missing),
        groups=_groups(solution),
        points=int(model.num_points3D()) if model else 0,
        reprojection_error=float(model.compute_mean_reprojection_error()) if model else 0.0,
        track_length=float(model.compute_mean_track_length()) if model else 0.0,
        features=features,
        cameras=tuple(_described(model)) if model else (),
        attempt=solution.attempt,
        attempts=solution.tried,
        advice=(),
    )
    return Report(**{**figures.__dict__, "advice": tuple(_advice(figures, missing, solution))})


def _groups(solution: Solution) -> tuple[int, ...]:
    """Number of photographs that each model adds to the larger ones; part of a group may be placed twice."""
    known: set[int] = set()
    sizes = []
    for model in solution.models:
        added = set(image_numbers(model)) - known
        known |= added
        if len(added) >= FEWEST:
            sizes.append(len(added))
    return tuple(sizes)


def _described(model: Any) -> list[str]:
    """Each lens that took a placed photograph."""
    used = {image.camera_id for image in model.images.values() if image.has_pose}
    return [
        f"{camera.width}x{camera.height}, focal length {camera.mean_focal_length():.0f} pixels"
        for key, camera in sorted(model.cameras.items())
        if key in used
    ]


def _advice(figures: Report, missing: Sequence[Photograph], solution: Solution) -> list[str]:
    advice = []
    if missing:
        advice.append(
            f"photograph once more around {first_names([one.path.name for one in missing], 3)}: steps of half a metre, "
            "each picture sharing two thirds with the one before, and some that show what stands next to the glass"
        )
    if len(figures.groups) > 1:
        advice.append(
            f"the photographs fall into {len(figures.groups)} groups that share nothing "
            f"({', '.join(map(str, figures.groups))} photographs): take some that connect them, or prepare each alone"
        )
    if figures.features < FEW_FEATURES:
        advice.append(
            f"photographs have only {figures.features} features on average: more light, a steadier hand, or a larger "
            "--max-size"
        )
    if figures.points and figures.track_length < SHORT_TRACK:
        advice.append("points are seen in few photographs: take more, with smaller steps")
    if figures.reprojection_error > LARGE_ERROR:
        advice.append("points have large errors for a still scene: see that nothing large moves, or try --lens opencv")
    model = solution.models[0] if solution.models else None
    if model is not None and any(not _usual(camera) for camera in model.cameras.values()):
        advice.append("a focal length is unusual, the lens was badly determined: photograph from different distances")
    return advice


def _usual(camera: Any) -> bool:
    least, most = USUAL_FOCALS
    return bool(least <= camera.mean_focal_length() / max(camera.width, camera.height) <= most)
