"""Names and meanings of metrics, and a metric's value or the reason why there is none."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

Outcome = float | str
"""A metric's value, or a sentence on why there is none."""

SMALLEST_REGION = 100
"""Pixels that a view's region needs to count; a sliver of a pane says nothing."""
NO_LPIPS = "no LPIPS"


def json_values(outcomes: Mapping[str, Outcome]) -> dict[str, Any]:
    """JSON values: numbers as they are; None, and `<name>_reason`, where there is no finite number."""
    result: dict[str, Any] = {}
    for name, outcome in outcomes.items():
        reason = outcome if isinstance(outcome, str) else "infinite: the images are equal"
        is_number = not isinstance(outcome, str) and math.isfinite(outcome)
        result |= {name: outcome} if is_number else {name: None, f"{name}_reason": reason}
    return result


class Metric(NamedTuple):
    """Presentation of a metric: label, pattern with its unit, and a sentence about it."""

    label: str
    pattern: str
    meaning: str


METRICS = {
    "psnr": Metric("PSNR", "{:.2f} dB", "peak signal-to-noise ratio of the test images; higher is better"),
    "corrected_psnr": Metric(
        "PSNR, colours corrected",
        "{:.2f} dB",
        "the same after the affine transform of colours that brings each image closest to its photograph",
    ),
    "right_half_psnr": Metric(
        "PSNR, right halves", "{:.2f} dB", "of the right half of each image after the transform found on its left half"
    ),
    "ssim": Metric("SSIM", "{:.4f}", "structural similarity, 1 for equal images; higher is better"),
    "lpips": Metric("LPIPS", "{:.4f}", "perceptual distance by a trained network, 0 for equal images; lower is better"),
    "pane_psnr": Metric("PSNR, pane", "{:.2f} dB", "the same of the pixels that show a pane"),
    "transmission_psnr": Metric(
        "PSNR, transmission", "{:.2f} dB", "of what is seen through the panes, against the truth"
    ),
    "reflection_psnr": Metric(
        "PSNR, reflection", "{:.2f} dB", "of what the panes mirror, times the reflection gain, against the truth"
    ),
}
SURFACE_METRICS = {
    "reflective_psnr": Metric(
        "PSNR, reflective", "{:.2f} dB", "PSNR of the pixels of which the surface mirrors more than half"
    ),
    "normal_error_deg": Metric("normal error", "{:.2f}°", "mean angle between rendered and true surface normals"),
    "reflective_normal_error_deg": Metric(
        "normal error, reflective", "{:.2f}°", "the same where the surface mirrors more than half"
    ),
    "strength_error": Metric("strength error", "{:.3f}", "mean difference of the share that is mirrored, 0 to 1"),
    "environment_psnr": Metric(
        "PSNR, environment", "{:.2f} dB", "of the learned surroundings, times the environment gain, against the truth"
    ),
    "environment_lpips": Metric("LPIPS, environment", "{:.4f}", "the same as a perceptual distance; lower is better"),
}
"""Shown where they are known: only synthetic captures of objects have the truth they need."""
FACTS = {
    "num_gaussians": Metric("Gaussians", "{:,}", "how many the scene has"),
    "train_seconds": Metric("training", "{:.0f} s", "time that training took"),
    "seconds_per_frame": Metric("per frame", "{:.3f} s", "time for one test image, median"),
    "reflection_gain": Metric(
        "reflection gain",
        "{:.2f}",
        "the one factor that brings all rendered reflections closest to the true ones: their brightness cannot be told "
        "from the panes' strength; 1 where both are equally bright",
    ),
}
SURFACE_FACTS = {
    "environment_gain": Metric(
        "environment gain", "{:.2f}", "the one factor that brings the learned surroundings closest to the true ones"
    )
}
PLANE_COLUMNS = {
    "label": Metric("pane", "{}", "its label in the masks"),
    "base_reflectance": Metric("R0", "{:.3f}", "share of the light that the pane mirrors when seen head-on"),
    "normal_error_deg": Metric("normal error", "{:.2f}°", "angle between the fitted plane and the true pane"),
    "offset_error": Metric(
        "offset error, of the extent",
        "{:.3%}",
        "distance of the true pane's centre from the fitted plane, in percent of the extent, which is 1.1 times the "
        "radius of the training cameras",
    ),
    "base_reflectance_error": Metric("R0 error", "{:.3f}", "difference from the true R0"),
    "normal_drift_deg": Metric("normal drift", "{:.2f}°", "angle between the trained plane and that of the masks"),
    "offset_drift": Metric(
        "offset drift, of the extent", "{:.3%}", "distance of the centre of the masks' plane from the trained plane"
    ),
}


def written(value: object, pattern: str) -> str:
    """A value with its unit; a dash where there is none."""
    return "-" if value is None else pattern.format(value)


def shown_metrics(results: Mapping[str, Any]) -> dict[str, Metric]:
    """The metrics to show of an evaluation: all of any method, and those of surfaces that are known."""
    always, known = METRICS | FACTS, SURFACE_METRICS | SURFACE_FACTS
    return {
        name: metric
        for name, metric in (METRICS | SURFACE_METRICS | FACTS | SURFACE_FACTS).items()
        if (name in always and name in results) or (name in known and results.get(name) is not None)
    }


def missing_reasons(results: Mapping[str, Any]) -> dict[str, list[str]]:
    """Reasons why shown metrics have no value, each with the names of the metrics."""
    reasons: dict[str, list[str]] = {}
    for name in shown_metrics(results):
        if results[name] is None:
            reasons.setdefault(results.get(f"{name}_reason") or "not recorded", []).append(name)
    return reasons
