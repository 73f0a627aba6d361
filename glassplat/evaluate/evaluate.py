"""All metrics of a trained scene over the test views of its data set."""

from __future__ import annotations

import math
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from glassplat.captures.dataset import Dataset, detached_camera
from glassplat.captures.view import View, copy_ignored_pixels
from glassplat.errors import InputError
from glassplat.evaluate import metrics
from glassplat.evaluate.truth import TrueSurface, TrueView, load_truth, true_surface
from glassplat.kernels.photometric import photometric
from glassplat.render.frame import Frame, Renderer
from glassplat.render.panes import nearest_hits, panes_in_camera
from glassplat.render.planar import with_photographer
from glassplat.scene.camera import Camera
from glassplat.scene.corrections import Exposures, moved_camera
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene

NO_TRUTH = "the data set has no ground truth"
NO_VIEW_TRUTH = "the ground truth lacks this view"


class PaneRegions(NamedTuple):
    """The pixels that show panes, from a single source for the whole data set, so that means do not mix sources.

    Attributes:
        source: description of the region for readers of the metrics.
        find: returns the pixels of panes [H, W] bool from a view, its frame and its truth, or why they are unknown.
        planes: fitted to masks and measured points, independent of training; None if masks are not the source.
    """

    source: str
    find: Callable[[View, Frame, TrueView | None], Tensor | str]
    planes: Planes | None = None


def _rendered_region(view: View, frame: Frame, truth: TrueView | None) -> Tensor | str:
    if "mask" in frame.layers:
        return frame.layers["mask"] > 0.5
    return f"{NO_TRUTH}, and the method renders no mask"


TRUE_REGIONS = PaneRegions(
    "ground-truth pane labels", lambda view, frame, truth: NO_VIEW_TRUTH if truth is None else truth.labels > 0
)
RENDERED_REGIONS = PaneRegions("rendered mask > 0.5", _rendered_region)
"""As rendered by the method itself, so methods may be scored over different pixels."""


def marked_regions(planes: Planes) -> PaneRegions:
    """The view's mask or, without one, the area of the planes fitted to the masks, including objects in front."""

    def region(view: View, frame: Frame, truth: TrueView | None) -> Tensor | str:
        if view.pane_labels is not None:
            return view.pane_labels > 0
        return nearest_hits(panes_in_camera(planes, view.camera), view.camera).pane >= 0

    return PaneRegions("masks, and in views without one the planes fitted to them", region, planes)


ALIGNMENT_STEPS, SSIM_SHARE = 40, 0.2
"""Steps of the alignment of test views, and the weight of SSIM in its loss."""
FIRST_RATE, LAST_RATE = 1.5e-3, 5e-5
"""First and last learning rate of the alignment, in radians and extents; it decays exponentially."""
Listener = Callable[[int, int], None]


def with_aligned_test_views(
    scene: Scene, renderer: Renderer, dataset: Dataset, listen: Listener = lambda done, count: None
) -> Dataset:
    """The capture with each test camera moved to where the scene agrees best with its photograph.

    Poses from structure from motion have errors, and a scene whose training cameras were refined does not match the
    unrefined poses of test views. NeRF-- and BARF align test cameras in the same way; gsplat and nerfstudio do not.

    Args:
        scene: trained; not changed.
        renderer: renders it as photographs show it.
        dataset: with the test views to align.
        listen: called with the numbers of finished views and of all views.
    """
    test = []
    for done, view in enumerate(dataset.test):
        listen(done, len(dataset.test))
        test.append(view.with_camera(aligned_camera(scene, renderer, view)))
    return replace(dataset, test=tuple(test))


