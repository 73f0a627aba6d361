"""Writing of videos and animations.

`.mp4` is VP9, which browsers play: OpenCV's wheels include libvpx (BSD) and FFmpeg without its GPL parts. `.webp` and
`.gif` only need Pillow.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

ImageArray = NDArray[np.uint8]

ANIMATIONS = (".webp", ".gif")
SUFFIXES = (".mp4", *ANIMATIONS)
WEBP_QUALITY, LARGEST_WEBP = 80, 16383
MOST_IN_GIF = 50
"""Maximum frames per second: a GIF counts in hundredths of a second, and browsers play one hundredth as ten."""


def encode_video(path: Path, frames: Iterable[ImageArray], *, count: int, fps: int) -> None:
    """Writes a video.

    Args:
        path: a new file; its suffix is one of `SUFFIXES`.
        frames: [H, W, 3] of equal, even size; read one at a time.
        count: number of frames.
        fps: frames per second.

    Raises:
        ImportError: OpenCV is needed and not installed.
        OSError: the video cannot be written, as on a full disk.
        ValueError: there is no frame, or the suffix is not supported.
    """
    stream = iter(frames)
    first = next(stream, None)
    if first is None or path.suffix not in SUFFIXES:
        raise ValueError(f"a video needs a frame and a name that ends in one of {', '.join(SUFFIXES)}")
    if path.suffix in ANIMATIONS:
        _write_animation(path, first, stream, _durations(path, count, fps))
    else:
        _write_video(path, first, stream, fps)


def check_encoder(path: Path, fps: int) -> None:
    """Checks that a video of this name can be written, before anything is rendered.

    Raises:
        ImportError: OpenCV is needed and not installed.
        ValueError: the suffix is not one of `SUFFIXES`, or a GIF does not support this frame rate.
    """
    if path.suffix not in SUFFIXES:
        raise ValueError(f"{path.name} is not a video name; expected one that ends in one of {', '.join(SUFFIXES)}")
    if path.suffix == ".gif" and fps > MOST_IN_GIF:
        raise ValueError(
            f"a .gif shows at most {MOST_IN_GIF} frames per second, not {fps}; lower --fps, or end the name in .webp"
        )
    if path.suffix not in ANIMATIONS:
        import cv2  # noqa: F401


def check_size(path: Path, width: int, height: int) -> None:
    """Checks that the format of a video supports the size of its frames, before anything is rendered.

    Raises:
        ValueError: the size is too large for a WebP.
    """
    if path.suffix == ".webp" and max(width, height) > LARGEST_WEBP:
        raise ValueError(
            f"a .webp has at most {LARGEST_WEBP} pixels a side, not {width} x {height}; lower --width, or end the name "
            "in .mp4"
        )


def side_by_side(images: list[ImageArray]) -> ImageArray:
    """Images of one size, concatenated horizontally."""
    return np.concatenate(images, axis=1)


def wipe_images(left: ImageArray, right: ImageArray, share: float) -> ImageArray:
    """A split image: the left one up to a share of the width, a white line, and the right one."""
    column = round(share * left.shape[1])
    image = np.concatenate([left[:, :column], right[:, column:]], axis=1)
    image[:, max(column - 1, 0) : column + 1] = 255
    return image


def _durations(path: Path, count: int, fps: int) -> list[int]:
    """Milliseconds of each frame; cumulative times are rounded, so that the total duration is exact."""
    step = 10 if path.suffix == ".gif" else 1
    ends = [step * round(1000 * k / fps / step) for k in range(count + 1)]
    return [after - before for before, after in pairwise(ends)]


class _LaterFrames:
    """All frames but the first, as one multi-frame image; Pillow would keep a list of images in memory."""

    def __init__(self, frames: Iterator[ImageArray], count: int) -> None:
        self.n_frames = count
        self._frames = frames
        self._image: Image.Image | None = None

    def seek(self, frame: int) -> None:
        """Reads the next frame; Pillow requests them in order."""
        if frame >= self.n_frames:
            raise EOFError
        self._image = Image.fromarray(next(self._frames))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._image, name)


def _write_animation(path: Path, first: ImageArray, rest: Iterator[ImageArray], durations: list[int]) -> None:
    later = _LaterFrames(rest, len(durations) - 1)
    with path.open("wb") as file:  # After Ctrl-C, Pillow would leave a file open that it opened.
        kind = path.suffix.removeprefix(".").upper()
        options = {"duration": durations, "loop": 0, "quality": WEBP_QUALITY}
        Image.fromarray(first).save(file, kind, save_all=True, append_images=[later], **options)


def _write_video(path: Path, first: ImageArray, rest: Iterator[ImageArray], fps: int) -> None:
    import cv2

    height, width = first.shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"vp09"), float(fps), (width, height))
    try:
        if not writer.isOpened():
            raise OSError(f"this OpenCV cannot write VP9 to {path}; give a name that ends in .webp")
        count = 0
        for frame in chain([first], rest):
            writer.write(np.ascontiguousarray(frame[..., ::-1]))
            count += 1
    finally:
        writer.release()
    # The encoder does not report a full disk.
    if _count_frames(path) != count:
        raise OSError(f"the video could not be written completely to {path}; is the disk full?")


def _count_frames(path: Path) -> int:
    import cv2

    video = cv2.VideoCapture(str(path))
    count = 0
    while video.grab():
        count += 1
    video.release()
    return count
