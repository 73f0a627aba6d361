"""Metrics of images, panes, surfaces and environments.

LPIPS is that of Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric" (CVPR 2018).

The brightness of an environment trades off against the strength with which surfaces reflect it, so the learned map is
first scaled by one factor to the energy of the true one (3DGS-DR, Section 4.1). Energy is the mean of sRGB values over
the sphere: 3DGS-DR blends the reflection in sRGB, where the trade-off is exact.
"""

from __future__ import annotations

import importlib.metadata
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from glassplat.errors import convert_to_input_error
from glassplat.evaluate.truth import UNKNOWN_SURFACE, GroundTruth, TrueSurface
from glassplat.files.sidecars import read_equirect
from glassplat.kernels.photometric import photometric
from glassplat.render.deferred import equirect_from_environment
from glassplat.render.frame import Frame
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene

Outcome = float | str
"""A metric's value, or the reason why there is none."""

SMALLEST_REGION = 100
"""Minimum number of pixels of a view's region; a sliver of a pane is not informative."""
NO_LPIPS = "no LPIPS"


def json_values(outcomes: Mapping[str, Outcome]) -> dict[str, Any]:
    """JSON values: finite numbers are unchanged; others become None, with a `<name>_reason`."""
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
        "the same after the affine colour transform that best matches each image to its photograph",
    ),
    "right_half_psnr": Metric(
        "PSNR, right halves",
        "{:.2f} dB",
        "the same for the right half of each image, with the transform fitted to its left half",
    ),
    "ssim": Metric("SSIM", "{:.4f}", "structural similarity, 1 for equal images; higher is better"),
    "lpips": Metric("LPIPS", "{:.4f}", "perceptual distance by a trained network, 0 for equal images; lower is better"),
    "pane_psnr": Metric("PSNR, pane", "{:.2f} dB", "PSNR of the pixels that show a pane; higher is better"),
    "transmission_psnr": Metric(
        "PSNR, transmission", "{:.2f} dB", "PSNR of the transmission over the panes, against the truth"
    ),
    "reflection_psnr": Metric(
        "PSNR, reflection",
        "{:.2f} dB",
        "PSNR of the reflection over the panes, scaled by the reflection gain, against the truth",
    ),
}
SURFACE_METRICS = {
    "reflective_psnr": Metric(
        "PSNR, reflective", "{:.2f} dB", "PSNR of the pixels whose surface reflects more than half"
    ),
    "normal_error_deg": Metric("normal error", "{:.2f}°", "mean angle between rendered and true surface normals"),
    "reflective_normal_error_deg": Metric(
        "normal error, reflective", "{:.2f}°", "the same where the surface reflects more than half"
    ),
    "strength_error": Metric("strength error", "{:.3f}", "mean absolute error of the reflection strength, 0 to 1"),
    "environment_psnr": Metric(
        "PSNR, environment",
        "{:.2f} dB",
        "PSNR of the learned environment, scaled by the environment gain, against the truth",
    ),
    "environment_lpips": Metric("LPIPS, environment", "{:.4f}", "the same as a perceptual distance; lower is better"),
}
"""Shown if they are known: only synthetic captures of objects have the necessary ground truth."""
FACTS = {
    "num_gaussians": Metric("Gaussians", "{:,}", "how many the scene has"),
    "train_seconds": Metric("training", "{:.0f} s", "training time, without compilation of kernels"),
    "seconds_per_frame": Metric("per frame", "{:.3f} s", "median time to render a test image"),
    "reflection_gain": Metric(
        "reflection gain",
        "{:.2f}",
        "the common factor that best matches the rendered reflections to the true ones, because brightness and "
        "strength cannot be told apart; 1 if both are equally bright",
    ),
}
SURFACE_FACTS = {
    "environment_gain": Metric(
        "environment gain", "{:.2f}", "the factor that best matches the learned environment to the true one"
    )
}
PLANE_COLUMNS = {
    "label": Metric("pane", "{}", "its label in the masks"),
    "base_reflectance": Metric("R0", "{:.3f}", "share of light that the pane reflects at normal incidence"),
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


def format_value(value: object, pattern: str) -> str:
    """A value with its unit; a dash if there is none."""
    return "-" if value is None else pattern.format(value)


def shown_metrics(results: Mapping[str, Any]) -> dict[str, Metric]:
    """The metrics to show for an evaluation: general ones always, those of surfaces only if they are known."""
    always = METRICS | FACTS
    return {
        name: metric
        for name, metric in (METRICS | SURFACE_METRICS | FACTS | SURFACE_FACTS).items()
        if name in results and (name in always or results[name] is not None)
    }


def missing_reasons(results: Mapping[str, Any]) -> dict[str, list[str]]:
    """Reasons why shown metrics have no value, each with the names of the metrics."""
    reasons: dict[str, list[str]] = {}
    for name in shown_metrics(results):
        if results[name] is None:
            reasons.setdefault(results.get(f"{name}_reason") or "not recorded", []).append(name)
    return reasons


def partial_means(results: Mapping[str, Any]) -> dict[int, list[str]]:
    """Names of the shown metrics that are means over some of the test views only, by the number of these views."""
    counts: dict[int, list[str]] = {}
    for name in shown_metrics(results):
        if results[name] is not None and (count := results.get(f"{name}_views")):
            counts.setdefault(count, []).append(name)
    return counts


def quantize(image: Tensor, what: str = "image") -> Tensor:
    """The image as it would be stored: clamped to [0, 1] and rounded to uint8; uint8 passes through.

    `what` names it in the error.

    Raises:
        TypeError: the image is neither uint8 nor floating point.
        ValueError: a value is not finite.
    """
    if image.dtype == torch.uint8:
        return image
    if not image.is_floating_point():
        raise TypeError(f"expected a uint8 or floating-point image, got {image.dtype}; convert it first")
    if not bool(torch.isfinite(image).all()):
        raise ValueError(f"the {what} contains non-finite values; expected sRGB in [0, 1]")
    return torch.round(image.detach().clamp(0, 1) * 255).to(torch.uint8)


def psnr(image: Tensor, target: Tensor, region: Tensor | None = None) -> float:
    """Peak signal-to-noise ratio in decibels; infinite for equal images.

    Args:
        image: [..., 3] sRGB, uint8 or floating point in [0, 1]; quantised here.
        target: of the same shape.
        region: [...] bool; only these pixels count, with equal weight. None takes all.

    Raises:
        ValueError: shapes disagree, or no pixel counts.
    """
    _check_shapes(image, target)
    difference = quantize(image).to(torch.float64) - quantize(target).to(torch.float64)
    if region is not None:
        if region.dtype != torch.bool or region.shape != image.shape[:-1]:
            raise ValueError(
                f"expected a boolean region of shape {list(image.shape[:-1])}, got {region.dtype} {list(region.shape)}"
            )
        difference = difference[region]
    if difference.numel() == 0:
        raise ValueError("no pixels to compare; expected a non-empty region")
    return decibels(difference.square().mean().item())


def decibels(mean_square: float) -> float:
    """PSNR of a mean squared difference between values from 0 to 255; infinite for 0."""
    return math.inf if mean_square == 0 else 10 * math.log10(255**2 / mean_square)


def is_too_small(region: Tensor | None) -> bool:
    """Return whether a region [H, W] is too small for a metric; None, the whole image, never is."""
    return region is not None and int(region.sum()) < SMALLEST_REGION


def correct_colors(image: Tensor, target: Tensor, columns: slice = slice(None), region: Tensor | None = None) -> Tensor:
    """The image [H, W, 3] after the affine colour transform that fits it to another one in least squares.

    Exposure and white balance of a test photograph are unknown; the remaining error is due to the scene.

    Args:
        image: sRGB, uint8 or floating point in [0, 1].
        target: of the same shape.
        columns: of the pixels that the transform is fitted to.
        region: [H, W] bool, those of them that count; all if None.
    """
    _check_shapes(image, target)
    source, wanted = (quantize(pixels).to(torch.float64) / 255 for pixels in (image, target))
    chosen = torch.ones(image.shape[:2], dtype=torch.bool) if region is None else region
    known = source[:, columns][chosen[:, columns]]
    known = torch.cat([known, torch.ones_like(known[:, :1])], dim=1)
    # Regularised towards the identity, because pixels of a single colour, say, do not determine the transform.
    rest = wanted[:, columns][chosen[:, columns]] - known[:, :3]
    transform = torch.linalg.solve(known.T @ known + 1e-3 * torch.eye(4, dtype=torch.float64), known.T @ rest)
    return (source + source @ transform[:3] + transform[3]).to(torch.float32)


def ssim(image: Tensor, target: Tensor) -> float:
    """Mean structural similarity of two images [H, W, 3]; Gaussian window 11, sigma 1.5, as in 3DGS.

    Raises:
        ValueError: shapes disagree.
    """
    _check_shapes(image, target)
    return float(photometric(quantize(image).to(torch.float32) / 255, quantize(target)).ssim)


MOST_ROUNDS = 20
"""Maximum number of rounds of the search for clipped pixels; two or three usually suffice."""


def reflection_gain(images: list[Tensor], targets: list[Tensor]) -> float:
    """The common factor on `images` that, clipped at white, fits them to `targets` in least squares.

    The reflection layer's scale trades off against the strength and the intensity a(u), so it is compared up to a
    factor shared by the whole scene. It is 1 for black images. A photograph of a lamp is white however bright the lamp
    is, so clipped pixels do not contribute.

    Args:
        images: pixels [P, 3], floating point; one entry per view, of any number of pixels.
        targets: the same shapes.
    """
    pairs = [(a.to(torch.float64), b.to(torch.float64)) for a, b in zip(images, targets, strict=True)]
    below = [(image[target < 1], target[target < 1]) for image, target in pairs]
    gain = _least_squares(below if any(len(target) for _, target in below) else pairs)
    for _ in range(MOST_ROUNDS):
        before, seen = gain, [(image[gain * image < 1], target[gain * image < 1]) for image, target in pairs]
        if not any(len(target) for _, target in seen):
            break
        gain = _least_squares(seen)
        if gain == before:
            break
    return gain


def _least_squares(pairs: list[tuple[Tensor, Tensor]]) -> float:
    """The least-squares factor on the first of each pair; 1 if it is undetermined."""
    power = sum((image.square().sum().item() for image, _ in pairs), 0.0)
    product = sum(((image * target).sum().item() for image, target in pairs), 0.0)
    return product / power if power > 0 else 1.0


def _check_shapes(image: Tensor, target: Tensor) -> None:
    if image.shape != target.shape or image.shape[-1] != 3:
        raise ValueError(f"expected two images of one shape [..., 3], got {list(image.shape)} and {list(target.shape)}")


PLANE_ERRORS = ("normal_error_deg", "offset_error", "base_reflectance_error")


def plane_table(
    planes: Planes, truth: GroundTruth | None, extent: float, marked: Planes | None = None
) -> list[dict[str, Any]]:
    """One entry per fitted plane: label, center, normal, base_reflectance, and its errors.

    `normal_error_deg` is the angle between the normals regardless of sign, `offset_error` the distance of the true
    centre from the fitted plane over `extent`, and `base_reflectance_error` an absolute difference. Without a true pane
    of that label they are None, each with a reason. Glass that may be tinted has its RGB `transmittance`.
    `normal_drift_deg` and `offset_drift` are the same measures relative to the plane fitted to the masks, if known.

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
            true = true_planes[label]
            turn, offset = _plane_difference(entry, true.center, true.normal)
            difference = abs(entry["base_reflectance"] - true.base_reflectance)
            entry |= dict(zip(PLANE_ERRORS, (turn, offset / extent, difference), strict=True))
        else:
            entry |= dict.fromkeys(PLANE_ERRORS) | {f"{name}_reason": missing for name in PLANE_ERRORS}
        if marked is not None and label in marked.labels:
            row = marked.labels.index(label)
            turn, offset = _plane_difference(entry, marked.centers[row].tolist(), marked.normals[row].tolist())
            entry |= {"normal_drift_deg": turn, "offset_drift": offset / extent}
        table.append(entry)
    return table


def missing_panes(planes: Planes, truth: GroundTruth | None) -> list[int]:
    """Labels of true panes without a fitted plane."""
    return [] if truth is None else sorted({plane.label for plane in truth.planes} - set(planes.labels))


def _plane_difference(fitted: dict[str, Any], center: Sequence[float], normal: Sequence[float]) -> tuple[float, float]:
    """Angle between the normals in degrees, and the distance of the other plane's centre from the fitted plane."""
    own = torch.tensor(fitted["normal"], dtype=torch.float64)
    angle = angular_errors_deg(own, torch.tensor(normal, dtype=torch.float64)).item()
    apart = torch.tensor(center, dtype=torch.float64) - torch.tensor(fitted["center"], dtype=torch.float64)
    return min(angle, 180 - angle), (apart @ own).abs().item()


REFLECTIVE = 0.5
"""True strength above which a pixel counts as reflective: it mirrors more than half of its light."""
NO_DIRECTION_DEG = 90.0
"""The error of a vector without direction: the mean error of a random guess."""
NO_NORMALS, NO_STRENGTH = "the method renders no normals", "the method renders no strength"
NO_TRUE_NORMALS = "there are no true normals for the photograph"
NO_TRUE_STRENGTH = "there is no true strength for the photograph"
NO_SURFACE_PIXELS = f"fewer than {SMALLEST_REGION} pixels show a surface"
NO_REFLECTIVE_PIXELS = f"fewer than {SMALLEST_REGION} pixels reflect more than half"


def surface_metrics(frame: Frame, photo: Tensor, truth: TrueSurface | None) -> dict[str, Outcome]:
    """`reflective_psnr`, `normal_error_deg`, `reflective_normal_error_deg` and `strength_error` of one view.

    Args:
        frame: its image as photographed, and its layers `normal` [H, W, 3], world axes, of any length, and `strength`
            [H, W].
        photo: [H, W, 3] uint8.
        truth: the true surface at the frame's size; None if unknown.
    """
    truth = truth or UNKNOWN_SURFACE
    normal_errors = _normal_errors(frame, truth)
    return {
        "reflective_psnr": _reflective_psnr(frame, photo, truth),
        "normal_error_deg": _mean_error(normal_errors, truth.covered, NO_SURFACE_PIXELS),
        "reflective_normal_error_deg": _mean_error(normal_errors, _reflective_region(truth), NO_REFLECTIVE_PIXELS),
        "strength_error": _mean_error(_strength_errors(frame, truth), truth.covered, NO_SURFACE_PIXELS),
    }


def angular_errors_deg(vectors: Tensor, truth: Tensor) -> Tensor:
    """Angles [...] in degrees between vectors [..., 3] of any length; 90 where one has no direction."""
    a, b = vectors.to(torch.float64), truth.to(torch.float64)
    # The arc tangent keeps its precision for small angles; the arc cosine does not.
    angles = torch.rad2deg(torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(dim=-1)))
    lengths = a.norm(dim=-1) * b.norm(dim=-1)
    return torch.where((lengths > 0) & torch.isfinite(lengths), angles, NO_DIRECTION_DEG)


