"""`glassplat import`: what other programs wrote becomes a scene that every command takes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from glassplat.cli.main import main
from glassplat.files.images import read_image
from glassplat.files.ply import write_gaussians
from glassplat.files.sidecars import write_planes
from glassplat.files.writing import SPLAT_SUFFIXES
from glassplat.model.loading import load
from tests.cli.tiny_run import write_run
from tests.files.test_spz import typical
from tests.training.tiny_capture import true_scene


def imported(file: Path, output: Path, *options: str) -> Path:
    assert main(["import", str(file), "--output", str(output), *options]) == 0
    return output


def test_what_was_exported_comes_back(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    assert main(["export", str(run), "--output", str(tmp_path / "out"), "--formats", "ply", "spz"]) == 0
    for kind, precision in (("ply", 0.0), ("spz", 2**-18)):
        again = load(imported(tmp_path / "out" / f"scene.{kind}", tmp_path / kind), device="cpu")
        before = load(run, device="cpu")
        torch.testing.assert_close(again.scene.primary.means, before.scene.primary.means, rtol=0, atol=precision)
        assert torch.equal(again.scene.planes.centers, before.scene.planes.centers)
        assert torch.equal(again.scene.glass.means, before.scene.glass.means)
        assert list(again.cameras) == list(before.cameras)
        if kind == "ply":
            camera = next(iter(before.cameras.values()))
            with torch.no_grad():
                images = [opened.renderer(opened.scene, camera).rgb for opened in (before, again)]
            torch.testing.assert_close(*images)


def test_an_imported_scene_is_rendered_and_exported(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", typical())
    scene = imported(tmp_path / "a.ply", tmp_path / "scene")
    assert main(["render", str(scene), "--output", str(tmp_path / "out"), "--layers", "rgb"]) == 0
    pictures = sorted((tmp_path / "out" / "rgb").iterdir())
    assert len(pictures) == 3 and read_image(pictures[0]).std() > 5
    assert main(["export", str(scene), "--output", str(tmp_path / "again"), "--formats", "ply"]) == 0


def test_panes_can_be_given_by_hand(tmp_path: Path) -> None:
    far = typical().with_tensors({"means": typical().means + 50})
    write_gaussians(tmp_path / "a.ply", far)
    write_planes(tmp_path / "mine.json", true_scene().planes)
    entries = json.loads((tmp_path / "mine.json").read_text())
    for entry in entries:
        del entry["raw_normal"], entry["logit_reflectance"]
    (tmp_path / "mine.json").write_text(json.dumps(entries))
    opened = load(
        imported(tmp_path / "a.ply", tmp_path / "scene", "--planes", str(tmp_path / "mine.json")), device="cpu"
    )
    plane = opened.scene.planes
    camera = next(iter(opened.cameras.values()))
    pose = camera.cam_from_world.clone()
    pose[:3, :3], pose[:3, 3] = torch.eye(3), -plane.centers[0] + torch.tensor([0.0, 0.0, 2.0])
    with torch.no_grad():
        strength = opened.renderer(opened.scene, camera.__class__(pose, 300, 300, 160, 120, 320, 240)).layers[
            "strength"
        ]
    assert float(strength.max()) > 0.1


@pytest.mark.parametrize("suffix", SPLAT_SUFFIXES)
def test_hostile_files_get_one_message(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / f"a{suffix}"
    file.write_bytes(b"\x00" * 31)
    assert main(["import", str(file), "--output", str(tmp_path / "scene")]) == 2
    error = capsys.readouterr().err
    assert error.count("error:") == 1 and "Traceback" not in error
    assert not (tmp_path / "scene").exists()


def test_nothing_is_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_gaussians(tmp_path / "a.ply", typical())
    assert main(["import", str(tmp_path / "a.ply"), "--output", str(tmp_path)]) == 2
    assert "not empty" in capsys.readouterr().err
    scene = imported(tmp_path / "a.ply", tmp_path / "scene")
    assert main(["dereflect", str(scene), "--output", str(tmp_path / "clean")]) == 2
    assert main(["import", str(tmp_path / "none.ply"), "--output", str(tmp_path / "new")]) == 2
