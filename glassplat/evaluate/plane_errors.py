"""How far fitted planes are from the true panes."""

from __future__ import annotations

from typing import Any

import torch

from glassplat.evaluate.truth import GroundTruth, TruePlane
from glassplat.scene.plane import Planes

ERRORS = ("normal_error_deg", "offset_error", "base_reflectance_error")


def plane_table(planes: Planes, truth: GroundTruth | None, extent: float) -> list[dict[str, Any]]:
    """One entry per fitted plane: label, center, normal, base_reflectance, and its errors.

    `normal_error_deg` is the angle between the normals, whose sign does not matter; `offset_error` the
    distance of the true centre from the fitted plane over `extent`; `base_reflectance_error` an absolute
    difference. Without a true pane of that label they are None, with a reason beside each.

    Args:
        planes: the fitted planes.
        truth: true panes, matched by label.
        extent: radius of the capture, world units.
    """
    true_planes = {} if truth is None else {plane.label: plane for plane in truth.planes}
    missing = "the data set has no ground truth" if truth is None else "the ground truth has no pane of this label"
    table = []
    for index, label in enumerate(planes.labels):
        entry: dict[str, Any] = {
            "label": label,
            "center": planes.centers[index].tolist(),
            "normal": planes.normals[index].tolist(),
            "base_reflectance": planes.base_reflectances[index].item(),
        }
        if label in true_planes:
            entry |= _errors(entry, true_planes[label], extent)
        else:
            entry |= dict.fromkeys(ERRORS) | {f"{name}_reason": missing for name in ERRORS}
        table.append(entry)
    return table


def missing_panes(planes: Planes, truth: GroundTruth | None) -> list[int]:
    """Labels of true panes that no fitted plane stands for."""
    return [] if truth is None else sorted({plane.label for plane in truth.planes} - set(planes.labels))


def _errors(fitted: dict[str, Any], true: TruePlane, extent: float) -> dict[str, float]:
    normal = torch.tensor(fitted["normal"], dtype=torch.float64)
    true_normal = torch.nn.functional.normalize(torch.tensor(true.normal, dtype=torch.float64), dim=0)
    # The arc tangent keeps its precision for the small angles that matter here; the arc cosine does not.
    angle = torch.atan2(torch.linalg.cross(normal, true_normal).norm(), (normal @ true_normal).abs())
    to_true = torch.tensor(true.center, dtype=torch.float64) - torch.tensor(fitted["center"], dtype=torch.float64)
    return {
        "normal_error_deg": torch.rad2deg(angle).item(),
        "offset_error": (to_true @ normal).abs().item() / extent,
        "base_reflectance_error": abs(fitted["base_reflectance"] - true.base_reflectance),
    }