def aligned_camera(scene: Scene, renderer: Renderer, view: View) -> Camera:
    """The camera from which the scene is most similar to the view's photograph, starting at the view's own.

    The two are compared in the same colours as by `evaluate`.

    Args:
        scene: trained; gets no gradient.
        renderer: renders it as photographs show it.
        view: photograph and camera.
    """
    device = scene.primary.means.device
    detached = scene.with_parameters({name: tensor.detach() for name, tensor in scene.parameters().items()})
    camera, photo = view.camera.to(device), view.photo.to(device)
    exposures = detached.exposures.interpolate(view.name)
    twist = torch.zeros(6, device=device, requires_grad=True, dtype=torch.float32)
    optimizer = torch.optim.Adam([twist], lr=FIRST_RATE, betas=(0.8, 0.95))
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, (LAST_RATE / FIRST_RATE) ** (1 / ALIGNMENT_STEPS))
    best, lowest = torch.zeros_like(twist), torch.inf
    for _ in range(ALIGNMENT_STEPS):
        optimizer.zero_grad()
        image = renderer(detached, moved_camera(camera, twist, scene.extent)).exposed(exposures, view.name)
        found = photometric(copy_ignored_pixels(image, view), photo)
        loss = found.l1.lerp(1 - found.ssim, SSIM_SHARE)
        if (value := float(loss.detach())) < lowest:
            best, lowest = twist.detach().clone(), value
        if not loss.requires_grad:  # The scene is not visible.
            break
        loss.backward()
        optimizer.step()
        schedule.step()
    return detached_camera(moved_camera(camera, best, scene.extent))


MIRROR_STRENGTH = 0.999
"""True strength at and above which nothing is transmitted."""
ALL_IGNORED = f"fewer than {metrics.SMALLEST_REGION} pixels are not ignored"
LEFT_IGNORED = f"fewer than {metrics.SMALLEST_REGION} pixels of the left half are not ignored"
TOO_FEW = f"fewer than {metrics.SMALLEST_REGION} pixels show a pane"

SCENE_COLORS, NEIGHBOURS_COLORS = "the scene's own", "mean of the neighbouring photographs, by name"
"""Exposures assumed for test views."""


@dataclass(frozen=True)
class Evaluation:
    """Metrics as plain data, ready to be written as JSON.

    Attributes:
        results: one value per metric; if it is None, `<name>_reason` gives the reason. The mean over some of the test
            views only has their number as `<name>_views`.
        per_view: the same for every view by name, for metrics of single views.
    """

    results: dict[str, Any]
    per_view: dict[str, dict[str, Any]]


@dataclass(frozen=True)
class EvaluatedView:
    """A test view with its rendered frame.

    Attributes:
        view: the photograph and its camera.
        frame: as rendered, on the CPU, in the scene's colours.
        truth: the true layers, if known.
        surface: the true surface, if known.
        metrics: as in `Evaluation.per_view`, without the reflection's, which needs all views.
        exposures: of the photographs, including the one assumed for this view.
    """

    view: View
    frame: Frame
    truth: TrueView | None
    surface: TrueSurface | None
    metrics: Mapping[str, Any]
    exposures: Exposures = field(default_factory=Exposures.neutral)

    @property
    def photographed(self) -> Frame:
        """The frame with its image in the colours of the photograph, as used by the metrics."""
        return in_photograph_colors(self.frame, self.exposures, self.view.name)


ViewListener = Callable[[EvaluatedView], None]


def in_photograph_colors(frame: Frame, exposures: Exposures, name: str) -> Frame:
    """The frame with a layer `photographed` in the colours of that photograph; unchanged without an exposure for it."""
    if name not in exposures.names:
        return frame
    return replace(frame, layers={**frame.layers, "photographed": frame.exposed(exposures, name)})


@dataclass(frozen=True)
class _Measurement:
    """Metrics of one view; `reflection` holds rendered and true pane pixels until the gain is known."""

    metrics: dict[str, metrics.Outcome]
    seconds: float
    reflection: tuple[Tensor, Tensor] | str


