"""Splat files of other programs, which every command accepts that needs no photographs."""

from __future__ import annotations

import json
import logging
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat import InputError, load
from glassplat.cli.main import main
from glassplat.files.ply import write_gaussians
from glassplat.files.sidecars import write_planes
from glassplat.files.writing import GAUSSFORGE_SUFFIXES, SPLAT_SUFFIXES, SPLAT_WRITERS, write_splats
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.options import BLACK
from tests.cli.tiny_run import write_run
from tests.files.test_spz import typical
from tests.training.tiny_capture import tiny_capture, true_scene, write_tiny_capture


def test_exported_scenes_are_read_back(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    assert main(["export", str(run), "--output", str(tmp_path / "out"), "--formats", "ply", "spz"]) == 0
    for kind, precision in (("ply", 0.0), ("spz", 2**-18)):
        again = load(tmp_path / "out" / f"scene.{kind}", device="cpu")
        before = load(run, device="cpu")
        torch.testing.assert_close(again.scene.primary.means, before.scene.primary.means, rtol=0, atol=precision)
        assert torch.equal(again.scene.planes.centers, before.scene.planes.centers)
        assert torch.equal(again.scene.glass.means, before.scene.glass.means)
        assert list(again.cameras) == list(before.cameras)


def test_glass_without_its_panes_is_warned_of(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    command = ["export", str(write_run(tmp_path / "run")), "--output", str(tmp_path / "out"), "--formats", "ply"]
    assert main(command) == 0
    (tmp_path / "out" / "planes.json").unlink()
    with caplog.at_level(logging.WARNING, "glassplat"):
        assert not load(tmp_path / "out" / "scene.ply", device="cpu").panes
    assert "no planes.json" in caplog.text


def test_panes_that_may_be_of_another_file_are_mentioned(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["export", str(write_run(tmp_path / "run")), "--output", str(tmp_path / "out"), "--formats", "ply"]
    assert main(command) == 0
    write_gaussians(tmp_path / "out" / "other.ply", typical())
    with caplog.at_level(logging.INFO, "glassplat"):
        assert load(tmp_path / "out", device="cpu").panes and "gets the panes" not in caplog.text
        assert load(tmp_path / "out" / "other.ply", device="cpu").panes
    assert f"other.ply gets the panes of {tmp_path / 'out' / 'planes.json'}" in caplog.text
    capsys.readouterr()
    assert main(["info", str(tmp_path / "out" / "other.ply")]) == 0
    assert f", of {tmp_path / 'out' / 'planes.json'}" in capsys.readouterr().out


@pytest.mark.parametrize("offset", [0.0, 5e5])
def test_a_file_in_georeferenced_coordinates_is_warned_of(
    offset: float, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    gaussians = typical()
    write_gaussians(tmp_path / "a.ply", gaussians.with_tensors({"means": gaussians.means + offset}))
    with caplog.at_level(logging.WARNING, "glassplat"):
        load(tmp_path / "a.ply", device="cpu")
    assert ("a.ply: The cameras are" in caplog.text and "single precision blurs" in caplog.text) == bool(offset)


def test_a_file_of_discs_is_drawn_as_discs(tmp_path: Path) -> None:
    solid = true_scene().primary
    discs = replace(solid, log_scales=solid.log_scales[:, :2].contiguous())
    write_gaussians(tmp_path / "scene.ply", discs)
    loaded = load(tmp_path / "scene.ply", device="cpu")
    camera = tiny_capture().train[0].camera
    expected = SplatRecipe(background=BLACK, primitive="disc").renderer()(replace(true_scene(), primary=discs), camera)
    assert float(expected.rgb.detach().max()) > 0.1
    torch.testing.assert_close(loaded.image(camera), expected.rgb.detach(), atol=1 / 255, rtol=0)


def given_by_hand(path: Path) -> Path:
    write_planes(path, true_scene().planes)
    entries = json.loads(path.read_text())
    for entry in entries:
        del entry["raw_normal"], entry["logit_reflectance"]
    path.write_text(json.dumps(entries))
    return path


def test_panes_can_be_given_by_hand(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", typical().with_tensors({"means": typical().means + 50}))
    model = load(tmp_path / "a.ply", device="cpu", planes=given_by_hand(tmp_path / "mine.json"))
    camera = next(iter(model.cameras.values()))
    pose = torch.eye(4)
    pose[:3, 3] = -model.scene.planes.centers[0] + torch.tensor([0.0, 0.0, 2.0])
    with torch.no_grad():
        strength = model.render(replace(camera, cam_from_world=pose), layers=("strength",)).layers["strength"]
    assert float(strength.max()) > 0.1


def test_export_keeps_the_panes_and_the_up_direction_of_a_file(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", typical())
    command = ["export", str(tmp_path / "a.ply"), "--formats", "ply", "--device", "cpu"]
    panes = ["--planes", str(given_by_hand(tmp_path / "mine.json"))]
    assert main([*command, "--output", str(tmp_path / "down"), *panes]) == 0
    assert main([*command, "--output", str(tmp_path / "up"), "--up", "z"]) == 0
    assert (tmp_path / "down" / "planes.json").is_file() and not (tmp_path / "up" / "planes.json").exists()
    cameras = [(tmp_path / name / "cameras.json").read_text() for name in ("down", "up")]
    assert cameras[0] != cameras[1]


def test_panes_are_for_splat_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is for splat files"):
        load(write_run(tmp_path / "run"), device="cpu", planes=tmp_path / "mine.json")


def test_invalid_gaussians_are_left_out_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    means = typical().means.clone()
    means[1] = float("nan")
    write_gaussians(tmp_path / "a.ply", typical().with_tensors({"means": means}))
    with caplog.at_level(logging.WARNING, "glassplat"):
        assert len(load(tmp_path / "a.ply", device="cpu").scene.primary) == len(means) - 1
    assert "1 Gaussians of" in caplog.text and "are left out" in caplog.text


@pytest.mark.parametrize("suffix", SPLAT_SUFFIXES)
def test_malicious_files_end_with_one_message(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / f"a{suffix}"
    file.write_bytes(b"\x00" * 31)
    assert main(["export", str(file), "--output", str(tmp_path / "scene")]) == 2
    error = capsys.readouterr().err
    assert error.count("error:") == 1 and "Traceback" not in error
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize("kind", SPLAT_WRITERS)
def test_every_format_that_is_written_is_read(kind: str, tmp_path: Path) -> None:
    if f".{kind}" in GAUSSFORGE_SUFFIXES:
        pytest.importorskip("gaussforge")
    write_splats(kind, tmp_path / f"a.{kind}", typical())
    read = load(tmp_path / f"a.{kind}", device="cpu").scene.primary
    assert (len(read), read.active_sh_degree) == (len(typical()), typical().active_sh_degree)


@pytest.mark.parametrize("kind", ["ply", "spz", "glb"])
def test_harmonics_that_are_not_shown_are_not_written(kind: str, tmp_path: Path) -> None:
    assert typical().active_sh_degree > 0
    write_splats(kind, tmp_path / f"a.{kind}", replace(typical(), active_sh_degree=0))
    assert load(tmp_path / f"a.{kind}", device="cpu").scene.primary.active_sh_degree == 0


@pytest.mark.parametrize("suffix", GAUSSFORGE_SUFFIXES)
def test_lossy_formats_keep_every_gaussian_near_its_place(suffix: str, tmp_path: Path) -> None:
    pytest.importorskip("gaussforge")
    model = load(write_run(tmp_path / "run"), device="cpu").without_glass()
    model.save(tmp_path / f"a{suffix}")
    found = load(tmp_path / f"a{suffix}", device="cpu").scene.primary
    moved = torch.cdist(model.scene.primary.means, found.means).amin(dim=1)
    assert float(moved.max()) < 1e-3 * model.scene.extent


@pytest.mark.parametrize("suffix", GAUSSFORGE_SUFFIXES)
def test_a_missing_gaussforge_is_reported_with_the_remedy(
    suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "gaussforge", None)
    (tmp_path / f"a{suffix}").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"pip install 'glassplat\[formats\]'"):
        load(tmp_path / f"a{suffix}", device="cpu")
    with pytest.raises(ValueError, match=r"pip install 'glassplat\[formats\]'"):
        write_splats(suffix[1:], tmp_path / f"b{suffix}", typical())


def test_files_that_lack_what_a_scene_needs_are_named(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    assert main(["export", str(run), "--output", str(tmp_path / "out"), "--formats", "ply"]) == 0
    write_gaussians(tmp_path / "out" / "glass.ply", typical())
    with pytest.raises(InputError, match=r"glass\.ply has no property logit_mark; expected glass as"):
        load(tmp_path / "out", device="cpu")
    write_gaussians(tmp_path / "none.ply", typical().select(torch.zeros(len(typical())).bool()))
    with pytest.raises(InputError, match=r"none\.ply holds no Gaussians"):
        load(tmp_path / "none.ply", device="cpu")
    (run / "cameras.json").write_text("[]")
    with pytest.raises(InputError, match=r"cameras\.json lists no camera"):
        load(run, device="cpu")


def test_a_folder_without_a_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"holds no scene; expected a run, .*`glassplat\.load_dataset` reads"):
        load(write_tiny_capture(tmp_path / "capture"))


def test_a_direction_that_is_not_up_is_refused(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "scene.ply", true_scene().primary)
    with pytest.raises(InputError, match="up is 'w'; expected one of"):
        load(tmp_path / "scene.ply", device="cpu", up="w")  # type: ignore[arg-type]
