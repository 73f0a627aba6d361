"""Pane masks: their files, the meaning of their values, and pixels that do not count.

A mask is either a label image (0 no pane, 1..K the pane) or binary (0 and 255, one pane). Binary masks come in both
polarities; which one is decided over the whole set, because one mask alone cannot tell.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from os.path import lexists
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.errors import InputError, first_names, input_checked
from glassplat.files.images import IMAGE_SUFFIXES, SHADES_16, open_image

HIGHEST_LABEL = 64
"""Grey values up to this one are labels when nothing brighter occurs; no one paints masks for the eye that dark."""
THRESHOLD = 128
WHITE = 255
SOFT_SHARE = 0.05
"""Largest share of grey pixels at the edges of a black-and-white mask."""
FEW_SHADES = 4
"""An antialiased edge has more shades of grey than this; fewer are labels somebody meant."""
LOSSY_SUFFIXES = (".jpg", ".jpeg", ".webp")
LOSSY_NOISE = 24
SIXTEEN_TO_EIGHT = 257


@dataclass(frozen=True)
class MaskValues:
    """One understood mask.

    Attributes:
        kind: `labels` for pane labels, `binary` for black (0) and white (1), `empty` for all black.
        pixels: [H, W] uint8.
    """

    kind: Literal["labels", "binary", "empty"]
    pixels: NDArray[np.uint8]


def read_mask_values(path: Path) -> MaskValues:
    """Read one mask file.

    Raises:
        InputError: the file is no image, or its values are neither labels nor black and white.
    """
    shades = _read_shades(path)
    counts = np.bincount(shades.ravel(), minlength=WHITE + 1)
    lossy = path.suffix.lower() in LOSSY_SUFFIXES
    if not lossy and not counts[HIGHEST_LABEL + 1 :].any():
        return MaskValues("labels" if counts[1:].any() else "empty", shades)
    _check_black_and_white(counts, path, lossy)
    pixels = (shades >= THRESHOLD).astype(np.uint8)
    return MaskValues("binary" if pixels.any() else "empty", pixels)


def read_mask_at_threshold(path: Path) -> MaskValues:
    """Read one mask file of a format that is known to split its greys at one half; label images stay as they are.

    Raises:
        InputError: the file is no image.
    """
    shades = _read_shades(path)
    if path.suffix.lower() not in LOSSY_SUFFIXES and not (shades > HIGHEST_LABEL).any():
        return MaskValues("labels" if shades.any() else "empty", shades)
    pixels = (shades >= THRESHOLD).astype(np.uint8)
    return MaskValues("binary" if pixels.any() else "empty", pixels)


def _read_shades(path: Path) -> NDArray[np.uint8]:
    """[H, W] grey values, or the indices of a palette."""
    with input_checked():
        image = open_image(path)
    image.info.pop("transparency", None)  # It says nothing about panes, and Pillow warns of some ways to store it.
    if image.mode == "1" or (image.mode == "P" and not _is_black_and_white(image)):
        return np.array(image).astype(np.uint8)
    if image.mode in SHADES_16:
        return _in_eight_bits(np.array(image), path)
    if image.mode in ("L", "LA", "P"):
        return np.array(image.convert("L"))
    return _one_colour(np.array(image.convert("RGB")), path)


def _in_eight_bits(values: NDArray[np.integer], path: Path) -> NDArray[np.uint8]:
    """Labels as they are, and shades of sixteen bits as those of eight that they stand for."""
    most = int(values.max())
    if most <= WHITE:
        return values.astype(np.uint8)
    if most // SIXTEEN_TO_EIGHT <= HIGHEST_LABEL and (values % SIXTEEN_TO_EIGHT).any():
        raise InputError(
            f"{path} holds the value {most}, which is neither a pane label (0..{HIGHEST_LABEL}) nor white of 16 bits "
            "(65535); write 0 for no pane and 1..K for the panes"
        )
    return (values // SIXTEEN_TO_EIGHT).astype(np.uint8)


def _is_black_and_white(image: Image.Image) -> bool:
    """Return whether a palette shows nothing but black and white, so that its colours count and not its indices."""
    colours = {colour for _, colour in image.convert("RGB").getcolors(image.width * image.height) or []}
    return colours <= {(0, 0, 0), (WHITE, WHITE, WHITE)}


def _one_colour(pixels: NDArray[np.uint8], path: Path) -> NDArray[np.uint8]:
    """Grey values of an RGB mask: black against one colour."""
    bright = pixels >= THRESHOLD
    mixtures = np.bincount((bright[..., 0] * 4 + bright[..., 1] * 2 + bright[..., 2]).ravel(), minlength=8)
    if np.count_nonzero(mixtures[1:]) > 1:
        raise InputError(
            f"{path} is painted in several colours; expected a label image (grey, 0 no pane, 1..K the pane)"
        )
    return pixels.max(axis=2)


def _check_black_and_white(counts: NDArray[np.int64], path: Path, lossy: bool) -> None:
    """Refuse greys that could be labels or a photograph; `counts` holds the pixels of each value."""
    tolerance = LOSSY_NOISE if lossy else 0
    grey = counts[tolerance + 1 : WHITE - tolerance]
    few = not lossy and 0 < np.count_nonzero(grey) < FEW_SHADES
    if few or grey.sum() > SOFT_SHARE * counts.sum():
        present = first_names([str(value) for value in np.flatnonzero(counts)])
        raise InputError(
            f"{path} holds the grey values {present}, which are neither pane labels (0..{HIGHEST_LABEL}) nor black and "
            "white (0 and 255); write 0 for no pane and 1..K for the panes"
        )


MASK_FOLDER, IGNORE_FOLDER = "masks", "ignore"
MASK_MARK = "_mask"
FRAMED_BY_PANE = 0.8
MOSTLY_PANE = 0.5

Polarity = Literal["auto", "bright", "dark"]
"""Which value of binary masks is the pane; `auto` decides by what lies along the image borders."""


@dataclass(frozen=True)
class PaneMask:
    """One mask file and how to read it.

    Attributes:
        path: the file.
        inverted: dark pixels are the pane.
        read: what the stored values mean.
    """

    path: Path
    inverted: bool
    read: Callable[[Path], MaskValues] = read_mask_values

    def labels(self) -> NDArray[np.uint8]:
        """[H, W] pane label of every pixel of the file, 0 for no pane."""
        return _labels(self.read(self.path), self.inverted)


@dataclass(frozen=True)
class MaskSet:
    """The masks of a capture by name of the photograph, all labels in them, and what the user should know."""

    masks: Mapping[str, PaneMask]
    labels: tuple[int, ...] = ()
    warnings: tuple[str, ...] = ()


def find_masks(root: Path, photographs: Mapping[str, Path], polarity: Polarity = "auto") -> MaskSet:
    """Find and understand the masks of a capture.

    Looked for, for a photograph `a/x.jpg`: `masks/a/x.png`, `masks/a/x.jpg.png`, `masks/a/x.jpg` and
    `masks/a/x_mask.png`, each with any image suffix and without the folder where that is unique, and `x_mask.png`
    beside the photograph.

    Args:
        root: the capture's folder.
        photographs: path of every photograph by name.
        polarity: which value of binary masks is the pane.

    Raises:
        InputError: masks that match no photograph, two for one photograph, values of no clear meaning, no pane in any.
    """
    paths = _match(root / MASK_FOLDER, photographs, beside=_beside)
    if not paths:
        if (root / MASK_FOLDER).is_dir():
            raise InputError(f"{root / MASK_FOLDER} holds no mask images; add masks, or remove the folder")
        return MaskSet({})
    return _understood(root, paths, polarity, read_mask_values)


def find_ignored(root: Path, photographs: Mapping[str, Path]) -> Mapping[str, PaneMask]:
    """The masks of what is not to be learned, by name of the photograph: `ignore/`, named as pane masks are.

    Every value above black is ignored; what that is, whether a passer-by or a car, does not matter.

    Args:
        root: the capture's folder.
        photographs: path of every photograph by name.

    Raises:
        InputError: masks that match no photograph, two for one photograph, files that are no masks.
    """
    found = {name: PaneMask(path, inverted=False) for name, path in _match(root / IGNORE_FOLDER, photographs).items()}
    for mask in found.values():
        mask.labels()
    return found


def known_masks(root: Path, paths: Mapping[str, Path], polarity: Polarity = "auto") -> MaskSet:
    """The masks of a format that says which file belongs to which photograph, that white is the pane, and that
    greys are split at one half.

    Args:
        root: the capture's folder.
        paths: mask by name of the photograph.
        polarity: `auto` is what the format says.

    Raises:
        InputError: a file that is no image, or no pane in any.
    """
    return _understood(root, paths, "bright" if polarity == "auto" else polarity, read_mask_at_threshold)


def _understood(
    root: Path, paths: Mapping[str, Path], polarity: Polarity, read: Callable[[Path], MaskValues]
) -> MaskSet:
    """Reads all masks once, for what only the whole set can tell."""
    values = {name: read(path) for name, path in paths.items()}
    _check_same_kind(values, paths)
    inverted, warnings = _decide_polarity(list(values.values()), polarity)
    masks = {name: PaneMask(path, inverted, read) for name, path in paths.items()}
    found = {name: _present(_labels(mask_values, inverted)) for name, mask_values in values.items()}
    labels = sorted(set().union(*found.values()))
    if not labels:
        raise InputError(
            f"none of the {len(masks)} masks of {root} marks a pane; expected values 1..K, or 255, on the panes"
        )
    empty = sorted(name for name, present in found.items() if not present)
    if empty:
        warnings.append(f"{len(empty)} masks mark no pane ({first_names(empty)}); these views count as seeing none.")
    return MaskSet(masks, tuple(labels), tuple(warnings))


def _labels(values: MaskValues, inverted: bool) -> NDArray[np.uint8]:
    """[H, W] pane labels."""
    return (values.pixels == 0).astype(np.uint8) if inverted else values.pixels


def _present(labels: NDArray[np.uint8]) -> set[int]:
    """The labels above zero that occur."""
    return {int(label) for label in np.flatnonzero(np.bincount(labels.ravel())) if label > 0}


def _match(
    folder: Path, photographs: Mapping[str, Path], *, beside: Callable[[Path], list[Path]] = lambda path: []
) -> dict[str, Path]:
    """Mask path by name of the photograph, in the order of the names; in the folder, or beside the photographs."""
    found: dict[str, list[Path]] = defaultdict(list)
    names = _names_by_key(photographs)
    unmatched: list[str] = []
    for path in _image_files(folder):
        owners = next((names[key] for key in _keys_of_mask(path.relative_to(folder)) if key in names), [])
        if len(owners) > 1:
            raise InputError(
                f"mask {path} could belong to {first_names(sorted(owners))}; name it after one, with its folder"
            )
        if owners:
            found[owners[0]].append(path)
        else:
            unmatched.append(path.relative_to(folder).as_posix())
    if unmatched:
        raise InputError(
            f"{len(unmatched)} masks in {folder} match no photograph: {first_names(sorted(unmatched))}; name a mask "
            f"like its photograph, such as {PurePosixPath(min(photographs)).with_suffix('.png')}"
        )
    for name, path in photographs.items():
        found[name].extend(beside(path))
    for name, several in found.items():
        if len(several) > 1:
            raise InputError(f"{name} has {len(several)} masks: {first_names([str(p) for p in several])}; keep one")
    return {name: found[name][0] for name in sorted(found) if found[name]}


def _image_files(folder: Path) -> Iterator[Path]:
    """Image files below a folder, hidden ones left out.

    Raises:
        InputError: something else goes by the folder's or by an image's name, such as a link to nowhere.
    """
    if not folder.is_dir():
        if lexists(folder):
            raise InputError(f"{folder} is no folder that can be read; expected one of mask images, or none")
        return
    for path in sorted(folder.rglob("*")):
        if path.suffix.lower() not in IMAGE_SUFFIXES or path.name.startswith(".") or path.is_dir():
            continue
        if not path.is_file():
            raise InputError(f"mask {path} is no file that can be read; replace or remove it")
        yield path


def _beside(photograph: Path) -> list[Path]:
    """Masks in the photograph's own folder."""
    candidates = (photograph.with_name(f"{photograph.stem}{MASK_MARK}{suffix}") for suffix in IMAGE_SUFFIXES)
    return [path for path in candidates if path.is_file()]


