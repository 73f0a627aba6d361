"""`glassplat dereflect`: every photograph without its reflections, under its own name."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from glassplat.cli.main import main
from glassplat.cli.places import RECORD, claim_folder
from glassplat.errors import InputError
from glassplat.files.images import read_image
from glassplat.model.run_directory import RunDirectory
from glassplat.scene.scene import without_glass
from tests.cli.tiny_run import rendered, write_run
from tests.training.tiny_capture import tiny_capture, true_scene


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.glob("*.png"))


def message(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().err.split())


def largest_difference(image: np.ndarray, target: np.ndarray) -> int:
    return int(np.abs(image.astype(int) - target.astype(int)).max())


@pytest.mark.parametrize("source", ["photo", "render"])
def test_only_the_reflection_is_removed(source: str, tmp_path: Path) -> None:
    run, output = write_run(tmp_path / "run"), tmp_path / "clean"
    assert main(["dereflect", str(run), "--output", str(output), "--source", source]) == 0
    assert names(output) == [f"{index}.png" for index in range(6)]
    for index in (0, 3):
        photo, truth = tiny_capture().train[index].photo.numpy(), rendered(without_glass(true_scene()), index).numpy()
        image = read_image(output / f"{index}.png")
        assert largest_difference(photo, truth) > 10
        # The photographs are exact renders up to rounding; in the dark, one grey level is a larger share of the light.
        assert largest_difference(image, truth) <= 6
        elsewhere = (photo == truth).all(axis=2)
        assert largest_difference(image[elsewhere], photo[elsewhere]) <= 1


@pytest.mark.parametrize(("options", "size"), [([], (28, 40)), (["--downscale", "2"], (14, 20))])
def test_images_are_as_large_as_the_photographs_however_small_those_of_training_were(
    options: list[str], size: tuple[int, int], tmp_path: Path
) -> None:
    run, output = write_run(tmp_path / "run"), tmp_path / "clean"
    directory = RunDirectory(run)
    directory.write_settings(replace(directory.settings(), downscale=4.0))
    assert main(["dereflect", str(run), "--output", str(output), "--split", "test", *options]) == 0
    assert read_image(output / "0.png").shape[:2] == size


@pytest.mark.parametrize(("split", "expected"), [("test", ["0.png"]), ("train", [f"{k}.png" for k in range(1, 6)])])
def test_a_split_can_be_chosen(split: str, expected: list[str], tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    assert main(["dereflect", str(run), "--output", str(tmp_path / "clean"), "--split", split]) == 0
    assert names(tmp_path / "clean") == expected


def test_dereflect_of_a_splat_run_suggests_training_planar(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run", planar=False)
    assert main(["dereflect", str(run), "--output", str(tmp_path / "clean")]) == 2
    text = message(capsys)
    assert "splat run" in text and "removed from panes only: glassplat train planar --data" in text
    assert not (tmp_path / "clean").exists()


def test_photographs_are_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run")
    images = tmp_path / "capture" / "images"
    before = {path.name: path.read_bytes() for path in images.iterdir()}
    assert main(["dereflect", str(run), "--output", str(images)]) == 2
    assert "images is not empty, and not from `glassplat dereflect`" in message(capsys)
    before[RECORD] = b'{"command": "dereflect"}'
    (images / RECORD).write_bytes(before[RECORD])
    assert main(["dereflect", str(run), "--output", str(images)]) == 2
    assert "is a photograph of the capture; nothing was written" in message(capsys)
    assert {path.name: path.read_bytes() for path in images.iterdir()} == before


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no pipes with a name")
def test_a_pipe_is_not_written_to(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, output = write_run(tmp_path / "run"), tmp_path / "clean"
    claim_folder(output, "dereflect", run)
    os.mkfifo(output / "0.png")
    assert main(["dereflect", str(run), "--output", str(output)]) == 2
    assert "0.png is a pipe, a device or a broken link; nothing was written" in message(capsys)


@pytest.mark.parametrize(("name", "other"), [("dereflect", "render"), ("render", "dereflect")])
def test_an_output_folder_of_the_same_command_is_reused_with_a_message(
    name: str, other: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, output = write_run(tmp_path / "run"), tmp_path / "clean"
    command = [name, str(run), "--output", str(output), "--split", "test"]
    assert main(command) == 0
    assert "replac" not in capsys.readouterr().out
    assert main(command) == 0
    assert "replac" in capsys.readouterr().out
    assert main([other, str(run), "--output", str(output)]) == 2


def test_a_folder_belongs_to_the_command_that_wrote_it(tmp_path: Path) -> None:
    assert claim_folder(tmp_path / "new", "render", Path("run")) is False
    assert claim_folder(tmp_path / "new", "render", Path("run")) is True
    (tmp_path / "new" / RECORD).write_text("[broken")
    with pytest.raises(InputError, match=r"not from `glassplat render`.*Choose a new folder"):
        claim_folder(tmp_path / "new", "render", Path("run"))
