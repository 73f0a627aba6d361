"""Marks on a capture: a JSON document, shared by browser and disk, and the rasterisation of outlines to masks."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from filelock import FileLock
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from glassplat.annotate.fit import Marks, Shape
from glassplat.files.records import Choice, DictOf, Field, Integer, ListOf, Number, Optional, check_fields, read_json
from glassplat.files.writing import write_text
from glassplat.scene.camera import NumpyCamera

Material = Literal["glass", "mirror", "screen"]

ANNOTATIONS = "annotations.json"
LOCK = "annotations.lock"
"""An empty file that remains on systems that cannot lock folders."""
MOST_PANES, MOST_CORNERS, MOST_STROKES, MOST_STROKE_POINTS = 64, 32, 500, 20_000
"""Limits of one document: more than users mark, and small enough to process."""
FARTHEST = 1e6
PIXEL = ListOf(Number(-FARTHEST, FARTHEST), 2)


class ObjectField(Field):
    """A JSON object with known keys, as a field of another one."""

    expected = "an object"

    def __init__(self, fields: Mapping[str, Field]) -> None:
        self._fields = fields

    def _convert(self, value: Any, where: str) -> dict[str, Any]:
        return check_fields(value, self._fields, where)


STROKE = ObjectField(
    {
        "kind": Choice(("polygon", "brush")),
        "effect": Choice(("cut", "keep")),
        "radius": Optional(Number(0.1, 10_000), default=10.0),
        "points": ListOf(PIXEL),
    }
)
PANE = ObjectField(
    {
        "label": Integer(1, MOST_PANES),
        "material": Choice(("glass", "mirror", "screen")),
        "shape": Choice(("rectangle", "polygon")),
        "corners": ListOf(DictOf(PIXEL)),
        "edges": Optional(ListOf(DictOf(ListOf(PIXEL, 2))), default=()),
        "strokes": Optional(DictOf(ListOf(STROKE)), default={}),
    }
)
DOCUMENT: dict[str, Field] = {"version": Choice((1,)), "panes": ListOf(PANE)}


@dataclass(frozen=True)
class Stroke:
    """A region of one photograph that occluders of the pane cover, or do not cover.

    Attributes:
        kind: a filled polygon, or a brush line.
        effect: cut removes the region from the mask, keep restores it.
        radius: of the brush, in pixels of the photograph.
        points: [P, 2] pixels.
    """

    kind: Literal["polygon", "brush"]
    effect: Literal["cut", "keep"]
    radius: float
    points: Sequence[tuple[float, float]]


@dataclass(frozen=True)
class MarkedPane:
    """The marks of one pane; views are identified by the names of their photographs."""

    label: int
    material: Material
    shape: Shape
    corners: Sequence[Mapping[str, tuple[float, float]]]
    edges: Sequence[Mapping[str, tuple[tuple[float, float], ...]]]
    strokes: Mapping[str, Sequence[Stroke]]

    def marks(self, numbers: Mapping[str, int]) -> Marks:
        """Corners and edges by index of the view; marks in photographs that no longer exist are left out."""
        corners = [_by_view_index(pixels, numbers) for pixels in self.corners]
        edges = [_by_view_index(pixels, numbers) for pixels in self.edges[: len(corners)]]
        return Marks(corners, edges)

    def views(self) -> set[str]:
        """Names of the photographs with any mark of the pane."""
        marked = {name for pixels in (*self.corners, *self.edges) for name in pixels}
        return marked | {name for name, strokes in self.strokes.items() if strokes}


def _by_view_index(pixels: Mapping[str, Any], numbers: Mapping[str, int]) -> dict[int, Any]:
    return {numbers[name]: np.array(pixel, dtype=np.float64) for name, pixel in pixels.items() if name in numbers}


def parse_document(value: Any, where: str) -> tuple[MarkedPane, ...]:
    """The panes of a document, checked."""
    panes = tuple(_parse_pane(entry) for entry in check_fields(value, DOCUMENT, where)["panes"])
    labels = [pane.label for pane in panes]
    if len(set(labels)) != len(labels):
        raise ValueError(f"{where} has the labels {labels}; expected every label once")
    for pane in panes:
        strokes = [stroke for several in pane.strokes.values() for stroke in several]
        points = sum(len(stroke.points) for stroke in strokes)
        if len(pane.corners) > MOST_CORNERS or len(strokes) > MOST_STROKES or points > MOST_STROKE_POINTS:
            raise ValueError(
                f"pane {pane.label} of {where} has {len(pane.corners)} corners and {len(strokes)} strokes of {points} "
                f"points; expected at most {MOST_CORNERS} and {MOST_STROKES}, of {MOST_STROKE_POINTS} points"
            )
    return panes


def _parse_pane(pane: Mapping[str, Any]) -> MarkedPane:
    strokes = {name: tuple(Stroke(**stroke) for stroke in several) for name, several in pane["strokes"].items()}
    return MarkedPane(pane["label"], pane["material"], pane["shape"], pane["corners"], pane["edges"], strokes=strokes)


def read_document(folder: Path) -> Any:
    """The document of a capture as JSON; an empty one if nothing is marked yet."""
    path = folder / ANNOTATIONS
    if not path.exists():
        return {"version": 1, "panes": []}
    value = read_json(path)
    parse_document(value, str(path))
    return value


def document_version(value: Any) -> str:
    """Digest of the contents of a document."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:24]


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Keeps other programs from saving marks of a capture within the context, if its file system supports locks."""
    try:
        import fcntl
    except ImportError:  # Windows, where folders cannot be locked.
        with FileLock(folder / LOCK):
            yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def write_document(folder: Path, value: Any) -> None:
    """Writes a checked document."""
    write_text(folder / ANNOTATIONS, json.dumps(value, ensure_ascii=False, indent=1) + "\n")


Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

NEAR = 1e-3
"""Near plane at which an outline is clipped, as a share of its largest coordinate."""
FARTHEST_OUTSIDE = 1e5
"""Range in pixels to which the points of brush strokes are clamped."""


def project_outline(camera: NumpyCamera, corners: Array) -> Array:
    """[P, 2] the projected outline of a polygon [K, 3], clipped at the near plane; empty if it is behind the camera.

    Clipped ends lie far outside the photograph, at most 1 / `NEAR` focal lengths, which keeps edges straight.
    """
    return camera.pixels(_clip_near(camera.to_camera_axes(corners)))


def _clip_near(points: Array) -> Array:
    """[P, 3] a polygon clipped at the near plane (Sutherland and Hodgman's algorithm)."""
    near = NEAR * float(np.abs(points).max())
    kept: list[Array] = []
    for here, after in zip(points, np.roll(points, -1, axis=0), strict=True):
        if here[2] >= near:
            kept.append(here)
        if (here[2] >= near) != (after[2] >= near):
            kept.append(here + (near - here[2]) / (after[2] - here[2]) * (after - here))
    return np.array(kept).reshape(-1, 3)


def fill_polygon(outline: Array, size: tuple[int, int]) -> Mask:
    """[H, W] the pixels with centres inside a polygon [P, 2] (non-zero rule, as on the page); `size` is (W, H)."""
    width, height = size
    if len(outline) < 3:
        return np.zeros((height, width), dtype=bool)
    y, x = np.arange(height) + 0.5, np.arange(width) + 0.5
    winding = np.zeros((height, width + 1), dtype=np.int16)  # Winding numbers: crossings per row, then summed along it.
    for one, other in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        low, high = sorted((one[1], other[1]))
        rows = np.flatnonzero((y >= low) & (y < high))
        if not len(rows):
            continue
        crossing = one[0] + (y[rows] - one[1]) / (other[1] - one[1]) * (other[0] - one[0])
        winding[rows, np.searchsorted(x, crossing)] += 1 if other[1] > one[1] else -1
    np.cumsum(winding, axis=1, out=winding)
    return winding[:, :width] != 0


def plane_depths(camera: NumpyCamera, corners: Array, rows: slice, columns: slice) -> Array:
    """Camera z at which each pixel's ray in a window intersects the plane of a polygon; infinite if it does not."""
    center = corners.mean(axis=0)
    normal = np.linalg.svd(corners - center)[2][2]
    x, y = np.meshgrid(np.arange(columns.start, columns.stop) + 0.5, np.arange(rows.start, rows.stop) + 0.5)
    rays = camera.rays(np.stack([x, y], axis=-1))
    cosines = rays @ normal
    distances = float((center - camera.center) @ normal) / np.where(np.abs(cosines) < 1e-9, 1e-9, cosines)
    return np.where(distances > 0, distances * (rays @ camera.rotation[2]), np.inf)


def apply_strokes(mask: Mask, strokes: Sequence[Stroke]) -> Mask:
    """A mask after its strokes: cut removes pixels, keep restores those of the original mask."""
    found = mask.copy()
    for stroke in strokes:
        covered = rasterise_stroke(stroke, (mask.shape[1], mask.shape[0]))
        found = found & ~covered if stroke.effect == "cut" else found | (covered & mask)
    return found


def rasterise_stroke(stroke: Stroke, size: tuple[int, int]) -> Mask:
    """[H, W] the pixels that a stroke covers."""
    points = np.array(stroke.points, dtype=np.float64).reshape(-1, 2)
    if stroke.kind == "polygon":
        return fill_polygon(points, size)
    image = Image.new("1", size)
    draw = ImageDraw.Draw(image)
    path = [tuple(point) for point in np.clip(points, -FARTHEST_OUTSIDE, FARTHEST_OUTSIDE)]
    if len(path) > 1:
        draw.line(path, fill=1, width=max(1, round(2 * stroke.radius)), joint="curve")
    for x, y in path:
        draw.ellipse((x - stroke.radius, y - stroke.radius, x + stroke.radius, y + stroke.radius), fill=1)
    return np.array(image)
