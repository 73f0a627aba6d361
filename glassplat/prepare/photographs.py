"""Photographs of cameras and phones, and frames extracted from a video."""

from __future__ import annotations

import hashlib
import importlib
import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageOps

from glassplat.captures.masks import IGNORE_FOLDER, MASK_FOLDER, MASK_SUFFIX, PANE_FOLDER
from glassplat.errors import InputError, join_names
from glassplat.files import images
from glassplat.files.records import readable_name, wrap_read_errors
from glassplat.training.messages import Working


@dataclass(frozen=True)
class Note:
    """A message to show to the user at once, a full sentence."""

    text: str


Listener = Callable[[Working | Note], None]

UNREADABLE_SUFFIXES = (".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2")
"""Photographs that Pillow cannot read."""
HEIF_BRANDS = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
"""Bytes 8 to 12 of HEIF files, whatever their suffix: phones and messengers name some of them `.jpg`."""
LEAST_SIDE = 64
"""Minimum shorter side in pixels; smaller images have too few features."""
FEWEST_PHOTOGRAPHS = 3
FILM_DIAGONAL = math.hypot(36, 24)
"""Diagonal of 35 mm film in millimetres, to which focal lengths are converted."""
SIDEWAYS = (5, 6, 7, 8)
"""Values of the EXIF orientation that rotate a photograph by 90 degrees."""


@dataclass(frozen=True)
class Photograph:
    """One photograph to register.

    Attributes:
        path: the file.
        name: in the capture, with `/` between folders.
        width, height: in pixels after rotation and reduction.
        device: camera and lens; photographs of one device and size share intrinsics.
        focal: in pixels of the reduced photograph; None if unknown.
        transparent: the photograph has transparent parts, which are read as black.
    """

    path: Path
    name: str
    width: int
    height: int
    device: str
    focal: float | None
    transparent: bool = False


PHOTOGRAPH_SUFFIX = ".jpg"
"""Suffix of photographs written into a capture."""
CAPTURE_FOLDERS = ("sparse", "panes", "gt", "ignore")
MASK_FOLDERS = (PANE_FOLDER, MASK_FOLDER, IGNORE_FOLDER)
MASKS_NOT_COPIED = (
    "They are not copied to the capture: make masks for its undistorted, possibly smaller photographs, and put "
    "them into its masks/, ignore/ or panes/."
)


def photographs_in(folder: Path, max_size: int, listen: Listener) -> list[Photograph]:
    """The photographs below a folder in the order of the numbers in their names; each is decoded once as a check."""
    if (folder / "images").is_dir() and any((folder / name).is_dir() for name in CAPTURE_FOLDERS):
        raise InputError(f"{folder} is a capture; expected a folder of photographs, such as {folder / 'images'}")
    paths = _photograph_paths(folder)
    masks = masks_below(folder, paths)
    if masks:
        listen(
            Note(
                f"Skipped masks, recognised by their names or folders: {_names_below(folder, sorted(masks))}. "
                f"{MASKS_NOT_COPIED}"
            )
        )
        paths = [path for path in paths if path not in masks]
    names = capture_names(paths, folder)
    copies: dict[bytes, list[Photograph]] = defaultdict(list)
    broken: dict[str, InputError] = {}
    for done, path in enumerate(paths):
        listen(Working("checking the photographs", done, len(paths)))
        try:
            photograph, contents = _inspect_photograph(path, names[path], max_size)
            copies[contents].append(photograph)
        except InputError as error:
            broken[path.name] = error
    if broken:
        first = next(iter(broken.values()))
        if len(broken) == 1:
            raise first
        raise InputError(
            f"{len(broken)} of {len(paths)} photographs cannot be used ({join_names(list(broken))}); replace or remove "
            f"them. The first: {first}"
        )
    # `IMG 9 copy.jpg` sorts before `IMG 9.jpg`; keep the latter.
    found = {contents: min(same, key=lambda one: len(one.name)) for contents, same in copies.items()}
    duplicates = [
        f"{one.path.name} (as {found[contents].path.name})"
        for contents, same in copies.items()
        for one in same
        if one is not found[contents]
    ]
    if len(found) < FEWEST_PHOTOGRAPHS:
        again = f", and duplicates of them ({join_names(duplicates)})" if duplicates else ""
        raise InputError(
            f"{folder} holds too few photographs: {len(found)}{again}; expected at least {FEWEST_PHOTOGRAPHS}, better "
            "30 or more, taken a step apart"
        )
    if duplicates:
        listen(Note(f"Skipped duplicates: {join_names(duplicates)}."))
    cut_out = [one.path for one in found.values() if one.transparent]
    if cut_out:
        listen(
            Note(
                f"Transparent parts of {len(cut_out)} of {len(found)} photographs become black "
                f"({_names_below(folder, cut_out)}); exclude them by masks in the capture's ignore/."
            )
        )
    return list(found.values())


