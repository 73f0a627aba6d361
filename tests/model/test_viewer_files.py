"""Results of the viewer are written next to the run, under names that are not taken yet."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import glassplat
from glassplat.access import is_local
from glassplat.cli.main import main
from glassplat.cli.scene import View
from glassplat.cli.serving import make_writer
from glassplat.errors import InputError
from glassplat.files.sidecars import read_cameras
from glassplat.model.watching import FolderWriter
from glassplat.scene.scene import PaneMove, move_panes
from tests.cli.tiny_run import write_run
from tests.model.test_model import model
from tests.training.tiny_capture import tiny_capture, true_scene

CAMERAS = [view.camera for view in tiny_capture().train]


def test_an_edited_scene_is_saved_as_a_run_with_its_capture(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    loaded = glassplat.load(run, device="cpu")
    edited = move_panes(loaded.scene, [PaneMove(1, (1.0, 0.0, 0.05, 0.0), (0.0, 0.0, 0.1))])
    said = FolderWriter(loaded, tmp_path).write_scene(edited, " place, seen twice ".replace(",", " +").strip())
    place = tmp_path / "place + seen twice"
    assert f"glassplat view '{place}'" in said
    again = glassplat.load(place, device="cpu")
    for name, tensor in edited.parameters().items():
        assert torch.equal(again.scene.parameters()[name], tensor), name
    assert again.cameras.keys() == loaded.cameras.keys() and again.recipe == loaded.recipe
    assert main(["eval", str(place)]) == 0
    assert (place / "results.json").is_file()
    assert {path: path.read_bytes() for path in before} == before


def test_existing_files_are_not_overwritten(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    writer = FolderWriter(glassplat.load(run, device="cpu"), tmp_path)
    recipe = (run / "recipe.json").read_bytes()
    with pytest.raises(FileExistsError, match="already exists and is not empty"):
        writer.write_scene(true_scene(), "run")
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    for name in ("mine", "nowhere"):
        with pytest.raises(FileExistsError, match="nothing was written"):
            writer.write_scene(true_scene(), name)
    writer.write_keyframes(CAMERAS, "path.json")
    with pytest.raises(FileExistsError, match="Choose another name"):
        writer.write_keyframes(CAMERAS[:2], "path")
    assert (run / "recipe.json").read_bytes() == recipe and (tmp_path / "mine").read_text() == "mine"
    assert len(read_cameras(tmp_path / "path.json")) == len(CAMERAS) and not (tmp_path / "gone").exists()


@pytest.mark.parametrize("name", ["", "../out", "a/b", "/etc/x", ".hidden", "-option", "a\0b", "x" * 200, "..", "a\nb"])
def test_no_name_leads_out_of_the_folder(name: str, tmp_path: Path) -> None:
    writer = FolderWriter(model(), tmp_path / "here")
    with pytest.raises(InputError, match="is not a valid name"):
        writer.write_scene(true_scene(), name)
    with pytest.raises(InputError, match="is not a valid name"):
        writer.write_keyframes(CAMERAS, name)
    assert not [*tmp_path.iterdir()]


def test_remote_clients_save_only_into_a_named_folder(tmp_path: Path) -> None:
    here = View(tmp_path / "scene")
    elsewhere = replace(here, host="0.0.0.0")
    assert is_local(here.host) and make_writer(here, model()) is not None
    assert make_writer(elsewhere, model()) is None
    assert make_writer(replace(elsewhere, host="192.168.1.2"), model()) is None
    assert make_writer(replace(elsewhere, output=tmp_path), model()) is not None


def test_keyframes_are_what_a_film_is_made_of(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    writer = FolderWriter(glassplat.load(run, device="cpu"), tmp_path)
    with pytest.raises(InputError, match="at least two"):
        writer.write_keyframes(CAMERAS[:1], "my path")
    said = shlex.split(writer.write_keyframes(CAMERAS[:3], "my path").split("`")[1])
    assert said[:3] == ["glassplat", "video", str(run)] and said[-2:] == ["--output", "video.mp4"]
    film = ["--output", str(tmp_path / "film.webp"), "--seconds", "0.3", "--fps", "10", "--width", "64"]
    assert main([*said[1:-2], *film]) == 0
    assert (tmp_path / "film.webp").is_file()