def _reflective_psnr(frame: Frame, photo: Tensor, truth: TrueSurface) -> Outcome:
    region = _reflective_region(truth)
    if isinstance(region, str):
        return region
    return NO_REFLECTIVE_PIXELS if is_too_small(region) else psnr(frame.photographed, photo, region)


def _normal_errors(frame: Frame, truth: TrueSurface) -> Tensor | str:
    if truth.normals is None:  # Checked first: evaluation may skip normals that the method can render.
        return NO_TRUE_NORMALS
    return angular_errors_deg(frame.layers["normal"], truth.normals) if "normal" in frame.layers else NO_NORMALS


def _strength_errors(frame: Frame, truth: TrueSurface) -> Tensor | str:
    if "strength" not in frame.layers:
        return NO_STRENGTH
    if truth.strength is None:
        return NO_TRUE_STRENGTH
    # In scenes with panes, `strength` is that of the panes.
    return NO_STRENGTH if "mask" in frame.layers else (frame.layers["strength"] - truth.strength).abs()


def _reflective_region(truth: TrueSurface) -> Tensor | str:
    return NO_TRUE_STRENGTH if truth.strength is None else truth.covered & (truth.strength > REFLECTIVE)


def _mean_error(errors: Tensor | str, region: Tensor | str, too_few: str) -> Outcome:
    """Mean error over a region, or the first reason why there is none."""
    if isinstance(errors, str):
        return errors
    if isinstance(region, str):
        return region
    return too_few if is_too_small(region) else float(errors[region].to(torch.float64).mean())