def file_states(source: Path) -> dict[str, list[int]]:
    """Size and modification time of a video, or of every photograph below a folder, by name."""
    folder, paths = (source.parent, [source]) if source.is_file() else (source, _photograph_paths(source))
    found = {}
    for path in paths:
        state = path.stat()
        found[readable_name(path.relative_to(folder))] = [state.st_size, state.st_mtime_ns]
    return found


def broken_photographs(paths: Sequence[Path], least_side: int) -> list[str]:
    """Names of files that cannot be read, or whose shorter side is below `least_side`; decoded at a small size."""
    broken = []
    for path in paths:
        try:
            _inspect_photograph(path, path.name, LEAST_SIDE, least_side)
        except InputError:
            broken.append(path.name)
    return broken


def capture_names(paths: Sequence[Path], folder: Path) -> dict[Path, str]:
    """Name of each photograph in the capture: its own name below the folder, as a JPEG.

    Names are unique even without suffix, which masks require. Undecodable bytes and line breaks are replaced.
    """
    unreadable = re.compile(r"[\x00-\x1f\x7f\ud800-\udfff]")
    printable = {path: unreadable.sub("_", path.relative_to(folder).as_posix()) for path in paths}
    # Names may collide, for example after replacing undecodable bytes.
    counts: Counter[str] = Counter()
    for path, name in printable.items():
        counts[name] += 1
        if counts[name] > 1:
            printable[path] = f"{name}-{counts[name]}"
    unique = images.image_paths(list(printable.values()))
    return {path: unique[name].with_suffix(PHOTOGRAPH_SUFFIX).as_posix() for path, name in printable.items()}


def masks_among(paths: Sequence[Path]) -> list[Path]:
    """Files named as the mask of another file in their folder: `x_mask.png` of `x.jpg`."""
    plain = {path.with_suffix("") for path in paths}
    named = [path for path in paths if path.stem.endswith(MASK_SUFFIX)]
    return [path for path in named if path.with_name(path.stem.removesuffix(MASK_SUFFIX)) in plain]


def masks_below(folder: Path, paths: Sequence[Path]) -> set[Path]:
    """Files below a folder that are masks by their names or by the names of their folders."""
    inside = [path for path in paths if not {*MASK_FOLDERS}.isdisjoint(path.relative_to(folder).parts[:-1])]
    return {*masks_among(paths), *inside}


def _names_below(folder: Path, paths: Sequence[Path]) -> str:
    return join_names([readable_name(path.relative_to(folder)) for path in paths])


def read_photograph(photograph: Photograph) -> NDArray[np.uint8]:
    """[H, W, 3] sRGB, upright, reduced; transparent parts black."""
    try:
        image = _read_upright(photograph.path).resize(
            (photograph.width, photograph.height), Image.Resampling.LANCZOS, reducing_gap=3
        )
    except (ValueError, FileNotFoundError) as error:
        raise InputError(str(error)) from error
    return np.ascontiguousarray(image, dtype=np.uint8)


def _read_upright(path: Path) -> Image.Image:
    """The image as 8-bit sRGB over black, rotated by its EXIF orientation."""
    with images.checked_image(path) as image:
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        shown = images.convert_to_srgb(image)
        shown.getexif()[ExifTags.Base.Orientation] = orientation
        upright = ImageOps.exif_transpose(shown)
    if not upright.has_transparency_data:
        return upright.convert("RGB")
    seen = upright.convert("RGBA")
    return Image.alpha_composite(Image.new("RGBA", seen.size, "black"), seen).convert("RGB")


def _photograph_paths(folder: Path) -> list[Path]:
    """Image files below a folder in natural order: 2.jpg before 10.jpg."""
    if not folder.is_dir():
        raise InputError(f"no folder or video {folder}; expected a folder of photographs, or a video file")
    below = images.files_below(folder)
    files = [path for path in below if path.is_file() and not images.is_hidden(path.relative_to(folder))]
    unreadable = {path.name: kind for path in sorted(files) if (kind := _unreadable_kind(path))}
    if unreadable:
        kinds = "/".join(sorted(set(unreadable.values())))
        raise InputError(
            f"{folder} holds {kinds} files, which cannot be read: {join_names(list(unreadable))}; save them "
            "as JPEG and remove these (a phone does so if its camera is set to 'most compatible'). "
            "To read HEIC: pip install 'glassplat[heic]'"
        )
    suffixes = (*images.IMAGE_SUFFIXES, *(images.HEIF_SUFFIXES if images.can_read_heif() else ()))
    paths = [path for path in files if path.suffix.lower() in suffixes]
    if not paths:
        found = join_names(sorted(path.name for path in files)) or "nothing"
        raise InputError(f"no photograph in {folder}; expected {', '.join(suffixes)} files, found {found}")
    return sorted(paths, key=lambda path: _natural_sort_key(path.relative_to(folder).as_posix()))


