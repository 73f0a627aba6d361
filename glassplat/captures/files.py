"""Reader of capture folders in any format, without PyTorch and without decoding photographs."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from glassplat.captures import colmap, mirror_nerf, transforms
from glassplat.captures.capture import Capture, Loader, Shot
from glassplat.captures.masks import Mask, MaskSet, Polarity, find_masks
from glassplat.errors import InputError, UnknownFormatError, join_names
from glassplat.files.images import HEIF_SUFFIXES, IMAGE_SUFFIXES
from glassplat.files.records import is_encodable, readable_name
from glassplat.files.writing import check_capture_folder, scene_source

LOADERS: tuple[tuple[Loader, str], ...] = (
    (colmap.load_colmap, colmap.FORMAT_DESCRIPTION),
    (mirror_nerf.load_mirror_nerf, mirror_nerf.FORMAT_DESCRIPTION),
    (transforms.load_transforms, transforms.FORMAT_DESCRIPTION),
)
"""Loaders in the order of trial, each with a description of its format for the message when none fits."""


@dataclass(frozen=True)
class CaptureFiles:
    """A capture before its photographs are decoded.

    Attributes:
        root: folder of the capture.
        capture: contents read by the loader of its format.
        shots: all photographs, sorted by name.
        masks: pane masks by name of the photograph, and their labels.
        ignored: masks of pixels to ignore, by name of the photograph; some photographs have several.
        mask_polarity: which value of binary masks marks the pane, as given to the reader.
    """

    root: Path
    capture: Capture
    shots: tuple[Shot, ...]
    masks: MaskSet
    ignored: Mapping[str, tuple[Mask, ...]]
    mask_polarity: Polarity

    def __str__(self) -> str:
        """One-line summary of the capture."""
        points = "no" if self.capture.points is None else len(self.capture.points)
        masks = len(self.masks.masks)
        return (
            f"{self.root}: a {self.capture.format_name} capture of {len(self.shots)} photographs, {points} points, "
            f"{masks or 'no'} {'mask' if masks == 1 else 'masks'} of panes"
        )


def read_capture(root: Path | str, *, mask_polarity: Polarity = "auto") -> CaptureFiles:
    """Read the poses, points and masks of a capture: COLMAP, Mirror-NeRF, or transforms.json in any of its dialects.

    Args:
        root: the capture's folder.
        mask_polarity: which value of binary masks marks the pane.
    """
    return with_masks(read_poses(root), mask_polarity)


def read_poses(root: Path | str) -> CaptureFiles:
    """Read a capture as `read_capture` does, but without masks."""
    root = Path(root)
    if not is_encodable(whole := str(root.resolve())):  # Runs record it.
        raise InputError(f"the path {readable_name(whole)} is not valid UTF-8; rename the folders in it")
    capture = _load_capture(root)
    shots = tuple(sorted((*capture.shots, *(capture.test_shots or ())), key=lambda shot: shot.name))
    if repeated := [name for name, count in Counter(shot.name for shot in shots).items() if count > 1]:
        raise InputError(f"photographs that occur more than once: {join_names(repeated)}; keep one pose for each")
    return CaptureFiles(root, capture, shots, MaskSet({}), {}, "auto")


def with_masks(files: CaptureFiles, mask_polarity: Polarity = "auto") -> CaptureFiles:
    """Add the masks to a capture whose poses were read."""
    photographs = {shot.name: shot.image_path for shot in files.shots}
    capture = files.capture
    masks, ignored = find_masks(
        files.root, photographs, mask_polarity, panes=capture.masks, keep_masks=capture.keep_masks
    )
    return replace(files, masks=masks, ignored=ignored, mask_polarity=mask_polarity)


def _load_capture(root: Path) -> Capture:
    """The capture from the first loader that recognises the format."""
    check_capture_folder(root)
    for load, _ in LOADERS:
        capture = load(root)
        if capture is not None:
            return capture
    looked_for = "; ".join(text for _, text in LOADERS)
    names = sorted(path.name for path in root.iterdir())
    found = join_names(names, limit=8) or "nothing"
    message = f"{root} is not a readable capture. Looked for: {looked_for}. Found: {found}."
    kind = "run" if "recipe.json" in names else "scene" if scene_source(root) != root else None
    if kind:
        message += f" This is a {kind}, which `glassplat.load` reads; expected a capture"
        message += ", such as the one that `glassplat info` shows for it" if kind == "run" else ""
    elif any(Path(name).suffix.lower() in (*IMAGE_SUFFIXES, *HEIF_SUFFIXES) for name in names):
        message += f" Photographs become a capture by: glassplat prepare {shlex.quote(str(root))} --output CAPTURE"
    raise UnknownFormatError(message)
