"""Masks and planes of marked panes, written into the capture, and occluders segmented by GrabCut."""

from __future__ import annotations

import hashlib
import importlib
import json
from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glassplat.annotate.document import MarkedPane, apply_strokes, fill_polygon, plane_depths, project_outline
from glassplat.annotate.fit import PaneFit
from glassplat.captures.dataset import Dataset, make_dataset
from glassplat.captures.files import read_poses, with_masks
from glassplat.captures.masks import PANE_FOLDER, PLANES, mask_paths
from glassplat.captures.view import PhotoFile, View
from glassplat.errors import InputError, join_names
from glassplat.files.images import files_below, image_size, is_hidden, leaves_folder, write_image
from glassplat.files.records import read_json
from glassplat.files.sidecars import planes_json, write_planes
from glassplat.files.writing import file_digest, remove_empty, remove_unfinished, write_text
from glassplat.panes import PlaneFit
from glassplat.panes.fit import FittedRectangle, to_planes
from glassplat.panes.masks import min_area_rectangle
from glassplat.scene.camera import NumpyCamera
from glassplat.scene.panes import Planes

Array = NDArray[np.float64]

LONGEST_SIDE = 480
"""Maximum width and height, in pixels, of the segmented part of a photograph; more takes seconds."""
MARGIN = 0.25
"""Margin around an outline from which the background is learned, as a share of the outline's size."""
GRABCUT_ROUNDS = 5
SMALLEST_PIECE = 0.01
"""Minimum area of a piece, as a share of the outline's area."""


def grab_outlines(photo: NDArray[np.uint8], outline: Array) -> list[Array]:
    """Outlines of the object inside a rough outline.

    Args:
        photo: [H, W, 3].
        outline: [P, 2] pixels around the object, with a little of its surroundings.

    Returns:
        [Q, 2] pixels of each piece; the rough outline itself if its inside does not differ from its surroundings.
    """
    cv2 = _import_opencv()
    low, high = _window(outline, photo.shape[1], photo.shape[0])
    part = photo[low[1] : high[1], low[0] : high[0]]
    scale = min(1.0, LONGEST_SIDE / max(part.shape[:2]))
    small = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    factor = np.array([small.shape[1], small.shape[0]]) / (high - low)
    inside = fill_polygon((outline - low) * factor, (small.shape[1], small.shape[0]))
    if not inside.any():
        raise InputError("the outline lies outside the photograph; draw it around an object in front of the pane")
    if inside.all():
        return [outline]
    found = _foreground(cv2, np.ascontiguousarray(small[:, :, ::-1]), inside)
    return [piece / factor + low for piece in _pieces(cv2, found, SMALLEST_PIECE * inside.sum())] or [outline]


