"""`glassplat video`: films of a run, and what cannot be filmed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from glassplat.cli import main
from tests.commands.tiny_run import write_run

SHORT = ["--seconds", "0.4", "--fps", "10", "--width", "64"]


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ("--layers rgb transmission strength", (192, 44)),
        ("--layers rgb transmission --layout wipe --path interpolate", (64, 44)),
        ("--as-mirror 1", (64, 44)),
    ],
)
def test_a_film_has_its_layers_in_every_picture(options: str, size: tuple[int, int], tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--output film.avi", "no name of a film"),
        ("--output there.webp", "pass --force"),
        ("--output film.webp --layout wipe", "two --layers"),
        ("--output film.webp --path keyframes", "belong together"),
        ("--output film.webp --layers normal", "renders no layer normal"),
        ("--output film.webp --seconds 0", "--seconds"),
    ],
)
def test_what_makes_no_sense_is_refused_before_anything_is_rendered(
    options: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.webp").write_text("mine")
    assert main(["video", str(run), *options.split()]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "film.webp").exists() and (tmp_path / "there.webp").read_text() == "mine"
