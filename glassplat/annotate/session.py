"""Session of marking the panes of a capture, with suggestions of photographs to mark next."""

from __future__ import annotations

import io
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.annotate.document import (
    ANNOTATIONS,
    MOST_PANES,
    PIXEL,
    MarkedPane,
    document_version,
    fill_polygon,
    lock_folder,
    parse_document,
    project_outline,
    read_document,
    write_document,
)
from glassplat.annotate.fit import Marks, PaneFit, TooFewMarksError, corner_information, fit_pane, tilt_deviation
from glassplat.annotate.results import grab_outlines, load_capture_to_annotate, remove_results, write_results
from glassplat.captures.dataset import Dataset
from glassplat.captures.masks import PANE_FOLDER, PLANES
from glassplat.captures.view import View
from glassplat.errors import InputError, convert_to_input_error, join_names
from glassplat.files.records import Field, Integer, ListOf, Text, check_fields
from glassplat.files.writing import check_folder, check_links
from glassplat.scene.camera import NumpyCamera

Array = NDArray[np.float64]

WANTED_ANGLE = np.radians(25)
"""Angle between sight lines of two photographs on a pane; a larger one adds little and changes the look of corners."""
MARGIN = 0.1
LEAST_CORNERS = 3
MOST_SUGGESTED = 3


def informative_views(fit: PaneFit, cameras: Sequence[NumpyCamera], marked: Collection[int]) -> list[tuple[int, float]]:
    """Views whose corners, if marked, would make a plane most certain, with the resulting uncertainty in degrees."""
    corners = fit.shape.corners()
    found = []
    for number, camera in enumerate(cameras):
        if number in marked or camera.contains(corners, MARGIN).sum() < min(LEAST_CORNERS, len(corners)):
            continue
        found.append((number, tilt_deviation(fit.information + corner_information(camera, fit.shape))))
    return sorted(found, key=lambda pair: pair[1])[:MOST_SUGGESTED]


def second_views(outline: Array, view: int, cameras: Sequence[NumpyCamera], points: Array) -> list[int]:
    """Views that show the contents of an outline [K, 2] in one view from another position; the best first.

    They are ranked by the measured points [P, 3] that project into the outline, at any depth.
    """
    camera = cameras[view]
    inside = fill_polygon(outline, (int(camera.size[0]), int(camera.size[1])))
    held = camera.contains(points)
    column, row = np.floor(camera.project(points[held])).astype(np.int64).T
    through = points[held][inside[row, column]]
    if not len(through):
        through = points[held] if held.any() else points
    if not len(through):
        return [number for number in range(len(cameras)) if number != view][:MOST_SUGGESTED]
    scores = {number: _view_score(through, camera, other) for number, other in enumerate(cameras) if number != view}
    best = sorted(scores, key=lambda number: -scores[number])
    return [number for number in best if scores[number] > 0][:MOST_SUGGESTED]


def first_view(cameras: Sequence[NumpyCamera], points: Array) -> int:
    """The view that shows the most measured points."""
    return int(np.argmax([camera.contains(points).sum() for camera in cameras])) if len(points) else 0


def _view_score(points: Array, camera: NumpyCamera, other: NumpyCamera) -> float:
    """Share of the points inside another view, times the median angle between sight lines, capped at `WANTED_ANGLE`."""
    one, two = (points - one.center for one in (camera, other))
    cosine = (one * two).sum(1) / (np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1))
    angle = float(np.median(np.arccos(np.clip(cosine, -1, 1))))
    return float(other.contains(points).mean()) * min(angle, WANTED_ANGLE)


Panes = Mapping[int, Any]


class MergedDocument(NamedTuple):
    """A document with the changes of both programs.

    Attributes:
        document: as JSON.
        changes: the other program's changes, in words.
        renamed: new labels of our panes, by their old labels.
    """

    document: Any
    changes: list[str]
    renamed: dict[int, int]


def merge_documents(base: Any, theirs: Any, ours: Any) -> MergedDocument:
    """Merges two versions of one document.

    A pane changed or added on one side is taken from that side. If both sides changed it, theirs is kept, and ours is
    added under a free label. Ours is also added if they removed the pane and we changed it.

    Args:
        base: the common ancestor of both.
        theirs: the saved document.
        ours: the document to save.
    """
    before, there, here = ({pane["label"]: pane for pane in document["panes"]} for document in (base, theirs, ours))
    kept, renamed = dict(there), dict[int, int]()
    for label in sorted({*before, *here}):
        ours_now, old = here.get(label), before.get(label)
        if ours_now == old or ours_now == there.get(label):
            continue
        if there.get(label) == old:
            kept[label] = ours_now
        elif ours_now is not None:
            new = renamed[label] = _free_label({*kept, *here})
            kept[new] = {**ours_now, "label": new}
    panes = [pane for _, pane in sorted(kept.items()) if pane is not None]
    return MergedDocument({**theirs, "panes": panes}, _changes(before, there), renamed)