def _unreadable_kind(path: Path) -> str | None:
    """Format of a photograph that Pillow cannot read, by its suffix or first bytes; None for all others."""
    suffix = path.suffix.lower()
    if suffix in UNREADABLE_SUFFIXES or (suffix in images.HEIF_SUFFIXES and not images.can_read_heif()):
        return suffix[1:].upper()
    if suffix not in images.IMAGE_SUFFIXES or images.can_read_heif():
        return None
    try:
        with wrap_read_errors(path), path.open("rb") as file:
            start = file.read(12)
    except (ValueError, FileNotFoundError):
        return None  # Reported when it is decoded.
    return "HEIC" if start[4:8] == b"ftyp" and start[8:] in HEIF_BRANDS else None


def _natural_sort_key(name: str) -> tuple[tuple[tuple[int, int, str], ...], str]:
    """Sorting key for natural order: numbers in a name by their value, then the name itself."""
    parts = re.findall(r"\d+|\D+", name)
    return tuple((0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts), name


def _inspect_photograph(path: Path, name: str, max_size: int, least_side: int = LEAST_SIDE) -> tuple[Photograph, bytes]:
    """A photograph and the hash of its file, which is decoded at a small size to detect truncation."""
    try:
        size = images.image_size(path)
        with images.checked_image(path) as image:
            exif = image.getexif()
            sideways = exif.get(ExifTags.Base.Orientation) in SIDEWAYS
            tags = dict(exif) | dict(exif.get_ifd(ExifTags.IFD.Exif))
            image.draft("RGB", (LEAST_SIDE, LEAST_SIDE))
            image.load()
            transparent = images.opacity(image) is not None
        with wrap_read_errors(path):
            contents = hashlib.blake2b(path.read_bytes(), digest_size=16).digest()
    except (ValueError, FileNotFoundError) as error:
        raise InputError(str(error)) from error
    if min(size) < least_side:
        raise InputError(
            f"{path} is {size[0]}x{size[1]} pixels; expected a photograph of at least {least_side} pixels "
            "along each side: remove it"
        )
    width, height = size[::-1] if sideways else size
    scale = min(1.0, max_size / max(size))
    width, height = round(width * scale), round(height * scale)
    device, focal = _device_name(tags), _focal_length(tags, width, height)
    return Photograph(path, name, width, height, device, focal, transparent), contents


def _device_name(tags: dict) -> str:
    """Maker, model, lens and zoom from EXIF; digital zoom appears only in the 35 mm equivalent focal length."""
    lens = (ExifTags.Base.LensModel, ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)
    kinds = (ExifTags.Base.Make, ExifTags.Base.Model, *lens)
    return " ".join(str(tags[kind]).strip("\0 ") for kind in kinds if tags.get(kind))


def _focal_length(tags: dict, width: int, height: int) -> float | None:
    """Focal length in pixels of the reduced photograph, from the 35 mm equivalent."""
    try:
        focal = float(tags.get(ExifTags.Base.FocalLengthIn35mmFilm) or 0)
    except (TypeError, ValueError):
        return None
    return focal / FILM_DIAGONAL * math.hypot(width, height) if 5 <= focal <= 2000 else None


VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".3gp")
SMALL_SIDE = 320
"""Longer side, in pixels, of the frames in which motion and sharpness are measured."""
LEAST_SPACING = 0.02
"""Minimum motion between two selected frames, as a share of the longer side; smaller motion shows nothing new."""
FEWEST_FRAMES = 8
CORNERS = {"maxCorners": 200, "qualityLevel": 0.01, "minDistance": 7}
FEWEST_CORNERS = 10