def evaluate(
    scene: Scene,
    renderer: Renderer,
    dataset: Dataset,
    *,
    regions: PaneRegions | None = None,
    listen: ViewListener = lambda evaluated: None,
) -> Evaluation:
    """Renders and evaluates every test view, in uint8-quantised sRGB at the data set's resolution.

    `psnr`, `ssim` and `lpips` are means over the views. So are `corrected_psnr`, after the affine colour transform that
    best fits each render to its photograph, and `right_half_psnr`, of the right halves after the transform fitted to
    the left ones: the exposure of a test photograph is unknown. The region metrics are means over the views in which
    the region has at least 100 pixels: `pane_psnr` over the pane's pixels, `transmission_psnr` over those that transmit
    (true strength below 0.999) against `gt/trans`, `reflection_psnr` against `gt/refl` after one gain for the whole
    scene. `regions` defines the pixels of `pane_psnr`, and `pane_region` names their source. A method without layers is
    scored with its image as its transmission, because its user has nothing else.

    `reflective_psnr` is the PSNR over the pixels that mirror more than half of their light, if the true strength is
    known. `normal_error_deg` is the mean angle between the layer `normal` and the true normals over the pixels that
    show a surface; `reflective_normal_error_deg` is the same over those that mirror more than half. `strength_error` is
    the mean absolute error of the layer `strength`. `environment_psnr` compares the learned environment with the
    capture's `environment.exr` or `.png`, after one gain. `peak_memory_mib` is that of the whole process until now.

    Images are compared in the colours of their photographs, layers in those of the scene. If exposures were learned, a
    test view is assigned the mean exposure of its neighbours by name, which `test_exposures` records.

    Ignored pixels of a view are left out; `ssim` and `lpips`, which use windows, treat them as correct.

    Args:
        scene: to render.
        renderer: called under `no_grad`. The median of its times is `seconds_per_frame`.
        dataset: with the test views; its ground truth is read if there is any.
        regions: pixels that show panes; if None, those of the ground truth, or else of the rendered mask.
        listen: called once per view with its frame, which is not kept afterwards; draws reports, for example.

    Raises:
        InputError: no test views, a render that is not finite, or broken ground truth.
    """
    if not dataset.test:
        raise InputError(f"{dataset.root} has no test views; expected at least one image to compare with")
    truth = load_truth(dataset.truth)
    lpips = metrics.load_lpips()
    missing = NO_TRUTH if truth is None else NO_VIEW_TRUTH
    regions = regions or (RENDERED_REGIONS if truth is None else TRUE_REGIONS)
    # With a photographer, frames hold two images, with and without the photographer; rendering without is timed.
    timed = with_photographer(renderer, "absent") if len(scene.photographer) else renderer
    # The first frame may include compilation, so it is not counted.
    time_render(timed, scene, dataset.test[0])
    measurements, learned = {}, scene.exposures.to("cpu")
    for view in dataset.test:
        frame, seconds = time_render(renderer, scene, view)
        seconds = seconds if timed is renderer else time_render(timed, scene, view)[1]
        true_view = truth.view(view.name, view.camera.width, view.camera.height) if truth else None
        if true_view is not None and view.ignored is not None:
            true_view = replace(true_view, labels=true_view.labels.masked_fill(view.ignored, 0))
        surface = true_surface(view)
        pane = regions.find(view, frame, true_view)
        exposures = learned.interpolate(view.name)
        shown = in_photograph_colors(frame, exposures, view.name)
        measured = _measure(shown, seconds, view, pane, truth=true_view or missing, surface=surface, lpips=lpips)
        measurements[view.name] = measured
        listen(EvaluatedView(view, frame, true_view, surface, metrics.json_values(measured.metrics), exposures))
    gain = _add_reflection(measurements.values())
    per_view = {name: metrics.json_values(m.metrics) | {"seconds": m.seconds} for name, m in measurements.items()}
    results = _description(scene, dataset)
    results["seconds_per_frame"] = statistics.median(m.seconds for m in measurements.values())
    results |= metrics.json_values({"peak_memory_mib": peak_memory_mib()})
    results |= metrics.json_values(_mean_metrics([m.metrics for m in measurements.values()]))
    environments = metrics.learned_environment(scene), metrics.true_environment(dataset.root)
    results |= metrics.json_values(metrics.environment_metrics(*environments, lpips))
    results |= _footnotes(results, lpips, regions, gain)
    results["planes"] = metrics.plane_table(scene.planes, truth, dataset.extent, regions.planes)
    if len(scene.planes):
        results["missing_panes"] = metrics.missing_panes(scene.planes, truth)
    return Evaluation(results, per_view)


