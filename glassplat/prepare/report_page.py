"""The report of a preparation as a page: reprojection errors, tracks, thumbnails, and a plan of the capture."""

from __future__ import annotations

import base64
import html
import io
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unicodedata import normalize

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.captures.dataset import Dataset, load_dataset
from glassplat.captures.view import PointCloud, View
from glassplat.errors import InputError
from glassplat.evaluate.report import STYLE
from glassplat.files.records import read_json
from glassplat.files.writing import write_text
from glassplat.options import check_value
from glassplat.panes.material import virtual_points
from glassplat.prepare.preparation import RECORD, Report
from glassplat.scene.camera import NumpyCamera
from glassplat.scene.corrections import natural_sort_key
from glassplat.scene.panes import Planes

Array = NDArray[np.float64]

PLAN_SIZE = (640, 440)
PLAN_MARGIN = 14
MOST_POINTS = 4000
"""Maximum number of points drawn; more are subsampled evenly."""
OUTLIERS = 4.0
"""Percentage of points at each end that may lie outside the plan, because some are outliers."""
RECTANGLE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
HEADING = 11.0
"""Length, in pixels, of a camera's line along its viewing direction."""


def plan_svg(views: Sequence[View], points: PointCloud, behind: NDArray[np.bool_], planes: Planes | None) -> str:
    """The plan as SVG.

    Args:
        views: cameras, in the order of the line that joins them.
        points: triangulated points.
        behind: [N] mask of those behind panes.
        planes: panes, if any are known.
    """
    cameras = [NumpyCamera.from_camera(view.camera) for view in views]
    axes = _plan_axes(cameras)
    centers = np.stack([camera.center for camera in cameras]) @ axes.T
    positions = points.positions.cpu().double().numpy() @ axes.T
    panes = [] if planes is None else [corners @ axes.T for corners in _corners(planes)]
    to_page = _page_map(positions, np.concatenate([centers, *panes]))
    colors = points.colors.cpu().numpy()
    drawn = [
        *_point_circles(to_page(positions), colors, behind),
        *(_polyline(to_page(pane[[0, 1, 2, 3, 0]]), "#ffd24a", 2) for pane in panes),
        _polyline(to_page(centers), "#3a76b8", 1),
        *_headings(cameras, axes, to_page),
    ]
    width, height = PLAN_SIZE
    return f'<svg width="{width}" height="{height}" viewBox="0 0 {width} {height}">{"".join(drawn)}</svg>'


def _plan_axes(cameras: Sequence[NumpyCamera]) -> Array:
    """[2, 3] axes of the plan, right and down, in world space; the mean viewing direction is up in the plan."""
    up = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    ahead = np.mean([camera.rotation[2] for camera in cameras], axis=0)
    ahead -= up * (ahead @ up)
    if np.linalg.norm(ahead) < 1e-3:  # The cameras face all directions.
        ahead = np.cross(up, cameras[0].rotation[0])
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    return np.stack([np.cross(ahead, up), -ahead])


def _corners(planes: Planes) -> list[Array]:
    """[4, 3] of each pane, in order around it."""
    centers, sizes = (one.detach().cpu().double().numpy() for one in (planes.centers, planes.half_sizes))
    tangents, bitangents = (axis.detach().cpu().double().numpy() for axis in planes.axes())
    sides = np.stack([tangents * sizes[:, :1], bitangents * sizes[:, 1:]], axis=1)
    return [center + RECTANGLE @ side for center, side in zip(centers, sides, strict=True)]


def _page_map(points: Array, required: Array) -> Callable[[Array], Array]:
    """The map from plan coordinates to pixels."""
    reach = np.percentile(points, [OUTLIERS, 100 - OUTLIERS], axis=0) if len(points) else required[:0].reshape(0, 2)
    everything = np.concatenate([reach, required])
    low, high = everything.min(axis=0), everything.max(axis=0)
    scale = float(((np.array(PLAN_SIZE) - 2 * PLAN_MARGIN) / np.maximum(high - low, 1e-9)).min())
    middle = (low + high) / 2
    return lambda one: np.asarray((one - middle) * scale + np.array(PLAN_SIZE) / 2)


