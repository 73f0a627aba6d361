"""How far the rendered surface is from the true one: its normals, and how strongly it reflects."""

from __future__ import annotations

import torch
from torch import Tensor

from glassplat.evaluate.metrics import psnr
from glassplat.evaluate.outcome import SMALLEST_REGION, Outcome
from glassplat.evaluate.surface_truth import NOTHING_KNOWN, TrueSurface
from glassplat.render.frame import Frame

REFLECTIVE = 0.5
"""Above this true strength a pixel mirrors more than it shows of its own."""
NO_DIRECTION_DEG = 90.0
"""The error of a vector without direction: what guessing comes to."""
NO_NORMALS, NO_STRENGTH = "the method renders no normals", "the method renders no strength"
NO_TRUE_NORMALS = "no true normals lie beside the photograph"
NO_TRUE_STRENGTH = "no true strength lies beside the photograph"
UNCOVERED = f"fewer than {SMALLEST_REGION} pixels show a surface"
UNREFLECTIVE = f"fewer than {SMALLEST_REGION} pixels reflect more than half"


def surface_metrics(frame: Frame, photo: Tensor, truth: TrueSurface | None) -> dict[str, Outcome]:
    """`reflective_psnr`, `normal_error_deg`, `reflective_normal_error_deg` and `strength_error` of one view.

    Args:
        frame: its image as photographed, and its layers `normal` [H, W, 3], world axes, of any length, and `strength`
            [H, W].
        photo: [H, W, 3] uint8.
        truth: the true surface at the frame's size, None where nothing is known.
    """
    truth = truth or NOTHING_KNOWN
    normal_errors = _normal_errors(frame, truth)
    return {
        "reflective_psnr": _reflective_psnr(frame, photo, truth),
        "normal_error_deg": _mean(normal_errors, truth.covered, UNCOVERED),
        "reflective_normal_error_deg": _mean(normal_errors, _reflective(truth), UNREFLECTIVE),
        "strength_error": _mean(_strength_errors(frame, truth), truth.covered, UNCOVERED),
    }


def angular_errors_deg(vectors: Tensor, truth: Tensor) -> Tensor:
    """Angles [...] in degrees between vectors [..., 3] of any length and others; 90 where one has no direction."""
    a, b = vectors.to(torch.float64), truth.to(torch.float64)
    # The arc tangent keeps its precision for small angles; the arc cosine does not.
    angles = torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(dim=-1)))
    lengths = a.norm(dim=-1) * b.norm(dim=-1)
    return torch.where((lengths > 0) & torch.isfinite(lengths), angles, NO_DIRECTION_DEG)


def _reflective_psnr(frame: Frame, photo: Tensor, truth: TrueSurface) -> Outcome:
    region = _reflective(truth)
    if isinstance(region, str):
        return region
    return psnr(frame.photographed, photo, region) if int(region.sum()) >= SMALLEST_REGION else UNREFLECTIVE


def _normal_errors(frame: Frame, truth: TrueSurface) -> Tensor | str:
    if "normal" not in frame.layers:
        return NO_NORMALS
    return NO_TRUE_NORMALS if truth.normals is None else angular_errors_deg(frame.layers["normal"], truth.normals)


def _strength_errors(frame: Frame, truth: TrueSurface) -> Tensor | str:
    if "strength" not in frame.layers:
        return NO_STRENGTH
    if truth.strength is None:
        return NO_TRUE_STRENGTH
    # Where there are panes, `strength` is theirs.
    return NO_STRENGTH if "mask" in frame.layers else (frame.layers["strength"] - truth.strength).abs()


def _reflective(truth: TrueSurface) -> Tensor | str:
    return NO_TRUE_STRENGTH if truth.strength is None else truth.covered & (truth.strength > REFLECTIVE)


def _mean(errors: Tensor | str, region: Tensor | str, too_few: str) -> Outcome:
    """Mean error over a region, or the first reason why there is none."""
    if isinstance(errors, str):
        return errors
    if isinstance(region, str):
        return region
    return float(errors[region].to(torch.float64).mean()) if int(region.sum()) >= SMALLEST_REGION else too_few
