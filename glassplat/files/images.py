"""Image files, with values as stored or converted to sRGB by their colour profile, and file names of views."""

from __future__ import annotations

import io
import os
import struct
import unicodedata
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, lru_cache
from itertools import count, takewhile
from pathlib import Path, PurePath, PurePosixPath, PureWindowsPath
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms, ImageFile, ImageOps

from glassplat.files.writing import atomic_write

if TYPE_CHECKING:
    from torch import Tensor

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".bmp", ".tif", ".tiff")
HEIF_SUFFIXES = (".heic", ".heif")
"""Photographs of phones; read if pi-heif is installed."""
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "GIF", "PPM", "TGA", "JPEG2000")
"""Accepted formats, whatever the suffix; not PostScript and other formats whose readers start programs."""
MOST_PIXELS = 2**27
"""Largest image, in pixels; decoding takes about ten bytes a pixel."""
COMPRESSION = 4
"""Compression level of PNG files, up to 9: half the time of Pillow's default 6 for 5 % more bytes."""
GREY_MODES_16 = ("I", "I;16", "I;16B", "I;16L", "I;16N")
_FULL_SCALE_16 = 65535
"""Value of white in 16 bits."""

# Harmless damaged tags cause warnings that name no file; harmful ones raise errors.
warnings.filterwarnings("ignore", module=r"PIL\.")
# `checked_image` checks the limit and names the file; Pillow's warning names none.
Image.MAX_IMAGE_PIXELS = None


@cache
def can_read_heif() -> bool:
    """Return whether HEIC photographs can be read; registers the Pillow plugin."""
    try:
        from pi_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


def open_image(path: Path) -> Image.Image:
    """Open and fully decode an image in its stored mode; orientation tags are not applied."""
    with checked_image(path) as image:
        image.load()
        _check_bit_depth(image)
        return image


def image_size(path: Path) -> tuple[int, int]:
    """Width and height as stored; decodes only the header, except for TIFFs with an orientation tag."""
    with checked_image(path) as image:
        return image.width, image.height


def is_transparent(path: Path) -> bool:
    """Return whether any pixel is transparent; decodes only images that store transparency."""
    with checked_image(path) as image:
        return opacity(image) is not None


def opacity(image: Image.Image) -> NDArray[np.uint8] | None:
    """[H, W] alpha channel; None if all pixels are opaque, whether or not the image stores alpha."""
    if not image.has_transparency_data:
        return None
    with_alpha = image if "A" in image.getbands() else image.convert("RGBA")
    alpha = np.array(with_alpha.getchannel("A"))
    return alpha if alpha.min() < 255 else None


def read_image(path: Path | str) -> NDArray[np.uint8]:
    """Read an image as uint8 [H, W, C]: one channel for grey, three for colour, four with transparency.

    Sixteen-bit grey is scaled to eight bits. Colours are not converted; use `read_colors` for photographs.
    """
    with checked_image(Path(path)) as image:
        return _pixels(_to_eight_bits(image))


def read_colors(path: Path | str) -> NDArray[np.uint8]:
    """Read a photograph as `read_image` does, with colours converted to sRGB by the embedded profile."""
    with checked_image(Path(path)) as image:
        return _pixels(convert_to_srgb(image))


def read_image_float(path: Path | str) -> NDArray[np.float32]:
    """Read an image as float32 [H, W, C] in [0, 1], with the full precision of sixteen-bit grey."""
    with checked_image(Path(path)) as image:
        if image.mode in GREY_MODES_16:
            return _grey_levels(image)[:, :, None]
        return _pixels(_to_eight_bits(image)).astype(np.float32) / np.float32(255)


def write_image(path: Path | str, image: Tensor | NDArray[np.generic]) -> None:
    """Write [H, W], [H, W, 1], [H, W, 3] or [H, W, 4] as an eight-bit image, atomically.

    Args:
        path: target; its suffix chooses the format.
        image: uint8, or floating point in [0, 1], which is clamped and rounded.

    Raises:
        TypeError: the values are neither uint8 nor floating point.
        ValueError: the shape is not that of an image, a value is not finite, or the format is unknown.
        OSError: the file cannot be written; an older one is unchanged.
    """
    pixels = _to_uint8(image if isinstance(image, np.ndarray) else image.detach().cpu().numpy())
    if Path(path).suffix.lower() not in IMAGE_SUFFIXES:
        raise ValueError(f"unknown image format of {path}; use one of the suffixes {', '.join(IMAGE_SUFFIXES)}")
    with atomic_write(path) as temporary:
        Image.fromarray(pixels).save(temporary, compress_level=COMPRESSION)


