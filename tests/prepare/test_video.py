"""Frames of a video: spaced by the motion of the camera, the sharpest of each stretch."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from glassplat.errors import InputError
from glassplat.files.images import image_size
from glassplat.prepare import photographs as video
from glassplat.prepare.photographs import chosen_frames, extract_frames
from tests.prepare.conftest import Heard

WIDTH, HEIGHT = 320, 240


def film(path: Path, offsets: np.ndarray, *, blurred: range = range(0)) -> Path:
    """Video of a camera that moves along a wall of blobs; `offsets` are its positions in pixels in each frame."""
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, 1400, 3), dtype=np.uint8), (0, 0), 2)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25, (WIDTH, HEIGHT))
    for number, offset in enumerate(offsets):
        frame = wall[:, int(offset) : int(offset) + WIDTH]
        writer.write(cv2.GaussianBlur(frame, (0, 0), 4) if number in blurred else frame)
    writer.release()
    return path


def test_frames_are_spaced_by_motion_not_by_time(tmp_path: Path, heard: Heard) -> None:
    # The camera stands still, moves for 40 frames, and stands still again.
    offsets = np.concatenate([np.zeros(30), np.arange(40) * 16, np.full(30, 39 * 16)])
    paths = extract_frames(film(tmp_path / "walk.avi", offsets), tmp_path / "frames", 20, heard)
    numbers = [int(path.stem.split("_")[1]) for path in paths]
    assert 15 <= len(paths) <= 22
    assert sum(30 <= number < 71 for number in numbers) >= len(numbers) - 2
    assert all(image_size(path) == (WIDTH, HEIGHT) for path in paths)


def test_blurred_frames_are_skipped(tmp_path: Path, heard: Heard) -> None:
    blurred = range(1, 60, 2)
    path = film(tmp_path / "walk.avi", np.arange(60) * 8, blurred=blurred)
    numbers = [int(one.stem.split("_")[1]) for one in extract_frames(path, tmp_path / "frames", 15, heard)]
    assert len(numbers) >= 12
    # A stretch may consist of a single frame; random choice would select a blurred frame half of the time.
    assert sum(number in blurred for number in numbers) <= 1


def test_existing_frames_are_kept(tmp_path: Path, heard: Heard) -> None:
    path = film(tmp_path / "walk.avi", np.arange(60) * 8)
    first = extract_frames(path, tmp_path / "frames", 15, heard)
    times = {one: one.stat().st_mtime_ns for one in first}
    first[3].unlink()
    again = extract_frames(path, tmp_path / "frames", 15, heard)
    assert again == first and first[3].is_file()
    assert all(one.stat().st_mtime_ns == times[one] for one in first if one != first[3])


def test_the_sharpest_frame_of_each_segment_is_chosen() -> None:
    travelled, sharpness = np.array([0.0, 0.01, 0.03, 0.05, 0.051, 0.09]), np.array([1.0, 5.0, 2.0, 1.0, 3.0, 1.0])
    assert chosen_frames(travelled, sharpness, 3).tolist() == [1, 4, 5]


@pytest.mark.parametrize("most", [8, 16, 20])
def test_no_more_frames_than_wanted_are_chosen(most: int) -> None:
    assert len(chosen_frames(np.linspace(0, 3, 70), np.ones(70), most)) == most


@pytest.mark.parametrize("still", [True, False])
def test_an_empty_video_is_refused(still: bool, tmp_path: Path, heard: Heard) -> None:
    path = tmp_path / "nothing.avi"
    if still:
        film(path, np.zeros(40))
    else:
        path.write_bytes(b"this is no video")
    expected = "has 1 sufficiently different views in 40 frames" if still else "has no frame that OpenCV can read"
    with pytest.raises(InputError, match=expected):
        extract_frames(path, tmp_path / "frames", 15, heard)


def test_a_missing_opencv_is_reported_with_the_remedy(
    tmp_path: Path, heard: Heard, monkeypatch: pytest.MonkeyPatch
) -> None:
    def missing(name: str) -> None:
        raise ImportError(name)

    monkeypatch.setattr(video.importlib, "import_module", missing)
    with pytest.raises(InputError, match=r"pip install 'glassplat\[video\]'"):
        extract_frames(tmp_path / "x.mp4", tmp_path / "frames", 15, heard)
