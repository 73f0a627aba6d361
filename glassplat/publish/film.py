"""Films: pictures one after the other.

`.mp4` is VP9, which browsers play: OpenCV's wheels bring libvpx (BSD) and FFmpeg without its GPL parts.
`.webp` and `.gif` need nothing beyond Pillow.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

Picture = NDArray[np.uint8]

CODECS = {".mp4": "vp09"}
ANIMATIONS = (".webp", ".gif")
SUFFIXES = (*CODECS, *ANIMATIONS)
WEBP_QUALITY = 80


def write_film(path: Path, pictures: Iterable[Picture], fps: int) -> int:
    """Writes a film; returns the number of its pictures.

    Args:
        path: the file, new; its suffix is one of `SUFFIXES`.
        pictures: [H, W, 3] each, of one size with even sides; taken one at a time.
        fps: pictures per second.

    Raises:
        ImportError: OpenCV is needed and not installed.
        OSError: the film cannot be written, as on a full disk.
        ValueError: there is no picture, or the suffix is another one.
    """
    stream = iter(pictures)
    first = next(stream, None)
    if first is None or path.suffix not in SUFFIXES:
        raise ValueError(f"a film needs a picture and a name that ends in one of {', '.join(SUFFIXES)}")
    write = _write_animation if path.suffix in ANIMATIONS else _write_video
    return write(path, first, stream, fps)


def check_encoder(path: Path) -> None:
    """Looks whether a film of this name can be written here, before anything is rendered.

    Raises:
        ImportError: OpenCV is needed and not installed.
        ValueError: the suffix is none of `SUFFIXES`.
    """
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{path.name} is no name of a film; expected it to end in one of {', '.join(SUFFIXES)}")
    if path.suffix in CODECS:
        import cv2  # noqa: F401


def side_by_side(pictures: list[Picture]) -> Picture:
    """Pictures of one size next to each other."""
    return np.concatenate(pictures, axis=1)


def wipe_pictures(left: Picture, right: Picture, share: float) -> Picture:
    """The left picture up to a share of the width, a bright line, and then the right one."""
    column = round(share * left.shape[1])
    picture = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    picture[:, max(column - 1, 0) : column + 1] = 255
    return picture


def _write_animation(path: Path, first: Picture, rest: Iterator[Picture], fps: int) -> int:
    count = 1

    def images() -> Iterator[Image.Image]:
        nonlocal count
        for picture in rest:
            count += 1
            yield Image.fromarray(picture)

    options = {"duration": round(1000 / fps), "loop": 0, "quality": WEBP_QUALITY}
    with path.open("wb") as file:  # Pillow leaves a file open that it opens itself, where Ctrl-C ends it.
        kind = path.suffix.removeprefix(".").upper()
        Image.fromarray(first).save(file, kind, save_all=True, append_images=images(), **options)
    return count


def _write_video(path: Path, first: Picture, rest: Iterator[Picture], fps: int) -> int:
    import cv2

    height, width = first.shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*CODECS[path.suffix]), float(fps), (width, height))
    try:
        if not writer.isOpened():
            raise OSError(f"this OpenCV cannot write VP9 to {path}; give a name that ends in .webp")
        count = 0
        for picture in chain([first], rest):
            writer.write(np.ascontiguousarray(picture[..., ::-1]))
            count += 1
    finally:
        writer.release()
    # The encoder says nothing of a disk that is full.
    if _pictures_in(path) != count:
        raise OSError(f"the film could not be written whole to {path}; is the disk full?")
    return count


def _pictures_in(path: Path) -> int:
    import cv2

    film = cv2.VideoCapture(str(path))
    count = 0
    while film.grab():
        count += 1
    film.release()
    return count