@contextmanager
def checked_image(path: Path) -> Iterator[Image.Image]:
    """An open image of checked size; Pillow's errors about bad files become one error that names the file."""
    try:
        with Image.open(path, formats=(*FORMATS, "HEIF") if can_read_heif() else FORMATS) as image:
            if image.width * image.height > MOST_PIXELS:
                size = f"{image.width}x{image.height} pixels"
                raise ValueError(f"it is {size}; expected at most {MOST_PIXELS / 1e6:.0f} megapixels: reduce it")
            _undo_rotation(image)
            yield image
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{path} does not exist; expected an image") from error
    except MemoryError:
        raise
    except Exception as error:  # Parsers raise anything for damaged bytes, from KeyError to struct.error.
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error) or type(error).__name__
        raise ValueError(f"cannot read {path} as an image ({reason}); replace the file or remove it") from error


INVERSE_ORIENTATION = {2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
"""The EXIF orientation that undoes each orientation."""


def _undo_rotation(image: ImageFile.ImageFile) -> None:
    """Undo Pillow's automatic rotation of TIFFs, which it applies to no other format, and restore their tag."""
    orientation = image.getexif().get(ExifTags.Base.Orientation) if image.format == "TIFF" else None
    if orientation in INVERSE_ORIENTATION:
        image.filename = ""  # With a name, Pillow would memory-map grey files in their rotated size.
        image.load()
        image.getexif()[ExifTags.Base.Orientation] = INVERSE_ORIENTATION[orientation]
        ImageOps.exif_transpose(image, in_place=True)
        image.getexif()[ExifTags.Base.Orientation] = orientation


PIXEL_MODES = {"RGB": "RGB", "GRAY": "L", "CMYK": "CMYK"}
"""Pillow's pixel mode by the colour space of a profile."""
NEARLY_SRGB = 1
"""Of 255: a profile that changes no colour by more is a variant of sRGB, and pixels stay unchanged."""


def convert_to_srgb(image: Image.Image) -> Image.Image:
    """The image in eight bits, converted from its embedded profile to sRGB.

    Without a profile, EXIF tags may declare Adobe RGB. Images without either, with an sRGB profile, or with a profile
    that is broken or for another pixel mode stay unchanged.
    """
    profile = image.info.get("icc_profile") or (adobe_rgb_profile() if _is_adobe_rgb(image) else None)
    image = _to_eight_bits(image)
    srgb_transform = _srgb_transform(profile) if profile and isinstance(profile, bytes) else None
    own = "CMYK" if image.mode == "CMYK" else "L" if image.mode in ("1", "L", "LA") else "RGB"
    if srgb_transform is None or (own, srgb_transform[0]) not in {("L", "RGB"), (own, own)}:
        return image
    mode, transform = srgb_transform
    converted = transform.apply(image if image.mode == mode else image.convert(mode))
    if image.has_transparency_data:
        converted.putalpha(image.convert("RGBA").getchannel("A"))
    return converted


def _is_adobe_rgb(image: Image.Image) -> bool:
    """Return whether the EXIF tags declare Adobe RGB as in DCF 2.0."""
    try:
        return bool(image.getexif().get_ifd(ExifTags.IFD.Interop).get(ExifTags.Interop.InteropIndex) == "R03")
    except Exception:  # noqa: BLE001 - Damaged tags raise anything, and are no reason to refuse an image.
        return False


ADOBE_GAMMA = 2.19921875
"""Exponent of radiance in Adobe RGB (1998)."""
ADOBE_PRIMARIES = {
    b"rXYZ": (0.60974, 0.31111, 0.01947),
    b"gXYZ": (0.20528, 0.62567, 0.06087),
    b"bXYZ": (0.14919, 0.06322, 0.74457),
}
"""XYZ primaries under D50, as in the Adobe RGB (1998) profile."""


@cache
def adobe_rgb_profile() -> bytes:
    """The profile of Adobe RGB (1998): the sRGB profile with other primaries and a power-law curve."""
    profile = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    (count,) = struct.unpack_from(">I", profile, 128)
    for index in range(count):
        tag, offset, _ = struct.unpack_from(">4sII", profile, 132 + 12 * index)
        if tag in ADOBE_PRIMARIES:
            struct.pack_into(">3i", profile, offset + 8, *(round(65536 * value) for value in ADOBE_PRIMARIES[tag]))
        elif tag.endswith(b"TRC"):
            struct.pack_into(">4sIHH5i", profile, offset, b"para", 0, 3, 0, round(65536 * ADOBE_GAMMA), 65536, 0, 0, 0)
    return bytes(profile)


@lru_cache(maxsize=8)
def _srgb_transform(profile: bytes) -> tuple[str, ImageCms.ImageCmsTransform] | None:
    """Pixel mode of a profile and its transform to sRGB; None if it is broken, unsupported, or already sRGB."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        mode = PIXEL_MODES[source.profile.xcolor_space.strip()]
        target = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
        transform = ImageCms.ImageCmsTransform(source, target, mode, "RGB")
    except (OSError, ValueError, KeyError):
        return None
    steps = np.arange(0, 256, 15, dtype=np.uint8)
    colors = np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(1, -1, 3)
    before = Image.fromarray(colors).convert(mode)
    after = np.asarray(transform.apply(before), dtype=np.int16)
    changed = np.abs(after - np.asarray(before.convert("RGB"))).max()
    return (mode, transform) if changed > NEARLY_SRGB else None


def _to_eight_bits(image: Image.Image) -> Image.Image:
    """The image, with sixteen-bit grey scaled to eight bits."""
    if image.mode in GREY_MODES_16:
        return Image.fromarray(np.round(_grey_levels(image) * 255).astype(np.uint8))
    _check_bit_depth(image)
    return image


def _pixels(image: Image.Image) -> NDArray[np.uint8]:
    """[H, W, C] of an eight-bit image as grey, RGB or RGBA."""
    mode = "RGBA" if image.has_transparency_data else "L" if image.mode in ("1", "L") else "RGB"
    pixels = np.array(image if image.mode == mode else image.convert(mode))
    return pixels[:, :, None] if pixels.ndim == 2 else pixels


def _check_bit_depth(image: Image.Image) -> None:
    """Raise ValueError for values without a defined white level."""
    if image.mode == "F":
        raise ValueError("it holds floating-point numbers; expected colours of 8 or 16 bits")
    if image.mode == "I":
        least, most = image.getextrema()
        if least < 0 or most > _FULL_SCALE_16:  # type: ignore[operator]
            raise ValueError(f"it holds values from {least} to {most}; expected colours of 8 or 16 bits")


def _grey_levels(image: Image.Image) -> NDArray[np.float32]:
    """Sixteen-bit grey as [H, W] in [0, 1]."""
    _check_bit_depth(image)
    return np.asarray(image).astype(np.float32) / np.float32(_FULL_SCALE_16)


def resize_by_area(pixels: NDArray[np.generic], width: int, height: int) -> NDArray[np.float32]:
    """[H, W] or [H, W, C] as [height, width(, C)]: exact means over the area of each new pixel, for any factor."""
    rows, columns = _area_weights(pixels.shape[0], height), _area_weights(pixels.shape[1], width)
    planes = pixels.reshape(*pixels.shape[:2], -1)
    means = np.empty((height, width, planes.shape[2]), dtype=np.float32)
    for index in range(planes.shape[2]):  # One by one, because all as floats take more memory than the photograph.
        means[..., index] = (columns @ (rows @ planes[..., index].astype(np.float32)).T).T
    return means.reshape(height, width, *pixels.shape[2:])


@lru_cache(maxsize=16)
def _area_weights(old: int, new: int) -> Any:
    """[new, old] sparse matrix: share of each new pixel that each old pixel covers, along one side."""
    from scipy import sparse

    edges = np.arange(new + 1) * old / new
    first, last = np.floor(edges[:-1]).astype(np.int64), np.ceil(edges[1:]).astype(np.int64)
    counts = last - first
    rows = np.repeat(np.arange(new), counts)
    columns = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts - first, counts)
    covered = np.minimum(columns + 1, edges[rows + 1]) - np.maximum(columns, edges[rows])
    return sparse.csr_array(((covered * new / old).astype(np.float32), (rows, columns)), shape=(new, old))


def _to_uint8(pixels: NDArray[np.generic]) -> NDArray[np.uint8]:
    """Eight-bit pixels in a shape that Pillow supports."""
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    if not (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] in (3, 4))) or 0 in pixels.shape:
        raise ValueError(f"expected an image of shape [H, W] or [H, W, 1, 3 or 4], got {list(pixels.shape)}")
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels, dtype=np.uint8)
    if not np.issubdtype(pixels.dtype, np.floating):
        raise TypeError(f"expected uint8 or floating-point pixels, got {pixels.dtype}; convert them first")
    values = pixels.astype(np.float64)
    if not np.isfinite(values).all():
        raise ValueError("the image contains non-finite values; expected numbers in [0, 1]")
    return np.ascontiguousarray(np.round(np.clip(values, 0, 1) * 255).astype(np.uint8))


def files_below(folder: Path) -> Iterator[Path]:
    """All files below a folder; linked folders are followed unless they contain the link itself."""
    around = {str(folder): frozenset[str]()}
    for where, folders, names in os.walk(folder, followlinks=True):
        inside = around.pop(where) | {os.path.realpath(where)}
        folders[:] = [name for name in folders if os.path.realpath(os.path.join(where, name)) not in inside]
        around.update((os.path.join(where, name), inside) for name in folders)
        yield from (Path(where, name) for name in names)


def is_hidden(relative: PurePath) -> bool:
    """Return whether a relative path is hidden: its name, or one of its folders, starts with a dot."""
    return any(part.startswith(".") for part in relative.parts)


Parts = tuple[str, ...]


def image_paths(names: Sequence[str]) -> dict[str, Path]:
    """PNG path of each view, always inside the output folder, and close to the photograph's name.

    Folders inside the capture are kept (`left/1.jpg` becomes `left/1.png`). Absolute paths and paths with `..` lose the
    folders that all of them share (`/home/me/photos/left/1.jpg` becomes `left/1.png`, too). No two views share a file,
    and no file has the path of another's folder, even on case-insensitive file systems.

    Args:
        names: of all views of the capture, so that a view's path does not depend on the selection.
    """
    return _unique_paths(_confined_parts(names))


def flat_image_names(names: Sequence[str]) -> dict[str, str]:
    """The same without folders: file names in a single folder."""
    flat = {name: ("_".join(parts),) for name, parts in _confined_parts(names).items()}
    return {name: path.name for name, path in _unique_paths(flat).items()}


def _unique_paths(parts: Mapping[str, Parts]) -> dict[str, Path]:
    """A unique file for every name; names without a clash are assigned first."""
    preferred = {name: _case_folded(_png_path(own)) for name, own in parts.items()}
    occurrences = Counter(preferred.values())
    taken: set[str] = set()
    paths: dict[str, Path] = {}
    # The deepest first, so that no file takes the path of a folder.
    for name in sorted(parts, key=lambda name: (-len(parts[name]), occurrences[preferred[name]] > 1)):
        candidates = _candidate_paths(parts[name], clash=occurrences[preferred[name]] > 1)
        path = next(path for path in candidates if not {_case_folded(path), f"{_case_folded(path)}/"} & taken)
        taken |= {_case_folded(path), *(f"{_case_folded(folder)}/" for folder in path.parents)}
        paths[name] = Path(path)
    return {name: paths[name] for name in parts}


def _confined_parts(names: Sequence[str]) -> dict[str, Parts]:
    """Folders and file of each name, confined to the output folder; backslashes are separators, as on Windows."""
    parts = {name: _normalise_parts(name) for name in names}
    outside = [name for name in names if leaves_folder(name)]
    columns = zip(*(parts[name][:-1] for name in outside), strict=False)
    shared = sum(1 for _ in takewhile(lambda column: len(set(column)) == 1, columns))
    return parts | {name: parts[name][shared:] for name in outside}


def leaves_folder(name: str) -> bool:
    """Return whether a name is an absolute path, or contains `..`."""
    path = PureWindowsPath(name)
    return bool(path.anchor) or ".." in path.parts


def _normalise_parts(name: str) -> Parts:
    path = PureWindowsPath(name)
    kept: list[str] = []
    for part in path.parts[bool(path.anchor) :]:
        if part == "..":
            kept[-1:] = []
        else:
            kept.append(part)
    return tuple(kept) or ("view",)


def _png_path(parts: Parts) -> PurePosixPath:
    return PurePosixPath(*parts).with_suffix(".png")


def _candidate_paths(parts: Parts, *, clash: bool) -> Iterator[PurePosixPath]:
    """Names in order of preference; with the photograph's own suffix if the plain name would clash."""
    if not clash:
        yield _png_path(parts)
    whole = PurePosixPath(*parts)
    yield whole.with_name(f"{whole.name}.png")
    yield from (whole.with_name(f"{whole.name}-{number}.png") for number in count(2))


def _case_folded(path: PurePosixPath) -> str:
    """Key of a path, equal for paths that a case-insensitive file system does not distinguish."""
    return unicodedata.normalize("NFC", str(path)).casefold()
