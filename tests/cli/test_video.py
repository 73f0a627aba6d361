"""`glassplat video`: videos of a run, and runs that cannot be filmed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from glassplat.cli import writing
from glassplat.cli.main import main
from tests.cli.tiny_run import write_run

SHORT = ["--seconds", "0.4", "--fps", "10", "--width", "64"]


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ("--layers rgb transmission strength", (192, 44)),
        ("--layers rgb transmission --layout wipe --path interpolate", (64, 44)),
        ("--as-mirror 1", (64, 44)),
    ],
)
def test_the_size_of_a_video_follows_its_layers(options: str, size: tuple[int, int], tmp_path: Path) -> None:
    run, film = write_run(tmp_path / "run"), tmp_path / "film.webp"
    assert main(["video", str(run), "--output", str(film), *SHORT, *options.split()]) == 0
    with Image.open(film) as pictures:
        assert (pictures.n_frames, pictures.size) == (4, size)
        assert np.asarray(pictures.convert("RGB")).std() > 5


def test_keyframes_are_those_of_an_export(tmp_path: Path) -> None:
    run, film = write_run(tmp_path / "run"), tmp_path / "film.mp4"
    keys = ["--path", "keyframes", "--keyframes", str(run / "cameras.json")]
    assert main(["video", str(run), "--output", str(film), *SHORT, *keys]) == 0
    assert film.stat().st_size > 100


def test_an_interrupted_film_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(pictures: list[np.ndarray]) -> np.ndarray:
        if len(taken) == 2:
            raise KeyboardInterrupt
        taken.append(pictures[0])
        return pictures[0]

    taken: list[np.ndarray] = []
    run, film = write_run(tmp_path / "run"), tmp_path / "film.webp"
    monkeypatch.setattr(writing, "side_by_side", stop)
    assert main(["video", str(run), "--output", str(film), *SHORT]) == 130
    assert "nothing was written: repeat the command" in " ".join(capsys.readouterr().err.split())
    assert len(taken) == 2 and {path.name for path in tmp_path.iterdir()} == {"run", "capture"}


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--output film.avi", "not a video name"),
        ("--output there.webp", "pass --force"),
        ("--output folder.webp --force", "folder.webp is a folder"),
        ("--output there.webp/film.webp", "there.webp is a file"),
        ("--output film.webp --layout wipe", "two --layers"),
        ("--output film.webp --path keyframes", "belong together"),
        ("--output film.webp --layers base", "renders no layer base"),
        ("--output film.webp --layers reflection --remove-glass", "no layer reflection; expected layers out of rgb, "),
        ("--output film.webp --seconds 0", "--seconds"),
        ("--output film.webp --width 8192 --layers rgb rgb --seconds 0.1", "at most 16383 pixels a side, not 16384 x"),
        ("--output film.gif --fps 60", "at most 50 frames per second, not 60"),
    ],
)
def test_invalid_values_are_refused_before_rendering(
    options: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.webp").write_text("mine")
    (tmp_path / "folder.webp").mkdir()
    assert main(["video", str(run), *options.split()]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.glob("film.*")) and (tmp_path / "there.webp").read_text() == "mine"


def test_a_broken_link_at_the_output_of_a_video_is_refused_unless_forced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, film = write_run(tmp_path / "run"), tmp_path / "film.gif"
    film.symlink_to(tmp_path / "elsewhere")
    assert main(["video", str(run), "--output", str(film), *SHORT]) == 2
    assert "already exists; pass --force" in capsys.readouterr().err
    assert main(["video", str(run), "--output", str(film), *SHORT, "--force"]) == 0
    assert (tmp_path / "elsewhere").read_bytes()[:3] == b"GIF"