def _point_circles(pixels: Array, colors: NDArray[np.uint8], behind: NDArray[np.bool_]) -> list[str]:
    every = max(1, -(-len(pixels) // MOST_POINTS))
    inside = np.all((pixels >= 0) & (pixels <= np.array(PLAN_SIZE)), axis=1).reshape(-1)
    shown = [int(row) for row in np.flatnonzero(inside)[::every]]
    return [
        f'<circle cx="{pixels[row][0]:.1f}" cy="{pixels[row][1]:.1f}" r="1.3" '
        f'fill="#{"ff4fd8" if behind[row] else colors[row].tobytes().hex()}"/>'
        for row in shown
    ]


def _polyline(pixels: Array, color: str, width: float) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)
    return f'<polyline points="{path}" fill="none" stroke="{color}" stroke-width="{width}"/>'


def _headings(cameras: Sequence[NumpyCamera], axes: Array, to_page: Callable[[Array], Array]) -> list[str]:
    strokes = []
    for camera in cameras:
        begin = to_page((camera.center @ axes.T)[None])[0]
        heading = axes @ camera.rotation[2]
        strokes.append(_polyline(np.stack([begin, begin + HEADING * heading]), "#7cc0ff", 1.5))
        strokes.append(f'<circle cx="{begin[0]:.1f}" cy="{begin[1]:.1f}" r="2.6" fill="#5aa9ff"/>')
    return strokes


THUMBNAIL = (160, 120)
MOST_THUMBNAILS = 200
"""Maximum number of thumbnails, which keeps the page below 2 MB; more are subsampled evenly."""
TRACK_BINS = (2, 3, 4, 5, 7, 10, 15, 1 << 30)
"""Edges of the bins by number of photographs per point; the upper edge is exclusive."""
ERROR_BINS = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0, np.inf)
FEW_POINTS = 50
"""A photograph with fewer points is poorly constrained."""

PAGE_STYLE = """
section { display: inline-block; vertical-align: top; margin: 0 36px 20px 0 }
h2 { font-size: 15px; margin: 12px 0 6px }
.bar { display: inline-block; height: 11px; background: #5aa9ff; border-radius: 2px }
.photographs { display: flex; flex-wrap: wrap; gap: 10px }
.photographs figure { width: 160px; margin: 0; font-size: 12px; color: #a0a6ae }
.photographs figure.weak { color: #ffb454 }
.photographs img { cursor: auto }
.advice { color: #ffb454 }
svg { background: #0c0d0f; border-radius: 8px }
"""


def write_page(capture: Path, target: Path, planes: Planes | None = None) -> None:
    """Writes the page of a capture made by `glassplat prepare`; the page is self-contained.

    Args:
        capture: the folder.
        target: the file to write.
        planes: of its marked panes; points behind them are counted and shown.
    """
    report = _read_report(capture / RECORD)
    dataset = load_dataset(capture)
    from glassplat.captures.colmap_library import pycolmap  # Slow to import; `info` only needs the name of this page.

    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    write_text(target, _page(report, dataset, model, planes, capture.resolve().name))


def _read_report(path: Path) -> Report:
    advice = "prepare the capture again to get its report"
    try:
        record = read_json(path)
    except ValueError as error:
        raise InputError(f"{error}; {advice}") from error
    try:
        found: Report = check_value(Report, record.get("report") if isinstance(record, dict) else record)
        return found
    except ValueError as error:
        raise InputError(f"the report in {path}: {error}; {advice}") from error