SMALLEST_SIDE = 32
"""Minimum side of an image for LPIPS, pixels."""


LPIPS_BACKBONE = "vgg"
"""The network that splatting papers use; values of different networks are not comparable."""
Lpips = Callable[[Tensor, Tensor], float]
"""The distance of two images [H, W, 3], uint8, at least `SMALLEST_SIDE` pixels a side."""


def load_lpips() -> Lpips | str:
    """LPIPS, or the reason why it is unavailable.

    Images enter the network scaled to [-1, 1], as the authors define it. (3DGS's own script feeds [0, 1], so its
    published numbers differ slightly.) torchmetrics needs torchvision, which downloads the weights on first use.
    """
    try:
        from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

        network = LearnedPerceptualImagePatchSimilarity(net_type=LPIPS_BACKBONE, normalize=True)
    except ImportError:
        return "pip install 'glassplat[lpips]'"
    except (OSError, RuntimeError) as error:  # torchvision of another build, or weights that are unavailable.
        return _build_mismatch() or f"torchmetrics cannot load it: {error}"

    def distance(image: Tensor, target: Tensor) -> float:
        with torch.no_grad():
            return float(network(_as_batch(image), _as_batch(target)))

    return distance


def _build_mismatch() -> str | None:
    """Reason and remedy if torchvision was built for another PyTorch; None otherwise."""
    try:
        importlib.import_module("torchvision")
    except RuntimeError:
        version, _, build = torch.__version__.partition("+")
        index = f" --index-url https://download.pytorch.org/whl/{build}" if build else ""
        return (
            f"torchvision {importlib.metadata.version('torchvision')} is of another build than PyTorch "
            f"{torch.__version__}: pip uninstall torchvision, then pip install torchvision torch=={version}{index}"
        )
    return None