def _free_label(used: set[int]) -> int:
    label = next((label for label in range(1, MOST_PANES + 1) if label not in used), None)
    if label is None:
        raise ValueError(
            f"all {MOST_PANES} labels are in use; remove a pane here to make room for those marked elsewhere"
        )
    return label


def _changes(before: Panes, after: Panes) -> list[str]:
    words = []
    for label in sorted({*before, *after}):
        if before.get(label) != after.get(label):
            how = "added" if label not in before else "removed" if label not in after else "changed"
            words.append(f"pane {label} {how}")
    return words or ["no pane changed"]


THUMBNAIL_SIDE = 160
PHOTOGRAPH_SIDE = 2400
"""Pixels of the longer side of photographs sent to the page."""
QUALITY = 90
CACHE_BYTES = 200_000_000
"""Maximum memory of encoded photographs."""
POOR_RECTANGLE = 1.5
"""Ratio of the errors of rectangle and free polygon above which a warning is shown."""
POINTS_USED = 20_000
MOST_GRABBED = 2000
"""Maximum number of points of a hand-drawn outline."""
KNOWN_VERSIONS = 200
"""Number of remembered versions of the document on which a page may base its changes."""
GRAB_FIELDS: dict[str, Field] = {"view": Integer(0, 10**9), "points": ListOf(PIXEL)}


def is_marked(panes: Sequence[MarkedPane]) -> bool:
    """Return whether any corner or edge of the panes is marked in a photograph."""
    return any(places for pane in panes for places in (*pane.corners, *pane.edges))


class ChangedElsewhereError(ValueError):
    """Raised when a page saves changes to an outdated document; `response` is sent to the page."""

    def __init__(self, merged: MergedDocument, version: str) -> None:
        super().__init__(f"the marks were changed elsewhere ({', '.join(merged.changes)}); both versions are kept")
        self.response = {"document": merged.document, "renamed": merged.renamed, "version": version}