def _window(outline: Array, width: int, height: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """[2] first (inclusive) and last (exclusive) pixel of the window around an outline."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    room = MARGIN * (high - low) + 4
    size = np.array([width, height])
    first = np.clip(np.floor(low - room), 0, size - 2).astype(np.int64)
    return first, np.clip(np.ceil(high + room), first + 2, size).astype(np.int64)


def _foreground(cv2: Any, colors: NDArray[np.uint8], inside: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """[H, W] 1 for pixels inside the outline that GrabCut labels as foreground."""
    cv2.setRNGSeed(0)  # Makes the result deterministic.
    mask = np.where(inside, cv2.GC_PR_FGD, cv2.GC_BGD).astype(np.uint8)
    models = np.zeros((1, 65)), np.zeros((1, 65))
    cv2.grabCut(colors, mask, None, *models, GRABCUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    return np.asarray(((mask == cv2.GC_PR_FGD) | (mask == cv2.GC_FGD)).astype(np.uint8))


def _pieces(cv2: Any, found: NDArray[np.uint8], least: float) -> list[Array]:
    """Outlines of the found pixels, along their outer edges; pieces smaller than `least` pixels are dropped."""
    doubled = np.kron(found, np.ones((2, 2), dtype=np.uint8))
    outlines, _ = cv2.findContours(doubled, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    smooth = [cv2.approxPolyDP(outline, 1.0, True).reshape(-1, 2) for outline in outlines]
    return [one / 2 + 0.25 for one in smooth if len(one) > 2 and cv2.contourArea(one) / 4 >= least]


def _import_opencv() -> Any:
    try:
        return importlib.import_module("cv2")
    except ImportError as error:
        raise InputError("grab needs OpenCV, which is not installed; run pip install 'glassplat[video]'") from error


Labels = NDArray[np.uint8]
FittedPanes = Sequence[tuple[MarkedPane, PaneFit]]

RECORD = "annotated.json"
"""Record in the folder of masks of the masks and planes written here, which may be replaced."""


def write_results(root: Path, views: Sequence[View], cameras: Sequence[NumpyCamera], panes: FittedPanes) -> list[str]:
    """Writes a mask for every photograph with a mark, and all planes; returns the masks' names.

    A mask shows the visible part of every pane, including panes not marked in its photograph.
    """
    folder = root / PANE_FOLDER
    earlier = earlier_masks(root)
    planes = planes_from_panes(panes, cameras)
    _check_planes(root)
    marked = set().union(*(pane.views() for pane, _ in panes))
    paths = mask_paths(view.name for view in views)
    shown = [(view, camera) for view, camera in zip(views, cameras, strict=True) if view.name in marked]
    new = {paths[view.name].as_posix() for view, _ in shown}
    # Written first: after an interrupt, all files are known to be ours.
    digest = hashlib.sha256(planes_json(planes).encode()).hexdigest()
    _write_record(folder, earlier | new, [*_read_record(folder)[1], digest])
    for view, camera in shown:
        write_image(folder / paths[view.name], resample_to_photograph(view, pane_labels(view.name, camera, panes)))
    for name in earlier - new:
        (folder / name).unlink(missing_ok=True)
    write_planes(root / PLANES, planes)
    _write_record(folder, new, [file_digest(root / PLANES)])
    return sorted(new)


def _check_planes(root: Path) -> None:
    """Refuse to replace planes not written here; earlier versions did not record theirs."""
    masks, digests = _read_record(root / PANE_FOLDER)
    written = file_digest(root / PLANES)
    if written and written not in digests and (digests or not masks):
        raise InputError(
            f"{root / PLANES} was not made by `glassplat annotate`, or was edited since; nothing was written. "
            "Move it away, write again, and copy your additions to the new file"
        )


def remove_results(root: Path) -> list[str]:
    """Removes only the masks and planes written here; returns their names in the capture."""
    folder = root / PANE_FOLDER
    masks, digests = [folder / name for name in sorted(earlier_masks(root))], _read_record(folder)[1]
    ours = [*([root / PLANES] if file_digest(root / PLANES) in digests else ()), *masks]
    removed = [path for path in ours if path.is_file()]
    for path in (*removed, folder / RECORD):  # The record last: after an interrupt, the rest is known to be ours.
        path.unlink(missing_ok=True)
    folders = {folder, *(above for path in masks for above in path.parents if above.is_relative_to(folder))}
    for emptied in folders:
        remove_unfinished(emptied, (".png", ".json"))
    remove_empty(sorted(folders, reverse=True))
    return [path.relative_to(root).as_posix() for path in removed]


def _write_record(folder: Path, masks: Set[str], digests: Sequence[str]) -> None:
    """Records the masks of a folder that were written here, and digests of planes written or about to be written."""
    write_text(folder / RECORD, json.dumps({"masks": sorted(masks), "planes": " ".join(digests)}, indent=1))


def _read_record(folder: Path) -> tuple[set[str], list[str]]:
    """Recorded masks of a folder and digests of planes; earlier versions recorded only a list of masks."""
    try:
        record = read_json(folder / RECORD)
        masks, planes = (record["masks"], record["planes"]) if isinstance(record, dict) else (record, "")
        return {str(name) for name in masks}, str(planes).split()
    except (OSError, ValueError, TypeError, KeyError):
        return set(), []


def load_capture_to_annotate(root: Path) -> Dataset:
    """Loads a capture whose panes are unmarked or marked here.

    Masks written here are not read, because they may be incomplete after an interrupt, or show no pane.
    """
    earlier_masks(root)
    files = read_poses(root)
    if files.capture.masks is not None or not (root / PANE_FOLDER).is_dir():
        files = with_masks(files)
    if files.masks.masks:
        raise InputError(
            f"the panes of {root} are marked by masks that were not made by `glassplat annotate`, and the two "
            "kinds cannot be mixed: train with these masks, or move them away and mark the panes here"
        )
    return make_dataset(files)


def earlier_masks(root: Path) -> set[str]:
    """Names, relative to their folder, of the masks written here before."""
    folder = root / PANE_FOLDER
    if not folder.is_dir():
        return set()
    known, _ = _read_record(folder)
    found = [path.relative_to(folder) for path in files_below(folder) if path.is_file()]
    seen = {path.as_posix() for path in found if not is_hidden(path) and path.name != RECORD}
    others = sorted(seen - known)
    if others:
        raise InputError(
            f"{folder} holds masks that were not made by `glassplat annotate` ({join_names(others)}), and the "
            "two kinds cannot be mixed: train with these masks, or move that folder away and mark the panes "
            "here"
        )
    return {name for name in known if not leaves_folder(name)}


def pane_labels(name: str, camera: NumpyCamera, panes: FittedPanes) -> Labels:
    """[H, W] label of the nearest pane at each pixel of a view, without marked occluders."""
    width, height = int(camera.size[0]), int(camera.size[1])
    labels, nearest = np.zeros((height, width), dtype=np.uint8), np.full((height, width), np.inf)
    for pane, fit in panes:
        corners = fit.shape.corners()
        outline = fill_polygon(project_outline(camera, corners), (width, height))
        down, across = np.flatnonzero(outline.any(axis=1)), np.flatnonzero(outline.any(axis=0))
        if not len(down):
            continue
        window = slice(down[0], down[-1] + 1), slice(across[0], across[-1] + 1)
        depth = np.where(outline[window], plane_depths(camera, corners, *window), np.inf)
        first = depth < nearest[window]
        strokes = pane.strokes.get(name, ())
        shown = (apply_strokes(outline, strokes) if strokes else outline)[window]
        labels[window][first] = np.where(shown, pane.label, labels[window])[first]
        nearest[window] = np.minimum(nearest[window], np.where(shown, depth, np.inf))
    return labels


def resample_to_photograph(view: View, labels: Labels) -> Labels:
    """[H, W] labels resampled from the view to the pixels of its photograph's file, which may have lens distortion."""
    reader = view.read_photo
    if not isinstance(reader, PhotoFile):
        return labels
    width, height = image_size(view.image_path)
    lens = reader.pixel_map.lens
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    camera = view.camera
    if lens is None:
        column, row = x * camera.width / width, y * camera.height / height
    else:
        rays = np.asarray(lens.as_colmap().cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1))).reshape(
            height, width, 2
        )
        column, row = camera.fx * rays[..., 0] + camera.cx, camera.fy * rays[..., 1] + camera.cy
    inside = (column >= 0) & (column < labels.shape[1]) & (row >= 0) & (row < labels.shape[0])
    found = np.zeros((height, width), dtype=np.uint8)
    found[inside] = labels[np.floor(row[inside]).astype(np.int64), np.floor(column[inside]).astype(np.int64)]
    return found


def planes_from_panes(panes: FittedPanes, cameras: Sequence[NumpyCamera]) -> Planes:
    """The minimum-area rectangle around each outline, with the normal towards most cameras."""
    mirrors = tuple(pane.label for pane, _ in panes if pane.material == "mirror")
    rectangles = [_bounding_rectangle(fit, cameras) for _, fit in panes]
    return to_planes(rectangles, [pane.label for pane, _ in panes], PlaneFit(mirror_labels=mirrors))


def _bounding_rectangle(fit: PaneFit, cameras: Sequence[NumpyCamera]) -> FittedRectangle:
    corners, axes = fit.shape.corners(), fit.shape.axes
    middle = corners.mean(axis=0)
    rectangle = min_area_rectangle((corners - middle) @ axes[:2].T)
    facing = np.sign([(camera.center - middle) @ axes[2] for camera in cameras]).sum()
    normal = axes[2] if facing >= 0 else -axes[2]
    center, tangent = middle + rectangle.center @ axes[:2], rectangle.axis @ axes[:2]
    return FittedRectangle(center, normal, tangent, rectangle.half_sizes)