def time_render(renderer: Renderer, scene: Scene, view: View) -> tuple[Frame, float]:
    """A frame without gradients, on the CPU, and the seconds it took.

    Raises:
        InputError: the image is not finite.
    """
    with torch.no_grad():
        start = time.perf_counter()
        frame = renderer(scene, view.camera)
        # Reading a pixel synchronises with an asynchronous device.
        frame.rgb[0, 0, 0].item()
        seconds = time.perf_counter() - start
    layers = {name: layer.cpu() for name, layer in frame.layers.items()}
    frame = Frame(frame.rgb.cpu(), layers, background=frame.background)
    if not bool(torch.isfinite(frame.rgb).all()):
        raise InputError(f"the render of {view.name} contains non-finite values; the scene is broken, train it again")
    return frame, seconds


def peak_memory_mib() -> metrics.Outcome:
    """Peak resident set size of this process so far in MiB, or the reason why it is unknown."""
    try:
        import resource  # Windows has none.
    except ImportError:
        return f"not available on {sys.platform}"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def _measure(
    frame: Frame,
    seconds: float,
    view: View,
    pane: Tensor | str,
    *,
    truth: TrueView | str,
    surface: TrueSurface | None,
    lpips: metrics.Lpips | str,
) -> _Measurement:
    """Every metric of one view except the reflection's, which needs all views; `truth` may be why there is none."""
    image, photo, counted = frame.photographed, view.photo, None if view.ignored is None else ~view.ignored
    if counted is not None:
        image = copy_ignored_pixels(image, view)
        pane = pane if isinstance(pane, str) else pane & counted
        surface = surface and replace(surface, covered=surface.covered & counted)
    measured: dict[str, metrics.Outcome] = {
        "psnr": _counted_psnr(image, photo, counted),
        "corrected_psnr": _counted_psnr(metrics.correct_colors(image, photo, region=counted), photo, counted),
        "right_half_psnr": _right_half_psnr(image, photo, counted),
        "ssim": ALL_IGNORED if metrics.is_too_small(counted) else metrics.ssim(image, photo),
        "lpips": ALL_IGNORED if metrics.is_too_small(counted) else _lpips(lpips, image, photo),
        "pane_psnr": pane if isinstance(pane, str) else _region_psnr(image, photo, pane, TOO_FEW),
        "transmission_psnr": _transmission_psnr(frame, truth),
        **metrics.surface_metrics(frame, photo, surface),
    }
    return _Measurement(measured, seconds, _reflection_pixels(frame, truth))


def _lpips(lpips: metrics.Lpips | str, image: Tensor, photo: Tensor) -> metrics.Outcome:
    if isinstance(lpips, str):
        return metrics.NO_LPIPS
    if min(photo.shape[:2]) < metrics.SMALLEST_SIDE:
        return f"views of fewer than {metrics.SMALLEST_SIDE} pixels a side"
    return lpips(metrics.quantize(image), metrics.quantize(photo))


def _counted_psnr(image: Tensor, photo: Tensor, counted: Tensor | None) -> metrics.Outcome:
    """PSNR of the pixels that are not ignored."""
    return metrics.psnr(image, photo) if counted is None else _region_psnr(image, photo, counted, ALL_IGNORED)