class Session:
    """A capture, its marks, and the fits to them.

    Attributes:
        root: the capture's folder.
        views: all views, by name.
        cameras: their cameras.
    """

    def __init__(self, dataset: Dataset) -> None:
        self.root = dataset.root
        self.views: tuple[View, ...] = tuple(sorted((*dataset.train, *dataset.test), key=lambda view: view.name))
        self.cameras = [NumpyCamera.from_camera(view.camera) for view in self.views]
        points = dataset.points.positions.double().numpy() if dataset.measured_points else np.zeros((0, 3))
        self._points: Array = points[:: max(1, len(points) // POINTS_USED)]
        self._view_numbers = {view.name: number for number, view in enumerate(self.views)}
        self._lock = Lock()
        self._jpegs: OrderedDict[tuple[int, int], bytes] = OrderedDict()
        self._versions: OrderedDict[str, Any] = OrderedDict()
        self._records: dict[int, tuple[str, dict[str, Any]]] = {}
        with convert_to_input_error():
            self._document: Any = read_document(self.root)
        self._remember(self._document)
        self._written_version = document_version(self._document) if (self.root / PLANES).exists() else ""

    def describe(self) -> dict[str, Any]:
        """Description of the capture for the page."""
        return {
            "name": self.root.resolve().name,
            "views": [
                {"name": view.name, "width": view.camera.width, "height": view.camera.height} for view in self.views
            ],
            "first": first_view(self.cameras, self._points),
            **self._current_document(),
        }

    def photograph_jpeg(self, number: int, longest: int) -> bytes:
        """A photograph as JPEG, undistorted, reduced to at most `longest` pixels a side.

        Raises:
            IndexError: the view does not exist.
        """
        view = self.views[number]
        with self._lock:
            if (number, longest) in self._jpegs:
                self._jpegs.move_to_end((number, longest))
                return self._jpegs[number, longest]
        image = Image.fromarray(view.read_photo().numpy())
        image.thumbnail((longest, longest), Image.Resampling.LANCZOS)
        encoded = io.BytesIO()
        image.save(encoded, "JPEG", quality=QUALITY)
        with self._lock:
            self._jpegs[number, longest] = encoded.getvalue()
            while sum(map(len, self._jpegs.values())) > CACHE_BYTES:
                self._jpegs.popitem(last=False)
        return encoded.getvalue()

    def save(self, request: Any) -> dict[str, Any]:
        """Saves a changed document; returns the fits of its panes and its version.

        Args:
            request: `document`, and `version` of the document that the page changed.

        Raises:
            ChangedElsewhereError: another page or program has saved since; nothing is written.
            ValueError: it is not a valid document.
            OSError: the document cannot be saved.
        """
        fields = check_fields(request, {"version": Text()}, "the request of the page")
        document = request.get("document")
        panes = parse_document(document, "the document of the page")
        with self._lock, lock_folder(self.root):
            there = read_document(self.root)
            if document_version(there) != fields["version"]:
                base = self._versions.get(fields["version"], {"version": 1, "panes": []})
                self._remember(there)
                raise ChangedElsewhereError(merge_documents(base, there, document), document_version(there))
            write_document(self.root, document)
            self._remember(document)
        return {"panes": [self._pane_record(pane) for pane in panes], "version": document_version(document)}

    def _current_document(self) -> dict[str, Any]:
        """The document on disk, which another program may have saved, and its version."""
        with self._lock:
            self._remember(read_document(self.root))
            return {"document": self._document, "version": document_version(self._document)}

    def _remember(self, document: Any) -> None:
        """Store the document on disk and its version."""
        self._document = self._versions[document_version(document)] = document
        self._versions.move_to_end(document_version(document))
        while len(self._versions) > KNOWN_VERSIONS:
            self._versions.popitem(last=False)

    def grab(self, request: Any) -> dict[str, Any]:
        """Outlines of the object inside a rough outline in a photograph."""
        fields = check_fields(request, GRAB_FIELDS, "the outline of the page")
        if fields["view"] >= len(self.views) or not 3 <= len(fields["points"]) <= MOST_GRABBED:
            raise ValueError(f"expected 3 to {MOST_GRABBED} points in one of {len(self.views)} views")
        photo = np.asarray(self.views[fields["view"]].read_photo().numpy())
        found = grab_outlines(photo, np.array(fields["points"], dtype=np.float64))
        return {"outlines": [np.round(outline, 2).tolist() for outline in found]}

    def solve(self, pane: MarkedPane) -> PaneFit | str:
        """Fits one pane, or tells why it has no fit."""
        marks = pane.marks(self._view_numbers)
        if len(marks.corners) < 3 or not marks.views():
            return "mark the corners in order around the pane"
        try:
            return fit_pane(marks, self.cameras, pane.shape)
        except TooFewMarksError as error:
            return str(error)
        except ValueError as error:
            return f"{error}; check the order of the corners"

    def finish(self) -> dict[str, Any]:
        """Writes masks and planes of all marked panes, including those of another program; returns a summary.

        If no pane is marked any more, earlier output is removed.
        """
        current = self._current_document()
        panes = parse_document(current["document"], "the document")
        solved = [(pane, fit) for pane in panes if not isinstance(fit := self.solve(pane), str)]
        if not solved:
            removed = [] if is_marked(panes) else remove_results(self.root)
            if not removed:
                raise InputError("no pane is known yet; mark the same corners in two photographs")
            stays = f"; {PLANES} stays: it was not written here" if (self.root / PLANES).exists() else ""
            message = f"no pane is marked; removed the earlier output: {join_names(removed)}{stays}"
            return {"masks": [], "planes": [], "told": message}
        written = write_results(self.root, self.views, self.cameras, solved)
        self._written_version = current["version"]
        return {
            "masks": written,
            "planes": [{"label": pane.label, "uncertainty": fit.uncertainty} for pane, fit in solved],
        }

    @property
    def unwritten_warning(self) -> str:
        """A warning if the masks and planes are older than the marks, or an empty string."""
        document = self._document
        if document_version(document) == self._written_version or not is_marked(parse_document(document, ANNOTATIONS)):
            return ""
        return "masks and planes do not contain the latest marks: annotate again, and press 'write masks and planes'"

    def _pane_record(self, pane: MarkedPane) -> dict[str, Any]:
        """Record of a pane for the page; the cached one if its corners, edges and shape are unchanged."""
        marked, known = repr((pane.corners, pane.edges, pane.shape)), self._records.get(pane.label)
        if known is None or known[0] != marked:
            known = self._records[pane.label] = marked, self._make_record(pane, self.solve(pane))
        return known[1]

    def _make_record(self, pane: MarkedPane, fit: PaneFit | str) -> dict[str, Any]:
        """Record for the page of a pane and its fit, or of why there is none."""
        marks = pane.marks(self._view_numbers)
        if isinstance(fit, str):
            return {
                "label": pane.label,
                "solved": False,
                "message": self._crossing_warning(marks) or fit,
                "next": [{"view": number} for number in self._second_views(marks)],
                "lines": self._sight_lines(marks),
            }
        corners = fit.shape.corners()
        advice = informative_views(fit, self.cameras, marks.views())
        return {
            "label": pane.label,
            "solved": True,
            "message": self._crossing_warning(marks) or self._fit_warning(pane, fit, marks),
            "error": fit.error,
            "uncertainty": fit.uncertainty,
            "errors": fit.errors,
            "outlines": [np.round(project_outline(camera, corners), 2).tolist() for camera in self.cameras],
            "corners": [_corner_pixels(camera, corners) for camera in self.cameras],
            "next": [{"view": number, "uncertainty": uncertainty} for number, uncertainty in advice],
        }

    def _crossing_warning(self, marks: Marks) -> str:
        """A warning about the first photograph in which sides of the outline cross, or an empty string."""
        for view in marks.views():
            outline = [places[view] for places in marks.corners if view in places]
            if len(outline) == len(marks.corners) and _is_self_intersecting(np.array(outline)):
                return f"the sides cross in {self.views[view].name}: click the corners in order around the pane"
        return ""

    def _fit_warning(self, pane: MarkedPane, fit: PaneFit, marks: Marks) -> str:
        """A warning about a poor fit, or an empty string."""
        worst = max(fit.errors, key=fit.errors.__getitem__)
        if pane.shape == "rectangle" and len(marks.corners) == 4 and fit.error > 2:
            free = fit_pane(marks, self.cameras, "polygon")
            if fit.error > POOR_RECTANGLE * max(free.error, 1.0):
                return (
                    f"the corners do not form a rectangle ({fit.error:.1f} pixels off, as a polygon {free.error:.1f}): "
                    "check them and their order, or choose polygon"
                )
        if fit.errors[worst] > 0.01 * self.cameras[worst].diagonal:
            name = self.views[worst].name
            return f"the marks in {name} are {fit.errors[worst]:.0f} pixels off: check them and their order"
        return ""

    def _second_views(self, marks: Marks) -> list[int]:
        views = marks.views()
        if not views:
            return []
        outline = np.array([places[views[0]] for places in marks.corners if views[0] in places]).reshape(-1, 2)
        found = second_views(outline, views[0], self.cameras, self._points)
        return [number for number in found if number not in views[1:]]

    def _sight_lines(self, marks: Marks) -> list[list[Any]]:
        """For each corner marked in one view only, its sight line as a segment in each other view, or None."""
        lines = []
        for pixels in marks.corners:
            segments: list[Any] = [None] * len(self.cameras)
            if len(pixels) == 1:
                ((view, pixel),) = pixels.items()
                segments = [
                    None if number == view else self._sight_line(view, pixel, camera)
                    for number, camera in enumerate(self.cameras)
                ]
            lines.append(segments)
        return lines

    def _sight_line(self, view: int, pixel: Array, camera: NumpyCamera) -> list[list[float]] | None:
        """The visible segment of a sight line in another view, from near to far."""
        source = self.cameras[view]
        far = self._scene_distance()
        ends = source.center + source.rays(pixel) * np.geomspace(0.01 * far, 10 * far, 60)[:, None]
        ends = ends[camera.to_camera_axes(ends)[:, 2] > 0.005 * far]
        if len(ends) < 2:
            return None
        return np.round(camera.project(ends[[0, -1]]), 1).tolist()

    def _scene_distance(self) -> float:
        """Rough distance of the scene from the cameras."""
        centers = np.stack([camera.center for camera in self.cameras])
        points = self._points if len(self._points) else centers
        return max(float(np.median(np.linalg.norm(points - centers.mean(axis=0), axis=1))), 1e-6)


def _is_self_intersecting(outline: Array) -> bool:
    """Return whether two sides of an outline [K, 2] cross."""
    along, offsets = np.roll(outline, -1, axis=0) - outline, outline[None] - outline[:, None]
    starts = along[:, None, 0] * offsets[..., 1] - along[:, None, 1] * offsets[..., 0]
    is_apart = starts * np.roll(starts, -1, axis=1) < 0  # The ends of one side lie on opposite sides of the other.
    return bool((is_apart & is_apart.T).any())


def _corner_pixels(camera: NumpyCamera, corners: Array) -> list[list[float] | None]:
    """Pixels of corners; None for those behind the camera."""
    pixels = np.round(camera.project(corners), 2).tolist()
    depths = camera.to_camera_axes(corners)[:, 2]
    return [pixel if depth > 0 else None for pixel, depth in zip(pixels, depths, strict=True)]


def open_session(root: Path) -> Session:
    """Opens the session of a capture.

    Args:
        root: folder of the capture.
    """
    check_links(root, (ANNOTATIONS, PANE_FOLDER, PLANES))
    dataset = load_capture_to_annotate(root)
    check_folder(root)
    return Session(dataset)
