"""Masks of panes (`panes/`) and of ignored pixels (`masks/`, `ignore/`): their files and the meaning of values.

A pane mask is either a label image (0 no pane, 1..K the pane) or binary (0 and 255, or one bit; one pane). Binary masks
come in both polarities; the polarity is decided from the whole set, because one mask alone is ambiguous.

Masks in `masks/`, or `x_mask.png` next to a photograph `x.png`, follow COLMAP, nerfstudio, Brush, 3DGRUT and LichtFeld:
black pixels are ignored. Earlier versions stored pane masks there; such captures are still read that way.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import partial
from os.path import lexists, normpath
from pathlib import Path, PurePosixPath
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from glassplat.errors import InputError, convert_to_input_error, join_names
from glassplat.files import images

HIGHEST_MASK_LABEL = 64
"""Grey values up to this one are labels if none is brighter; masks painted for viewing are never that dark."""
THRESHOLD, WHITE = 128, 255
"""Grey value from which a pixel of a black-and-white mask counts as white, and the value of white."""
SOFT_SHARE = 0.05
"""Largest share of grey pixels at the edges of a black-and-white mask."""
FEW_SHADES = 4
"""Minimum number of greys of an antialiased edge; fewer are intended labels."""
LOSSY_SUFFIXES = (".jpg", ".jpeg", ".webp")
LOSSY_NOISE, SIXTEEN_TO_EIGHT = 24, 257
"""Largest deviation from black and white due to lossy compression, and the ratio of 16-bit to 8-bit grey values."""


@dataclass(frozen=True)
class MaskValues:
    """One interpreted mask.

    Attributes:
        kind: `labels` for pane labels, `binary` for black (0) and white (1), `empty` for all black.
        pixels: [H, W] uint8.
    """

    kind: Literal["labels", "binary", "empty"]
    pixels: NDArray[np.uint8]


def read_mask(path: Path, *, at_threshold: bool = False) -> MaskValues:
    """Read one mask file; `at_threshold` for a format that thresholds greys at one half, which changes no labels."""
    shades, lossy = _read_shades(path), path.suffix.lower() in LOSSY_SUFFIXES
    if not lossy and not (shades > HIGHEST_MASK_LABEL).any():
        return MaskValues("labels" if shades.any() else "empty", shades)
    if not at_threshold:
        _check_black_and_white(np.bincount(shades.ravel(), minlength=WHITE + 1), path, lossy)
    pixels = (shades >= THRESHOLD).astype(np.uint8)
    return MaskValues("binary" if pixels.any() else "empty", pixels)


def _read_shades(path: Path) -> NDArray[np.uint8]:
    """[H, W] grey values, or palette indices of labels shown in colours; transparency takes precedence."""
    image = _open_mask(path)
    if image.mode in images.GREY_MODES_16:
        return _to_eight_bits(np.array(image), path)
    if image.mode in ("1", "L", "LA"):
        return np.array(image.convert("L"))
    colors = np.array(image.convert("RGB"))
    return _palette_shades(np.array(image), colors, path) if image.mode == "P" else _single_colour_shades(colors, path)


def _open_mask(path: Path) -> Image.Image:
    """The mask; if any pixel is transparent, its opacity thresholded at one half as white and black."""
    with convert_to_input_error():
        image = images.open_image(path)
        opaque = None if image.mode in images.GREY_MODES_16 else images.opacity(image)
    image.info.pop("transparency", None)  # Pillow warns about some encodings of it.
    return image if opaque is None else Image.fromarray(np.where(opaque < THRESHOLD, 0, WHITE).astype(np.uint8))


def _to_eight_bits(values: NDArray[np.integer], path: Path) -> NDArray[np.uint8]:
    """Labels unchanged, and sixteen-bit greys converted to eight bits."""
    most = int(values.max())
    if most <= WHITE:
        return values.astype(np.uint8)
    if most // SIXTEEN_TO_EIGHT <= HIGHEST_MASK_LABEL and (values % SIXTEEN_TO_EIGHT).any():
        raise InputError(
            f"{path} holds the value {most}, which is neither a pane label (0..{HIGHEST_MASK_LABEL}) nor white of "
            "16 bits (65535); write 0 for no pane and 1..K for the panes"
        )
    return (values // SIXTEEN_TO_EIGHT).astype(np.uint8)


def _palette_shades(indices: NDArray[np.uint8], colors: NDArray[np.uint8], path: Path) -> NDArray[np.uint8]:
    """Greys of a grey palette; 0 and 255 for black and one colour, if index 0 is not black; else the indices."""
    if not np.ptp(colors, axis=2).any():
        return colors[:, :, 0]  # PNG optimisers make such palettes, whose indices have no meaning.
    lit = colors.max(axis=2) > 0
    colored_zero = bool(lit[indices == 0].any())
    if (colored_zero or indices.all()) and not lit.all() and len(np.unique(indices)) == 2:
        return np.where(lit, WHITE, 0).astype(np.uint8)
    if colored_zero:
        raise InputError(
            f"{path} has a palette in which 0, no pane, is a colour; expected black there, as in a label image (0 no "
            "pane, 1..K the pane), or black and one colour: save it in shades of grey"
        )
    return indices


def _single_colour_shades(pixels: NDArray[np.uint8], path: Path) -> NDArray[np.uint8]:
    """Grey values of an RGB mask: black against one colour."""
    bright = (pixels >= THRESHOLD).view(np.uint8)
    mixtures = bright[..., 0] << 2 | bright[..., 1] << 1 | bright[..., 2]  # As bytes: wider integers take gigabytes.
    if ((mixtures > 0) & (mixtures < mixtures.max())).any():
        raise InputError(
            f"{path} is painted in several colours; expected a label image (grey, 0 no pane, 1..K the pane)"
        )
    return pixels.max(axis=2)


def _check_black_and_white(counts: NDArray[np.int64], path: Path, lossy: bool) -> None:
    """Refuse greys that could be labels or a photograph; `counts` is the histogram."""
    tolerance = LOSSY_NOISE if lossy else 0
    grey = counts[tolerance + 1 : WHITE - tolerance]
    few = not lossy and 0 < np.count_nonzero(grey) < FEW_SHADES
    if few or grey.sum() > SOFT_SHARE * counts.sum():
        present = join_names([str(value) for value in np.flatnonzero(counts)])
        raise InputError(
            f"{path} holds the grey values {present}, which are neither pane labels (0..{HIGHEST_MASK_LABEL}) nor "
            "black and white (0 and 255); write 0 for no pane and 1..K for the panes"
        )


PANE_FOLDER, MASK_FOLDER, IGNORE_FOLDER = "panes", "masks", "ignore"
PLANES = "planes.json"
MASK_SUFFIX = "_mask"
FRAMED_BY_PANE, MOSTLY_PANE = 0.8, 0.5
"""White share of the image border above which masks are inverted, and above which a warning is given."""

Polarity = Literal["auto", "bright", "dark"]
"""Value of binary masks that marks the pane; `auto` decides by the values along the image borders."""


@dataclass(frozen=True)
class Mask:
    """One mask file, of panes or of ignored pixels.

    Attributes:
        path: the file.
        read: returns its labels [H, W]: of panes, or above zero on pixels to ignore.
    """

    path: Path
    read: Callable[[Path], NDArray[np.uint8]]

    def labels(self) -> NDArray[np.uint8]:
        """[H, W] label of each pixel of the file."""
        return self.read(self.path)


def read_pane_labels(path: Path, *, at_threshold: bool = False, inverted: bool = False) -> NDArray[np.uint8]:
    """[H, W] pane label of each pixel, 0 for no pane; if inverted, dark pixels mark the pane."""
    return _labels(read_mask(path, at_threshold=at_threshold), inverted)


def read_black(path: Path) -> NDArray[np.uint8]:
    """[H, W] 1 where a mask is black: below one half, or zero if no value exceeds the highest label."""
    shades = _brightness(path)
    return (shades < (THRESHOLD if shades.max() > HIGHEST_MASK_LABEL else 1)).astype(np.uint8)


def read_transparent(path: Path) -> NDArray[np.uint8]:
    """[H, W] 1 where a photograph is transparent: opacity below one half."""
    with convert_to_input_error():
        pixels = images.read_image(path)
    return (pixels[:, :, 3] < THRESHOLD).astype(np.uint8) if pixels.shape[2] == 4 else np.zeros_like(pixels[..., 0])


@dataclass(frozen=True)
class MaskSet:
    """The masks of a capture by name of the photograph, all their labels, and warnings for the user."""

    masks: Mapping[str, Mask]
    labels: tuple[int, ...] = ()
    warnings: tuple[str, ...] = ()


def ignored_share(masks: Sequence[Mask]) -> float:
    """Largest share of a photograph that any one of its masks excludes."""
    return max(float((mask.labels() > 0).mean()) for mask in masks)


def find_masks(
    root: Path,
    photographs: Mapping[str, Path],
    polarity: Polarity = "auto",
    *,
    panes: Mapping[str, Path] | None = None,
    keep_masks: Mapping[str, Path] | None = None,
) -> tuple[MaskSet, Mapping[str, tuple[Mask, ...]]]:
    """The masks of panes of a capture, and those of pixels to ignore, by name of the photograph, which may have two.

    Panes are in `panes/`; pixels that are black in `masks/`, or above black in `ignore/`, are ignored. For a photograph
    `a/x.jpg`, each folder is searched for `a/x.png`, `a/x.jpg.png`, `a/x.jpg` and `a/x_mask.png`, with any image
    suffix, and without the folder `a/` if unambiguous. Masks may also be `x_mask.png` next to the photograph, unless
    that is a photograph of the capture. If names collide, `mask_paths` gives a unique one; names with a folder take
    precedence.

    Args:
        root: the capture's folder.
        photographs: path of every photograph by name.
        polarity: which value of binary masks marks the pane.
        panes: pane masks specified by the format, white on the pane; `masks/` then holds pane masks only.
        keep_masks: masks of pixels to keep named by the format; they take precedence over those found by name.
    """
    ignored, keep_masks = find_ignored(root, photographs), keep_masks or {}
    if panes is not None:
        # The format assigns files to photographs, and thresholds greys at one half.
        known = _interpret_masks(root, panes, "bright" if polarity == "auto" else polarity, at_threshold=True)
        return known, _join_masks(keep_masks, ignored)
    paths = _match_masks(root / PANE_FOLDER, photographs)
    if not paths and (root / PANE_FOLDER).is_dir():
        raise InputError(f"{root / PANE_FOLDER} holds no mask images; add masks, or remove the folder")
    masks, warnings = _find_keep_masks(root, photographs, {normpath(path) for path in keep_masks.values()})
    earlier = _pane_masks_reason(root, masks, marked=bool(paths))
    if earlier is not None:
        found = _interpret_masks(root, masks, polarity)
        renaming = f"{earlier} {next(iter(masks.values())).parent} is read as panes; rename it to {PANE_FOLDER}/."
        warnings = (renaming, *warnings)
        return replace(found, warnings=(*warnings, *found.warnings)), _join_masks(keep_masks, ignored)
    found = _interpret_masks(root, paths, polarity) if paths else MaskSet({})
    return replace(found, warnings=(*found.warnings, *warnings)), _join_masks({**masks, **keep_masks}, ignored)


def _find_keep_masks(
    root: Path, photographs: Mapping[str, Path], named: Set[str]
) -> tuple[dict[str, Path], tuple[str, ...]]:
    """Masks in `masks/` and next to photographs, except those named by the format; a warning on unmatched ones."""
    folder, taken = root / MASK_FOLDER, {*named, *(normpath(path) for path in photographs.values())}
    found, unmatched = _match_files(folder, photographs, named)
    for name, path in photographs.items():
        siblings = (path.with_name(f"{path.stem}{MASK_SUFFIX}{suffix}") for suffix in images.IMAGE_SUFFIXES)
        found[name] += [mask for mask in siblings if mask.is_file() and normpath(mask) not in taken]
    masks = _only_masks(found)
    if unmatched and not (masks or named):
        raise InputError(_unmatched_message(folder, unmatched, photographs))
    if not (masks or named) and folder.is_dir():
        raise InputError(f"{folder} holds no mask images; add masks, or remove the folder")
    if not unmatched:
        return masks, ()
    belong = "1 mask belongs" if len(unmatched) == 1 else f"{len(unmatched)} masks belong"
    return masks, (f"{belong} to no photograph ({join_names(sorted(unmatched))}).",)


def _pane_masks_reason(root: Path, masks: Mapping[str, Path], *, marked: bool) -> str | None:
    """Sentence on why masks in `masks/` are treated as pane masks; None if they are not."""
    highest = next((value for value in map(_highest_value, masks.values()) if value), 0)
    labels = 0 < highest <= HIGHEST_MASK_LABEL
    if marked:
        if labels:
            raise InputError(
                f"the masks in {root / MASK_FOLDER} have no value above {highest}, as if they were labels of panes, "
                f"but these are in {root / PANE_FOLDER}; write 0 for pixels to ignore and 255 for pixels to "
                "keep, or remove the folder"
            )
        return None
    if labels:
        keep = " (if 1 marks pixels to keep, write 255 instead)" if highest == 1 else ""
        return f"The masks hold labels of panes{keep}."
    return f"There is a {PLANES} but no {PANE_FOLDER}/." if (masks and (root / PLANES).is_file()) else None


def _highest_value(path: Path) -> int:
    """The highest grey value of a mask."""
    brightest = int(_brightness(path).max())
    if path.suffix.lower() in LOSSY_SUFFIXES:
        return int(brightest > LOSSY_NOISE) * WHITE
    return brightest and int(_read_shades(path).max())


def _brightness(path: Path) -> NDArray[np.uint8]:
    """[H, W] brightness of a mask, or its thresholded opacity if it has transparent pixels."""
    image = _open_mask(path)
    if image.mode in images.GREY_MODES_16:
        return _to_eight_bits(np.array(image), path)
    return np.array(image.convert("RGB")).max(axis=2)


def _join_masks(keep_masks: Mapping[str, Path], ignored: Mapping[str, Mask]) -> dict[str, tuple[Mask, ...]]:
    """All masks of ignored pixels, by name of the photograph."""
    joined: dict[str, tuple[Mask, ...]] = {name: (Mask(path, read_black),) for name, path in keep_masks.items()}
    for name, mask in ignored.items():
        joined[name] = (*joined.get(name, ()), mask)
    return joined


def find_ignored(root: Path, photographs: Mapping[str, Path]) -> Mapping[str, Mask]:
    """The masks in `ignore/`, by name of the photograph.

    Pixels of any value above black are ignored; the value itself, such as a class index, does not matter.

    Args:
        root: the capture's folder.
        photographs: path of every photograph by name.
    """
    paths = _match_masks(root / IGNORE_FOLDER, photographs)
    found = {name: Mask(path, read_pane_labels) for name, path in paths.items()}
    for mask in found.values():
        mask.labels()
    return found


def _interpret_masks(
    root: Path, paths: Mapping[str, Path], polarity: Polarity, *, at_threshold: bool = False
) -> MaskSet:
    """Read all masks once, to decide kind, polarity and labels from the whole set."""
    values = {name: read_mask(path, at_threshold=at_threshold) for name, path in paths.items()}
    _check_same_kind(values, paths)
    inverted, warnings = _decide_polarity(list(values.values()), polarity)
    read = partial(read_pane_labels, at_threshold=at_threshold, inverted=inverted)
    masks = {name: Mask(path, read) for name, path in paths.items()}
    counts = {name: np.bincount(_labels(one, inverted).ravel()) for name, one in values.items()}
    found = {name: {*np.flatnonzero(count).tolist()} - {0} for name, count in counts.items()}
    labels = sorted(set().union(*found.values()))
    if not labels:
        raise InputError(f"no mask of {root} marks a pane; expected values 1..K, or 255, on the panes")
    empty = sorted(name for name, present in found.items() if not present)
    if empty:
        warnings.append(f"No pane is marked in {join_names(empty)}; these views count as seeing none.")
    return MaskSet(masks, tuple(labels), tuple(warnings))


def _labels(values: MaskValues, inverted: bool) -> NDArray[np.uint8]:
    """[H, W] pane labels."""
    return (values.pixels == 0).astype(np.uint8) if inverted else values.pixels


def _match_masks(folder: Path, photographs: Mapping[str, Path]) -> dict[str, Path]:
    """Path of the mask in a folder by name of the photograph, sorted by name; each mask must have a photograph."""
    found, unmatched = _match_files(folder, photographs)
    if unmatched:
        raise InputError(_unmatched_message(folder, unmatched, photographs))
    return _only_masks(found)


def _match_files(
    folder: Path, photographs: Mapping[str, Path], skipped: Set[str] = frozenset()
) -> tuple[defaultdict[str, list[Path]], list[str]]:
    """Masks in a folder by name of the photograph, and those without a photograph; the skipped paths are left out."""
    found = defaultdict[str, list[Path]](list)
    unmatched: list[str] = []
    keys = _owners_by_key(photographs if folder.is_dir() else ())
    for path in _image_files(folder, keys[0]):
        if normpath(path) in skipped:
            continue
        owners = _owners(path.relative_to(folder), keys)
        if len(owners) > 1:
            raise InputError(
                f"mask {path} could belong to {join_names(sorted(owners))}; call it "
                f"{mask_paths(photographs)[min(owners)]}, or after another of them"
            )
        if owners:
            found[owners[0]].append(path)
        else:
            unmatched.append(path.relative_to(folder).as_posix())
    return found, unmatched


def _only_masks(found: Mapping[str, list[Path]]) -> dict[str, Path]:
    """The mask of each photograph that has one, sorted by name."""
    for name, several in found.items():
        if len(several) > 1:
            raise InputError(f"{name} has {len(several)} masks: {join_names([str(p) for p in several])}; keep one")
    return {name: found[name][0] for name in sorted(found) if found[name]}


def _unmatched_message(folder: Path, unmatched: list[str], photographs: Mapping[str, Path]) -> str:
    """Message about masks that belong to no photograph."""
    return (
        f"masks in {folder} match no photograph: {join_names(sorted(unmatched))}; name a mask "
        f"like its photograph, such as {mask_paths(photographs)[min(photographs)]}"
    )


def _image_files(folder: Path, hidden: Container[str]) -> Iterator[Path]:
    """Image files below a folder; hidden ones only if named in `hidden`, as masks of hidden photographs."""
    if not folder.is_dir():
        if lexists(folder):
            raise InputError(f"{folder} is not a readable folder; expected one of mask images, or none")
        return
    for path in sorted(images.files_below(folder)):
        relative = path.relative_to(folder)
        if images.is_hidden(relative) and relative.with_suffix("").as_posix() not in hidden:
            continue
        if path.suffix.lower() not in images.IMAGE_SUFFIXES:
            continue
        if not path.is_file():
            raise InputError(f"mask {path} is not a readable file; replace or remove it")
        yield path


def mask_paths(photographs: Iterable[str]) -> dict[str, Path]:
    """Path of a mask in its folder, unique for every photograph of a capture.

    Names are assigned to photographs inside the capture first, then to those whose names lead out of it.
    """
    return images.image_paths(sorted(photographs, key=lambda name: (images.leaves_folder(name), name)))


Owners = Mapping[str, list[str]]
"""Names of photographs by a possible name of their masks."""


def _owners_by_key(photographs: Iterable[str]) -> tuple[Owners, Owners, Owners]:
    """Photographs by their `mask_paths`, their own names, and their names without folders; with and without suffix."""
    unique = {path.with_suffix("").as_posix(): [name] for name, path in mask_paths(photographs).items()}
    whole, bare = defaultdict[str, list[str]](list), defaultdict[str, list[str]](list)
    for name in photographs:
        path = PurePosixPath(name)
        for key in {name, str(path.with_suffix(""))}:
            whole[key].append(name)
        for key in {path.name, path.stem}:
            bare[key].append(name)
    return unique, whole, bare


def _owners(relative: Path, keys: tuple[Owners, Owners, Owners]) -> list[str]:
    """The photographs to which a mask file may belong, by its most specific match."""
    unique, *others = keys
    plain = relative.with_suffix("").as_posix()
    if plain in unique:
        return unique[plain]
    spellings = relative.as_posix(), plain, plain.removesuffix(MASK_SUFFIX)
    return next((owners[key] for owners in others for key in spellings if key in owners), [])


def _check_same_kind(values: Mapping[str, MaskValues], paths: Mapping[str, Path]) -> None:
    """Refuse a set that mixes label images and binary masks."""
    kinds = {kind: [str(paths[name]) for name, v in values.items() if v.kind == kind] for kind in ("labels", "binary")}
    if kinds["labels"] and kinds["binary"]:
        raise InputError(
            f"some masks are label images ({join_names(kinds['labels'], 2)}) and others black and white "
            f"({join_names(kinds['binary'], 2)}); write all of them with pane labels 1..K"
        )


def _decide_polarity(values: list[MaskValues], polarity: Polarity) -> tuple[bool, list[str]]:
    """Return whether dark pixels mark the pane, and a warning if that was guessed."""
    binary = [v for v in values if v.kind == "binary"]
    if polarity != "auto" or not binary:
        return polarity == "dark" and bool(binary), []
    borders = (np.concatenate([p[0], p[-1], p[1:-1, 0], p[1:-1, -1]]) for p in (v.pixels for v in binary))
    frame = float(np.median([(border > 0).mean() for border in borders]))
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
