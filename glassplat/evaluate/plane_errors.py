"""How far fitted planes are from the true panes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from glassplat.evaluate.truth import GroundTruth, TruePlane
from glassplat.scene.plane import Planes

ERRORS = ("normal_error_deg", "offset_error", "base_reflectance_error")


def plane_table(
    planes: Planes, truth: GroundTruth | None, extent: float, marked: Planes | None = None
) -> list[dict[str, Any]]:
    """One entry per fitted plane: label, center, normal, base_reflectance, and its errors.

    `normal_error_deg` is the angle between the normals, whose sign does not matter; `offset_error` the
    distance of the true centre from the fitted plane over `extent`; `base_reflectance_error` an absolute
    difference. Without a true pane of that label they are None, with a reason beside each.
    Glass that may be tinted has its `transmittance` of red, green and blue.
    `normal_drift_deg` and `offset_drift` compare in the same way with the plane that the masks led to, where known.

    Args:
        planes: the fitted planes.
        truth: true panes, matched by label.
        extent: radius of the capture, world units.
        marked: planes fitted to masks and measured points, without training.
    """
    true_planes = {} if truth is None else {plane.label: plane for plane in truth.planes}
    missing = "the data set has no ground truth" if truth is None else "the ground truth has no pane of this label"
    glass = {} if planes.transmittances is None else {"transmittance": planes.transmittances}
    table = []
    for index, label in enumerate(planes.labels):
        entry: dict[str, Any] = {
            "label": label,
            "center": planes.centers[index].tolist(),
            "normal": planes.normals[index].tolist(),
            "base_reflectance": planes.base_reflectances[index].item(),
        } | {name: values[index].tolist() for name, values in glass.items()}
        if label in true_planes:
            entry |= _errors(entry, true_planes[label], extent)
        else:
            entry |= dict.fromkeys(ERRORS) | {f"{name}_reason": missing for name in ERRORS}
        if marked is not None and label in marked.labels:
            entry |= _drift(entry, marked, marked.labels.index(label), extent)
        table.append(entry)
    return table


def missing_panes(planes: Planes, truth: GroundTruth | None) -> list[int]:
    """Labels of true panes that no fitted plane stands for."""
    return [] if truth is None else sorted({plane.label for plane in truth.planes} - set(planes.labels))


def _errors(fitted: dict[str, Any], true: TruePlane, extent: float) -> dict[str, float]:
    turn, offset = _difference(fitted, true.center, true.normal)
    return {
        "normal_error_deg": turn,
        "offset_error": offset / extent,
        "base_reflectance_error": abs(fitted["base_reflectance"] - true.base_reflectance),
    }


def _drift(fitted: dict[str, Any], marked: Planes, row: int, extent: float) -> dict[str, float]:
    turn, offset = _difference(fitted, marked.centers[row].tolist(), marked.normals[row].tolist())
    return {"normal_drift_deg": turn, "offset_drift": offset / extent}


def _difference(fitted: dict[str, Any], center: Sequence[float], normal: Sequence[float]) -> tuple[float, float]:
    """Angle between the normals in degrees, and the distance of the other plane's centre from the fitted plane."""
    own = torch.tensor(fitted["normal"], dtype=torch.float64)
    other = torch.nn.functional.normalize(torch.tensor(normal, dtype=torch.float64), dim=0)
    # The arc tangent keeps its precision for the small angles that matter here; the arc cosine does not.
    angle = torch.atan2(torch.linalg.cross(own, other).norm(), (own @ other).abs())
    apart = torch.tensor(center, dtype=torch.float64) - torch.tensor(fitted["center"], dtype=torch.float64)
    return torch.rad2deg(angle).item(), (apart @ own).abs().item()