def _page(report: Report, dataset: Dataset, model: Any, planes: Planes | None, title: str) -> str:
    views = sorted((*dataset.train, *dataset.test), key=lambda view: natural_sort_key(view.name))
    behind = _points_behind_panes(dataset, planes)
    points = list(model.points3D.values())
    tracks = np.array([point.track.length() for point in points])
    errors = np.array([point.error for point in points])
    legend = "cameras in blue, joined in the order of their names; points in their colours"
    legend += "" if planes is None else ", those behind panes in magenta; panes in yellow"
    body = [
        f"<h1>{html.escape(title)}</h1>",
        f'<div class="cards">{"".join(_cards(report, behind, planes))}</div>',
        *(f'<p class="advice">{html.escape(line)}</p>' for line in report.advice),
        f"<section><h2>Plan</h2>{plan_svg(views, dataset.points, behind, planes)}<p>{legend}</p></section>",
        f"<section>{_histogram('Points by number of photographs', tracks, TRACK_BINS)}"
        f"{_histogram('Points by reprojection error, in pixels', errors, ERROR_BINS)}</section>",
        "<h2>Photographs</h2>",
        f'<div class="photographs">{"".join(_figures(views, model))}</div>',
    ]
    if report.missing:
        body += ["<h2>Not registered</h2>", f'<p class="advice">{html.escape(", ".join(report.missing))}</p>']
    head = f'<meta charset="utf-8"><title>{html.escape(title)}</title><style>{STYLE}{PAGE_STYLE}</style>'
    return f"<!doctype html>\n<html><head>{head}</head><body>\n" + "\n".join(body) + "\n</body></html>\n"


def _points_behind_panes(dataset: Dataset, planes: Planes | None) -> NDArray[np.bool_]:
    """[N] mask of points that most photographs show through a pane."""
    if planes is None:
        return np.zeros(len(dataset.points), dtype=bool)
    cameras = [view.camera for view in dataset.train]
    found: NDArray[np.bool_] = virtual_points(dataset.points.positions, planes, cameras).cpu().numpy()
    return found


def _cards(report: Report, behind: NDArray[np.bool_], planes: Planes | None) -> list[str]:
    share = behind.sum() / max(len(behind), 1)
    facts = {
        "photographs registered": f"{report.registered} of {report.photographs}",
        "points": f"{report.points:,}",
        "mean reprojection error, in pixels": f"{report.reprojection_error:.2f}",
        "photographs per point": f"{report.track_length:.1f}",
        "features per photograph": f"{report.features:,}",
        "points behind panes": "no panes yet" if planes is None else f"{behind.sum():,} ({share:.0%})",
        "settings": f"{report.attempt} (of {report.attempts} tried)",
    }
    facts |= {f"camera {number}": camera for number, camera in enumerate(report.cameras, start=1)}
    return [f"<div><b>{html.escape(str(value))}</b><span>{name}</span></div>" for name, value in facts.items()]


def _histogram(title: str, values: NDArray[Any], edges: Sequence[float]) -> str:
    """A histogram as a table; the last bin is open."""
    counts = [int(((values >= low) & (values < high)).sum()) for low, high in itertools.pairwise(edges)]
    most = max([*counts, 1])
    rows = [
        f'<tr><td>{_bin_label(low, high)}</td><td>{count:,}</td><td style="text-align: left"><span class="bar" '
        f'style="width: {240 * count / most:.0f}px"></span></td></tr>'
        for (low, high), count in zip(itertools.pairwise(edges), counts, strict=True)
    ]
    return f"<h2>{title}</h2><table>{''.join(rows)}</table>"


def _bin_label(low: float, high: float) -> str:
    if high >= 1 << 30:
        return f"{low:g} and more"
    last = high - 1 if isinstance(low, int) else high
    return f"{low:g}" if last == low else f"{low:g} to {last:g}"


def _figures(views: Sequence[View], model: Any) -> Iterator[str]:
    """Thumbnails of photographs, each with the number of its points and the mean of their reprojection errors."""
    # Accents may be encoded in another way in file names than in the model.
    images = {normalize("NFC", image.name): image for image in model.images.values()}
    for view in views[:: -(-len(views) // MOST_THUMBNAILS)]:
        keys = [point.point3D_id for point in images[normalize("NFC", view.name)].points2D if point.has_point3D()]
        error = float(np.mean([model.points3D[key].error for key in keys])) if keys else 0.0
        weak, name = ' class="weak"' if len(keys) < FEW_POINTS else "", html.escape(view.name)
        yield (
            f'<figure{weak}><img src="{_thumbnail(view)}" alt="{name}">{name}<br>{len(keys)} points, '
            f"error {error:.2f} pixels</figure>"
        )


def _thumbnail(view: View) -> str:
    """Data URL of a small JPEG."""
    small = Image.fromarray(view.photo.cpu().numpy()).convert("RGB")
    small.thumbnail(THUMBNAIL)
    buffer = io.BytesIO()
    small.save(buffer, "JPEG", quality=70)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode()}"