def _right_half_psnr(image: Tensor, photo: Tensor, counted: Tensor | None) -> metrics.Outcome:
    """PSNR of the right half after the colour transform fitted to the left half (as in NeRF in the Wild)."""
    middle = max(photo.shape[1] // 2, 1)
    if counted is not None and metrics.is_too_small(counted[:, :middle]):
        return LEFT_IGNORED
    corrected = metrics.correct_colors(image, photo, slice(0, middle), counted)
    right = slice(min(middle, photo.shape[1] - 1), None)
    return _counted_psnr(corrected[:, right], photo[:, right], None if counted is None else counted[:, right])


def _region_psnr(image: Tensor, target: Tensor, region: Tensor, reason: str) -> metrics.Outcome:
    return reason if metrics.is_too_small(region) else metrics.psnr(image, target, region)


def _transmission_psnr(frame: Frame, truth: TrueView | str) -> metrics.Outcome:
    if isinstance(truth, str):
        return truth
    pane = truth.labels > 0
    reason = TOO_FEW if metrics.is_too_small(pane) else "the pane is a mirror, which transmits nothing"
    image = frame.layers.get("transmission", frame.rgb)
    return _region_psnr(image, truth.transmission, pane & (truth.strength < MIRROR_STRENGTH), reason)


def _reflection_pixels(frame: Frame, truth: TrueView | str) -> tuple[Tensor, Tensor] | str:
    """Rendered and true reflection [P, 3] at the pane's pixels; the true one in [0, 1], with lamps clipped to white."""
    if "reflection" not in frame.layers:
        return "the method renders no reflection"
    if isinstance(truth, str):
        return truth
    pane = truth.labels > 0
    if metrics.is_too_small(pane):
        return TOO_FEW
    return frame.layers["reflection"][pane], truth.reflection[pane].to(torch.float32) / 255


def _add_reflection(measurements: Iterable[_Measurement]) -> float | None:
    """Adds `reflection_psnr` to every view's metrics; returns the scene's gain, None without reflections."""
    measurements = list(measurements)
    pairs = [m.reflection for m in measurements if not isinstance(m.reflection, str)]
    gain = metrics.reflection_gain([image for image, _ in pairs], [target for _, target in pairs])
    for measurement in measurements:
        if isinstance(measurement.reflection, str):
            measurement.metrics["reflection_psnr"] = measurement.reflection
        else:
            image, target = measurement.reflection
            measurement.metrics["reflection_psnr"] = metrics.psnr((gain * image).clamp(0, 1), target)
    return gain if pairs else None


def _mean_metrics(per_view: list[dict[str, metrics.Outcome]]) -> dict[str, metrics.Outcome]:
    """Mean of every metric over the views that have it and are not perfect, or all reasons why there is none; if these
    are not all views, also their number as `<name>_views`.
    """
    means: dict[str, metrics.Outcome] = {}
    for name in per_view[0]:
        outcomes = [of_view[name] for of_view in per_view]
        values = [outcome for outcome in outcomes if not isinstance(outcome, str)]
        reasons = dict.fromkeys(outcome for outcome in outcomes if isinstance(outcome, str))
        counted = [value for value in values if value != math.inf] or values
        means[name] = statistics.fmean(counted) if counted else "; ".join(reasons)
        if 0 < len(counted) < len(outcomes):
            means[f"{name}_views"] = len(counted)
    return means


def _description(scene: Scene, dataset: Dataset) -> dict[str, Any]:
    """Settings of the evaluation, and sizes of the scene."""
    sizes = dict.fromkeys(f"{view.camera.width}x{view.camera.height}" for view in dataset.test)
    is_exposed = scene.exposures.covers_any(view.name for view in dataset.test)
    return {
        "resolution": ", ".join(sizes),
        "split": dataset.split,
        "num_test_views": len(dataset.test),
        "test_exposures": NEIGHBOURS_COLORS if is_exposed else SCENE_COLORS,
        "num_gaussians": scene.num_gaussians,
        "num_glass_gaussians": len(scene.glass),
        "num_surroundings_gaussians": len(scene.surroundings),
    }


def _footnotes(
    results: Mapping[str, Any], lpips: metrics.Lpips | str, regions: PaneRegions, gain: float | None
) -> dict[str, Any]:
    """Footnotes of the metrics: backbone, region, gain."""
    if isinstance(lpips, str):
        backbone = metrics.json_values({"lpips": lpips, "lpips_backbone": lpips})
    else:
        backbone = {"lpips_backbone": metrics.LPIPS_BACKBONE}
    if results["pane_psnr"] is None:
        region = metrics.json_values({"pane_region": results["pane_psnr_reason"]})
    else:
        region = {"pane_region": regions.source}
    gain_outcome = results["reflection_psnr_reason"] if gain is None else gain
    return backbone | region | metrics.json_values({"reflection_gain": gain_outcome})
