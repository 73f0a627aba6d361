"""Videos contain the given frames; invalid files are refused."""

from __future__ import annotations

import weakref
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from glassplat.publish.film import check_encoder, encode_video, side_by_side, wipe_images

PICTURES = [np.full((48, 64, 3), (40 + 20 * k, 100, 200 - 15 * k), dtype=np.uint8) for k in range(6)]


def mean_colors(path: Path) -> list[np.ndarray]:
    """Mean colour of every frame of a video."""
    if path.suffix == ".mp4":
        film, found = cv2.VideoCapture(str(path)), []
        while (read := film.read())[0]:
            found.append(read[1][..., ::-1].mean(axis=(0, 1)))
        return found
    with Image.open(path) as film:
        count = film.n_frames
        return [np.asarray(seek(film, k)).mean(axis=(0, 1)) for k in range(count)]


def seek(film: Image.Image, index: int) -> Image.Image:
    film.seek(index)
    return film.convert("RGB")


@pytest.mark.parametrize("suffix", [".mp4", ".webp", ".gif"])
def test_every_picture_is_in_the_film(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"film{suffix}"
    encode_video(path, iter(PICTURES), count=len(PICTURES), fps=10)
    colors = mean_colors(path)
    assert len(colors) == len(PICTURES)
    for color, picture in zip(colors, PICTURES, strict=True):
        np.testing.assert_allclose(color, picture[0, 0], atol=8)


@pytest.mark.parametrize(
    ("suffix", "fps"), [*((".gif", fps) for fps in (1, 24, 30, 50)), *((".webp", fps) for fps in (7, 24, 60, 120))]
)
def test_the_duration_of_a_video_follows_its_frame_rate(suffix: str, fps: int, tmp_path: Path) -> None:
    path = tmp_path / f"film{suffix}"
    encode_video(path, iter(PICTURES * 8), count=48, fps=fps)
    with Image.open(path) as film:
        shown = sum(seek(film, k).info["duration"] for k in range(film.n_frames))
    assert shown == pytest.approx(1000 * 48 / fps, abs=10)


def test_pictures_of_a_webp_do_not_stay_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[weakref.ref[Image.Image]] = []
    most = 0

    def noted(picture: np.ndarray) -> Image.Image:
        nonlocal most
        image = Image.frombytes("RGB", picture.shape[1::-1], picture.tobytes())
        made.append(weakref.ref(image))
        most = max(most, sum(one() is not None for one in made))
        return image

    monkeypatch.setattr(Image, "fromarray", noted)
    encode_video(tmp_path / "film.webp", iter(PICTURES * 8), count=48, fps=10)
    assert len(made) == 48 and most <= 3


def test_invalid_videos_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="avi is not a video name"):
        check_encoder(tmp_path / "film.avi", 10)
    with pytest.raises(ValueError, match=r"at most 50 frames per second, not 51; lower --fps"):
        check_encoder(tmp_path / "film.gif", 51)
    check_encoder(tmp_path / "film.gif", 50)
    check_encoder(tmp_path / "film.webp", 120)
    with pytest.raises(ValueError, match="needs a frame"):
        encode_video(tmp_path / "film.webp", iter([]), count=1, fps=10)
    with pytest.raises(OSError, match="VP9"):
        encode_video(tmp_path / "none" / "film.mp4", iter(PICTURES), count=6, fps=10)


def test_a_film_that_was_not_written_completely_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("glassplat.publish.film._count_frames", lambda path: 5)
    with pytest.raises(OSError, match=r"could not be written completely to .*film\.mp4; is the disk full"):
        encode_video(tmp_path / "film.mp4", iter(PICTURES), count=len(PICTURES), fps=10)


def test_a_wipe_shows_both() -> None:
    left, right = PICTURES[0], PICTURES[5]
    picture = wipe_images(left, right, 0.25)
    assert (picture[:, :15] == left[:, :15]).all() and (picture[:, 17:] == right[:, 17:]).all()
    assert (picture[:, 15:17] == 255).all()
    assert side_by_side([left, right]).shape == (48, 128, 3)
