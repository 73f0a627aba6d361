"""`glassplat video`: films of a run, and what cannot be filmed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from glassplat.cli import main
from glassplat.publish.kept_pictures import KeptPictures
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


class Stop:
    """Ctrl-C after so many pictures; counts those that are kept."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, after: int) -> None:
        self.after, self.indices, self._write = after, list[int](), KeptPictures.write
        stop = self

        def write(kept: KeptPictures, index: int, picture: np.ndarray) -> None:
            stop.write(kept, index, picture)

        monkeypatch.setattr(KeptPictures, "write", write)

    def write(self, kept: KeptPictures, index: int, picture: np.ndarray) -> None:
        if len(self.indices) == self.after:
            raise KeyboardInterrupt
        self.indices.append(index)
        self._write(kept, index, picture)


@pytest.mark.parametrize("after", [0, 2])
def test_an_interrupted_film_goes_on_where_it_stopped(
    after: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, film, whole = write_run(tmp_path / "run"), tmp_path / "film.webp", tmp_path / "whole.webp"
    options = [*SHORT, "--layers", "rgb", "transmission", "--layout", "wipe"]
    stop = Stop(monkeypatch, after)
    assert main(["video", str(run), "--output", str(film), *options]) == 130
    told = " ".join(capsys.readouterr().err.split())
    assert f"{after} pictures are kept" in told and "--resume" in told and not film.exists()
    assert main(["video", str(run), "--output", str(film), *options]) == 2
    assert "pass --resume to go on" in " ".join(capsys.readouterr().err.split())
    stop.after = 100
    assert main(["video", str(run), "--output", str(film), *options, "--resume"]) == 0
    assert stop.indices == [0, 1, 2, 3]
    assert main(["video", str(run), "--output", str(whole), *options]) == 0
    assert film.read_bytes() == whole.read_bytes()
    assert {path.name for path in tmp_path.iterdir()} == {"run", "capture", "film.webp", "whole.webp"}


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        (["--layers", "transmission"], "--layers"),
        (["--seconds", "0.8"], "--seconds, the cameras of the path"),
        (["--path", "interpolate"], "--path, the cameras of the path"),
        (["--as-mirror", "1"], "the scene with its edits"),
        (["--reflectance", "1", "0.5"], "the scene with its edits"),
    ],
)
def test_another_film_does_not_go_on_with_the_pictures_of_one(
    changed: list[str], named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, film = write_run(tmp_path / "run"), tmp_path / "film.webp"
    command = ["video", str(run), "--output", str(film), *SHORT]
    stop = Stop(monkeypatch, 1)
    assert main(command) == 130
    stop.after = 100
    assert main([*command, *changed, "--resume"]) == 2
    assert f"{named} {'are' if ', ' in named else 'is'} no longer" in " ".join(capsys.readouterr().err.split())
    assert main([*command, *changed, "--force"]) == 0
    assert stop.indices[:2] == [0, 0] and not film.with_name("film.webp.pictures").exists()


def test_only_what_a_film_left_is_gone_on_with_or_deleted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, film = write_run(tmp_path / "run"), tmp_path / "film.webp"
    command = ["video", str(run), "--output", str(film), *SHORT]
    assert main([*command, "--resume"]) == 2
    assert "no film was interrupted" in " ".join(capsys.readouterr().err.split())
    folder = tmp_path / "film.webp.pictures"
    folder.mkdir()
    (folder / "000000.png").write_text("mine")
    assert main([*command, "--force"]) == 2
    assert "not from an interrupted film" in " ".join(capsys.readouterr().err.split())
    assert (folder / "000000.png").read_text() == "mine"


def test_a_damaged_picture_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run, film = write_run(tmp_path / "run"), tmp_path / "film.webp"
    command = ["video", str(run), "--output", str(film), *SHORT]
    stop = Stop(monkeypatch, 2)
    assert main(command) == 130
    stop.after = 100
    (tmp_path / "film.webp.pictures" / "000001.png").write_text("damaged")
    assert main([*command, "--resume"]) == 2
    assert "000001.png" in " ".join(capsys.readouterr().err.split()) and not film.exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--output film.avi", "no name of a film"),
        ("--output there.webp", "pass --force"),
        ("--output film.webp --layout wipe", "two --layers"),
        ("--output film.webp --path keyframes", "belong together"),
        ("--output film.webp --layers base", "renders no layer base"),
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


def test_a_link_to_nothing_is_in_the_way_of_a_film_until_it_is_forced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, film = write_run(tmp_path / "run"), tmp_path / "film.gif"
    film.symlink_to(tmp_path / "elsewhere")
    assert main(["video", str(run), "--output", str(film), *SHORT]) == 2
    assert "is already there; pass --force" in capsys.readouterr().err
    assert main(["video", str(run), "--output", str(film), *SHORT, "--force"]) == 0
    assert (tmp_path / "elsewhere").read_bytes()[:3] == b"GIF"