def _as_batch(image: Tensor) -> Tensor:
    """[1, 3, H, W] in [0, 1]."""
    return (image.cpu().to(torch.float32) / 255).permute(2, 0, 1)[None]


NO_ENVIRONMENT = "the method learns no environment"
NO_TRUE_ENVIRONMENT = "the data set has no true environment"
PANORAMA_HEIGHT = 64
"""Height in rows at which environments are compared."""


def learned_environment(scene: Scene) -> Tensor | None:
    """The scene's environment as a panorama [H, 2H, 3]; None if it has none."""
    if scene.environment.is_empty:
        return None
    with torch.no_grad():
        return equirect_from_environment(scene.environment, PANORAMA_HEIGHT).cpu()


def true_environment(capture: Path) -> Tensor | None:
    """The panorama [h, 2h, 3] that a synthetic capture ships as `environment.exr` or `environment.png`, if any.

    Raises:
        InputError: the file is broken.
    """
    for path in (capture / f"environment{suffix}" for suffix in (".exr", ".png")):
        if path.is_file():
            with convert_to_input_error():
                return read_equirect(path)
    return None


def environment_metrics(learned: Tensor | None, truth: Tensor | None, lpips: Lpips | str) -> dict[str, Outcome]:
    """`environment_psnr`, `environment_gain` and `environment_lpips` of a scene.

    The learned map is scaled by the gain, 1 if it is black. PSNR, in decibels, weights directions by solid angle, and
    is infinite for equal maps; LPIPS compares the panoramas as plain images (the paper's measure).

    Args:
        learned: [H, 2H, 3] panorama, sRGB, floating point; None if the method learns none.
        truth: [h, 2h, 3] of the same kind, downsampled by area averaging if larger; None if unknown.
        lpips: the distance, or why there is none.
    """
    if learned is None or truth is None:
        reason = NO_ENVIRONMENT if learned is None else NO_TRUE_ENVIRONMENT
        return {"environment_psnr": reason, "environment_gain": reason, "environment_lpips": reason}
    source, wanted = (panorama.detach().cpu().to(torch.float64) for panorama in (learned, truth))
    if wanted.shape != source.shape:
        channels_first, size = wanted.permute(2, 0, 1)[None], source.shape[:2]
        wanted = torch.nn.functional.interpolate(channels_first, size, mode="area")[0].permute(1, 2, 0)
    energy = _mean_over_sphere(source)
    gain = _mean_over_sphere(wanted) / energy if energy > 0 else 1.0
    # The truth first: its values are part of the gain.
    target = quantize(wanted, "true environment")
    image = quantize(gain * source, "learned environment")
    mean_square = _mean_over_sphere((image.to(torch.float64) - target.to(torch.float64)).square())
    return {
        "environment_psnr": decibels(mean_square),
        "environment_gain": gain,
        "environment_lpips": NO_LPIPS if isinstance(lpips, str) else lpips(image, target),
    }


def _mean_over_sphere(values: Tensor) -> float:
    """Mean of [H, 2H, 3] by solid angle: rows shrink towards the poles with the cosine of their latitude."""
    height = values.shape[0]
    latitudes = math.pi * ((torch.arange(height, dtype=torch.float64) + 0.5) / height - 0.5)
    weights = torch.cos(latitudes)
    return float((values.mean(dim=(1, 2)) * weights).sum() / weights.sum())
