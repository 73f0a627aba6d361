"""Photographs from a video: as far apart as the camera moved, and of each stretch the sharpest.

OpenCV reads it, which is imported only here: photographs need none.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from glassplat.errors import InputError
from glassplat.files.images import write_image
from glassplat.prepare.photographs import Listener, Progress

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".3gp")
SMALL_SIDE = 320
"""Pixels of the longer side at which motion and sharpness are measured."""
LEAST_SPACING = 0.02
"""Of the image's longer side, between two photographs that are kept: a picture that hardly moved shows nothing new."""
FEWEST_FRAMES = 8
CORNERS = {"maxCorners": 200, "qualityLevel": 0.01, "minDistance": 7}
FEWEST_CORNERS = 10


@dataclass(frozen=True)
class Footage:
    """Measurements of a first look at a video, for each frame.

    Attributes:
        travelled: [F] how far the picture has moved since the first frame, in image sides.
        sharpness: [F] variance of the Laplacian at a small size.
    """

    travelled: NDArray[np.float64]
    sharpness: NDArray[np.float64]


def frames_of(video: Path, folder: Path, most: int, listen: Listener) -> list[Path]:
    """Writes the chosen frames of a video as PNG files into a folder, named by their number in the video.

    Args:
        video: the file.
        folder: where to; frames that are there already are kept, so that an interrupted choice goes on.
        most: number of frames wanted.
        listen: is told how far it is.

    Raises:
        InputError: OpenCV is missing, the file is no video, or one in which nothing moves.
    """
    cv2 = _opencv()
    footage = _measured(cv2, video, listen)
    chosen = chosen_frames(footage, most)
    if len(chosen) < FEWEST_FRAMES:
        raise InputError(
            f"{video} shows {len(chosen)} different places in {len(footage.sharpness)} frames; expected at least "
            f"{FEWEST_FRAMES}: film while walking slowly past what you want to capture, with enough light"
        )
    folder.mkdir(parents=True, exist_ok=True)
    paths = {int(number): folder / f"frame_{number:06d}.png" for number in chosen}
    missing = {number for number, path in paths.items() if not path.is_file()}
    for number, frame in enumerate(_frames(cv2, video) if missing else ()):
        if number in missing:
            listen(Progress("taking photographs from the video", sorted(paths).index(number), len(paths)))
            write_image(paths[number], frame[:, :, ::-1])
    return list(paths.values())


def chosen_frames(footage: Footage, most: int) -> NDArray[np.int64]:
    """The sharpest frame of every stretch of equal motion; stretches are at least `LEAST_SPACING` long."""
    path = footage.travelled
    spacing = max(float(path[-1] - path[0]) / most, LEAST_SPACING)
    stretch = np.floor((path - path[0]) / spacing).astype(np.int64)
    order = np.lexsort((-footage.sharpness, stretch))
    firsts = np.unique(stretch[order], return_index=True)[1]
    return np.sort(order[firsts])


class NoOpenCVError(InputError):
    """A video was to be read, and OpenCV is not installed; the message says what to do."""


@dataclass(frozen=True)
class VideoFacts:
    """Facts of a video: the number of its frames, and their width and height in pixels."""

    frames: int
    width: int
    height: int


def video_facts(video: Path) -> VideoFacts | None:
    """Facts of a video; None if OpenCV can read no picture of it.

    Raises:
        NoOpenCVError: OpenCV is not installed.
    """
    cv2 = _opencv()
    frame = next(_frames(cv2, video), None)
    return None if frame is None else VideoFacts(_length(cv2, video), frame.shape[1], frame.shape[0])


def _opencv() -> Any:
    try:
        return importlib.import_module("cv2")
    except ImportError as error:
        raise NoOpenCVError(
            "reading a video needs OpenCV, which is not installed; run pip install 'glassplat[video]', or give a "
            "folder of photographs"
        ) from error


def _measured(cv2: Any, video: Path, listen: Listener) -> Footage:
    travelled, sharpness = [], []
    before, way = None, 0.0
    total = _length(cv2, video)
    for number, frame in enumerate(_frames(cv2, video)):
        if number % 10 == 0:
            listen(Progress("looking through the video", min(number, total), total))
        small = _small_grey(cv2, frame)
        if before is not None:
            way += _motion(cv2, before, small)
        travelled.append(way)
        sharpness.append(float(cv2.Laplacian(small, cv2.CV_64F).var()))
        before = small
    if not travelled:
        raise InputError(f"{video} holds no picture that OpenCV can read; expected a video, or a folder of photographs")
    return Footage(np.array(travelled), np.array(sharpness))


def _length(cv2: Any, video: Path) -> int:
    capture = cv2.VideoCapture(str(video))
    frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    return max(frames, 1)


def _frames(cv2: Any, video: Path) -> Iterator[NDArray[np.uint8]]:
    """Frames [H, W, 3], BGR, turned as the video says."""
    capture = cv2.VideoCapture(str(video))
    try:
        while True:
            read, frame = capture.read()
            if not read:
                return
            yield frame
    finally:
        capture.release()


def _small_grey(cv2: Any, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    scale = min(1.0, SMALL_SIDE / max(frame.shape[:2]))
    size = [max(1, round(side * scale)) for side in frame.shape[1::-1]]
    return cv2.resize(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), size, interpolation=cv2.INTER_AREA)


def _motion(cv2: Any, before: NDArray[np.uint8], after: NDArray[np.uint8]) -> float:
    """The median way of corners from one frame to the next, in image sides; 0 where there are hardly any."""
    corners = cv2.goodFeaturesToTrack(before, **CORNERS)
    if corners is None or len(corners) < FEWEST_CORNERS:
        return 0.0
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, None)
    ways = np.linalg.norm(moved - corners, axis=-1)[found.astype(bool)]
    return float(np.median(ways)) / max(before.shape) if len(ways) >= FEWEST_CORNERS else 0.0