def _names_by_key(names: Iterable[str]) -> dict[str, list[str]]:
    """Photographs by the names that their masks may have, with and without folder and suffix."""
    found: dict[str, list[str]] = defaultdict(list)
    for name in names:
        path = PurePosixPath(name)
        for key in {name, str(path.with_suffix("")), path.name, path.stem}:
            found[key].append(name)
    return found


def _keys_of_mask(relative: Path) -> tuple[str, ...]:
    """Names of photographs that a mask file may stand for, the most explicit first."""
    without_suffix = relative.with_suffix("").as_posix()
    return relative.as_posix(), without_suffix, without_suffix.removesuffix(MASK_MARK)


def _check_same_kind(values: Mapping[str, MaskValues], paths: Mapping[str, Path]) -> None:
    """Refuse a set in which some masks are label images and others binary."""
    kinds = {kind: [str(paths[name]) for name, v in values.items() if v.kind == kind] for kind in ("labels", "binary")}
    if kinds["labels"] and kinds["binary"]:
        raise InputError(
            f"some masks are label images ({first_names(kinds['labels'], 2)}) and others black and white "
            f"({first_names(kinds['binary'], 2)}); write all of them with pane labels 1..K"
        )


def _decide_polarity(values: list[MaskValues], polarity: Polarity) -> tuple[bool, list[str]]:
    """Return whether dark pixels are the pane, and a warning where that was guessed."""
    binary = [v for v in values if v.kind == "binary"]
    if polarity != "auto" or not binary:
        return polarity == "dark" and bool(binary), []
    frame = float(np.median([_border_share(v.pixels) for v in binary]))
    has_both = float(np.mean([v.pixels.min() == 0 for v in binary])) > MOSTLY_PANE
    if frame > FRAMED_BY_PANE and has_both:
        return True, [
            f"The masks are white along {frame:.0%} of the image border, so they are read as inverted: black is the "
            "pane. State the polarity if that is wrong."
        ]
    if frame > MOSTLY_PANE:
        return False, [
            f"The panes cover {frame:.0%} of the image border; state the polarity if the masks are inverted."
        ]
    return False, []


def _border_share(pixels: NDArray[np.uint8]) -> float:
    """Share of the outermost pixels that are set."""
    border = np.concatenate([pixels[0], pixels[-1], pixels[1:-1, 0], pixels[1:-1, -1]])
    return float((border > 0).mean())
