"""Photographs alone become a capture with correct poses, or one message with the reason why not."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps

from glassplat.captures.dataset import Dataset, load_dataset
from glassplat.cli.main import main
from glassplat.cli.train import SCENE
from glassplat.errors import InputError
from glassplat.prepare import colmap
from glassplat.prepare.photographs import Note
from glassplat.prepare.preparation import Preparation, prepare
from glassplat.training.messages import Working
from tests.prepare.conftest import CONNECTED, Heard, copy_photographs


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The capture that the command writes, once for all tests that read it."""
    folder = tmp_path_factory.mktemp("prepared")
    source = copy_photographs(folder / "photographs")
    assert main(["prepare", str(source), "--output", str(folder / "the capture")]) == 0
    return folder / "the capture"


def centers(dataset: Dataset) -> dict[str, np.ndarray]:
    """Camera centres by the number of the photograph."""
    return {Path(v.name).stem[-4:]: v.camera.center.double().numpy() for v in (*dataset.train, *dataset.test)}


def aligned(points: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """The points after the similarity that brings them closest to others (Umeyama 1991)."""
    one, other = points - points.mean(0), onto - onto.mean(0)
    u, sizes, vt = np.linalg.svd(other.T @ one)
    signs = np.array([1, 1, np.linalg.det(u @ vt)])
    scale = (sizes * signs).sum() / (one**2).sum()
    return scale * one @ (u * signs @ vt).T + onto.mean(0)


def test_every_photograph_is_placed_where_it_was_taken(prepared: Path) -> None:
    found, truth = centers(load_dataset(prepared)), centers(load_dataset(SCENE))
    assert sorted(found) == sorted(CONNECTED)
    expected = np.stack([truth[name] for name in sorted(found)])
    away = aligned(np.stack([found[name] for name in sorted(found)]), expected) - expected
    radius = np.linalg.norm(expected - expected.mean(0), axis=1).max()
    assert np.linalg.norm(away, axis=1).max() < 0.03 * radius


def test_the_focal_length_is_found(prepared: Path) -> None:
    camera = load_dataset(prepared).train[0].camera
    assert camera.fx == pytest.approx(576, rel=0.03)


def test_the_model_fits_the_straightened_photographs(prepared: Path) -> None:
    from glassplat.captures.colmap_library import pycolmap

    model = pycolmap.Reconstruction(prepared / "sparse" / "0")
    model.update_point_3d_errors()
    assert model.compute_mean_reprojection_error() < 1
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}


def test_points_have_the_colours_of_the_photographs(prepared: Path) -> None:
    dataset = load_dataset(prepared)
    differences = []
    for view in dataset.train:
        pixels, depth = view.camera.project(dataset.points.positions)
        inside = (pixels >= 0).all(1) & (pixels < pixels.new_tensor(view.photo.shape[1::-1])).all(1) & (depth > 0)
        column, row = pixels[inside].long().T
        differences.append((view.photo[row, column].int() - dataset.points.colors[inside].int()).abs().float().mean())
    assert float(np.mean(differences)) < 40  # Grey, or the colours of other points, would differ by twice as much.


def test_the_record_holds_the_report_and_nothing_else_is_left(prepared: Path) -> None:
    record = json.loads((prepared / "prepare.json").read_text())
    assert record["report"]["registered"] == len(CONNECTED)
    assert sorted(path.name for path in prepared.iterdir()) == ["images", "prepare.html", "prepare.json", "sparse"]
    assert not prepared.with_name("the capture.partial").exists()


def test_a_capture_is_replaced_only_by_force(prepared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = prepared.parent / "photographs"
    before = (prepared / "sparse" / "0" / "images.bin").read_bytes()
    assert main(["prepare", str(source), "--output", str(prepared)]) == 2
    assert "--force" in capsys.readouterr().err
    (prepared / "panes").mkdir()
    assert main(["prepare", str(source), "--output", str(prepared), "--force"]) == 2
    assert "which are not from `glassplat prepare`" in " ".join(capsys.readouterr().err.split())
    (prepared / "panes").rmdir()
    assert (prepared / "sparse" / "0" / "images.bin").read_bytes() == before


def test_a_preparation_interrupted_in_any_phase_is_resumed(photographs: Path, tmp_path: Path, heard: Heard) -> None:
    """Interrupted in each phase in turn: each resumed preparation has to reach the next phase."""
    task = Preparation(photographs, tmp_path / "capture")
    phases = ("extracting features", "matching photographs", "registering the photographs", "undistorting")
    for number, phase in enumerate(phases):

        def interrupt(message: Working | Note, phase: str = phase) -> None:
            heard(message)
            if isinstance(message, Working) and message.what.startswith(phase):
                raise KeyboardInterrupt

        heard.clear()
        with pytest.raises(KeyboardInterrupt):
            prepare(task, interrupt, resume=number > 0)
        assert ("reading the photographs" in heard.whats()) == (number == 0)
        assert not task.output.exists()
        with pytest.raises(InputError, match="--resume"):
            prepare(task, heard)
        with pytest.raises(InputError, match="another max-size"):
            prepare(Preparation(photographs, task.output, max_size=640), heard, resume=True)
    heard.clear()
    assert prepare(task, heard, resume=True).registered == len(CONNECTED)
    assert "reading the photographs" not in heard.whats()
    assert len(load_dataset(task.output).train) == 8


def test_only_one_sqlite_has_the_database_open_and_progress_is_read_from_it(
    photographs: Path, tmp_path: Path, heard: Heard, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Using Python's SQLite along with COLMAP's in one process ends in a bus error, about once in forty runs.
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("another SQLite opened the database")

    monkeypatch.setattr(sqlite3, "connect", refuse)
    monkeypatch.setattr(colmap, "POLL_SECONDS", 0.001)
    assert prepare(Preparation(photographs, tmp_path / "capture"), heard).registered == len(CONNECTED)
    for phase in ("extracting features", "matching photographs"):
        told = [message.done for message in heard if isinstance(message, Working) and message.what == phase]
        total = next(m.total for m in heard if isinstance(m, Working) and m.what == phase)
        assert told == sorted(told) and len(set(told)) > 2 and told[-1] >= 0.9 * total


def test_the_global_mapper_registers_the_photographs_too(photographs: Path, tmp_path: Path, heard: Heard) -> None:
    task = Preparation(photographs, tmp_path / "capture", mapper="global")
    assert prepare(task, heard).registered >= 8


def test_photographs_of_two_places_are_refused_with_their_groups(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Mirrored negatives share no features with the originals; mere mirror images might, as panes mirror too.
    found = sorted(photographs.iterdir())
    for path in found[4:]:
        path.unlink()
    for path in found[:4]:
        with Image.open(path) as image:
            ImageOps.invert(ImageOps.mirror(image)).save(path.with_name(f"other {path.name}"), quality=95)
    assert main(["prepare", str(photographs), "--output", str(tmp_path / "capture")]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "of 8 photographs could be registered, expected at least 80%" in message
    assert "groups without matches between them" in message and "--least-registered" in message
    assert not (tmp_path / "capture").exists()