def extract_frames(video: Path, folder: Path, most: int, listen: Listener) -> list[Path]:
    """Writes selected frames of a video as PNG files into a folder, named by their index in the video.

    Args:
        video: the file.
        folder: output; existing frames are kept, so that an interrupted extraction continues.
        most: maximum number of frames; a video with little motion yields fewer.
        listen: receives the progress.
    """
    cv2 = _import_opencv()
    travelled, sharpness = _measure_motion(cv2, video, listen)
    chosen = chosen_frames(travelled, sharpness, most)
    if len(chosen) < FEWEST_FRAMES:
        raise InputError(
            f"{video} has {len(chosen)} sufficiently different views in {len(sharpness)} frames; expected "
            f"at least {FEWEST_FRAMES}: walk slowly past the subject, with enough light"
        )
    folder.mkdir(parents=True, exist_ok=True)
    paths = {int(number): folder / f"frame_{number:06d}.png" for number in chosen}
    missing = {number for number, path in paths.items() if not path.is_file()}
    for number, frame in enumerate(_read_frames(cv2, video) if missing else ()):
        if number in missing:
            listen(Working("extracting frames", sorted(paths).index(number), len(paths)))
            images.write_image(paths[number], frame[:, :, ::-1])
    return list(paths.values())


def chosen_frames(travelled: NDArray[np.float64], sharpness: NDArray[np.float64], most: int) -> NDArray[np.int64]:
    """Indices of the sharpest frame in each interval of equal motion, which is at least `LEAST_SPACING`.

    Args:
        travelled: [F] cumulative image motion since the first frame, in longer image sides.
        sharpness: [F] of each frame.
        most: maximum number of intervals.
    """
    spacing = max(float(travelled[-1] - travelled[0]) / most, LEAST_SPACING)
    # The last frame belongs to the last interval.
    interval = np.minimum(np.floor((travelled - travelled[0]) / spacing).astype(np.int64), most - 1)
    order = np.lexsort((-sharpness, interval))
    firsts = np.unique(interval[order], return_index=True)[1]
    return np.sort(order[firsts])


class NoOpenCVError(InputError):
    """Raised when a video is to be read and OpenCV is not installed; the message says what to do."""


def video_facts(video: Path) -> dict[str, Any] | None:
    """Number of frames of a video, and their size as text; None if OpenCV cannot read a frame.

    Raises:
        NoOpenCVError: OpenCV is not installed.
    """
    cv2 = _import_opencv()
    frame = next(_read_frames(cv2, video), None)
    if frame is None:
        return None
    return {"frames": _frame_count(cv2, video), "pictures": f"{frame.shape[1]}x{frame.shape[0]}"}


def _import_opencv() -> Any:
    try:
        return importlib.import_module("cv2")
    except ImportError as error:
        raise NoOpenCVError(
            "reading a video needs OpenCV, which is not installed; run pip install 'glassplat[video]', or give a "
            "folder of photographs"
        ) from error


def _measure_motion(cv2: Any, video: Path, listen: Listener) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[F] motion up to each frame, and [F] variance of the Laplacian of the reduced frame."""
    travelled, sharpness = [], []
    before, distance = None, 0.0
    total = _frame_count(cv2, video)
    for number, frame in enumerate(_read_frames(cv2, video)):
        if number % 10 == 0:
            listen(Working("reading the video", min(number, total), total))
        scale = min(1.0, SMALL_SIDE / max(frame.shape[:2]))
        size = [max(1, round(side * scale)) for side in frame.shape[1::-1]]
        small = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)
        if before is not None:
            distance += _motion(cv2, before, small)
        travelled.append(distance)
        sharpness.append(float(cv2.Laplacian(small, cv2.CV_64F).var()))
        before = small
    if not travelled:
        raise InputError(f"{video} has no frame that OpenCV can read; expected a video, or a folder of photographs")
    return np.array(travelled), np.array(sharpness)


def _frame_count(cv2: Any, video: Path) -> int:
    capture = cv2.VideoCapture(str(video))
    frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    return max(frames, 1)


def _read_frames(cv2: Any, video: Path) -> Iterator[NDArray[np.uint8]]:
    """Frames [H, W, 3], BGR, rotated by the metadata of the video."""
    capture = cv2.VideoCapture(str(video))
    try:
        while True:
            read, frame = capture.read()
            if not read:
                return
            yield frame
    finally:
        capture.release()


def _motion(cv2: Any, before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """Median motion of corners from one frame to the next, in longer image sides; 0 if there are too few."""
    corners = cv2.goodFeaturesToTrack(before, **CORNERS)
    if corners is None or len(corners) < FEWEST_CORNERS:
        return 0.0
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)
    lengths = np.linalg.norm(moved - corners, axis=-1)[found.astype(bool)]
    return float(np.median(lengths)) / max(before.shape) if len(lengths) >= FEWEST_CORNERS else 0.0
