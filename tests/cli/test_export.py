"""`glassplat export`: files that other programs read, and no files written where they must not be."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch

from glassplat.cli.main import main
from glassplat.files.ply import read_gaussians
from glassplat.files.sidecars import read_planes
from glassplat.files.spz import read_spz
from glassplat.model.model import load
from glassplat.publish.web_page import MOST_PANES
from glassplat.scene.panes import Planes
from glassplat.scene.scene import with_pane
from tests.cli.tiny_run import write_run
from tests.training.tiny_capture import true_scene


def exported(tmp_path: Path, *options: str) -> Path:
    output = tmp_path / "an export"
    assert main(["export", str(write_run(tmp_path / "run")), "--output", str(output), *options]) == 0
    return output


def test_all_that_the_scene_has_is_written(tmp_path: Path) -> None:
    output, scene = exported(tmp_path, "--formats", "ply", "spz"), true_scene()
    read = read_gaussians(output / "scene.ply")
    for name, tensor in scene.primary.tensors().items():
        assert torch.equal(read.tensors()[name], tensor), name
    assert torch.equal(read_planes(output / "planes.json").centers, scene.planes.centers)
    assert len(read_gaussians(output / "glass.ply")) == len(scene.glass)
    torch.testing.assert_close(read_spz(output / "scene.spz").means, scene.primary.means, rtol=0, atol=1e-4)


def test_export_lists_what_a_file_leaves_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, output = write_run(tmp_path / "run"), tmp_path / "an export"
    assert main(["export", str(run), "--output", str(output), "--formats", "ply", "spz"]) == 0
    told = capsys.readouterr().out
    assert f"warning: scene.spz leaves out the intensity of Gaussians in panes; {run} holds everything\n" in told
    assert "scene.ply leaves out" not in told


def test_names_that_are_not_unicode_are_escaped_in_titles(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run").rename(tmp_path / os.fsdecode(b"caf\xe9"))
    for title in ([], ["--title", os.fsdecode(b"Caf\xe9"), "--credit", os.fsdecode(b"\xe9")]):
        assert main(["export", str(run), "--output", str(tmp_path / "out"), "--formats", "html", *title]) == 0
        page = (tmp_path / "out" / "index.html").read_text("utf-8")
        assert ("Caf" if title else "caf") + "\\xe9" in page


def test_the_photographs_need_not_be_there(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    shutil.rmtree(tmp_path / "capture")
    assert main(["export", str(run), "--output", str(tmp_path / "out"), "--formats", "ply"]) == 0


def test_the_folder_is_opened_like_any_other_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = exported(tmp_path, "--formats", "ply", "spz")
    assert "1 pane -> " in capsys.readouterr().out
    model = load(output)
    assert torch.equal(model.scene.primary.means, true_scene().primary.means)
    assert len(model.scene.planes) == 1 and model.name == "an export"
    assert main(["info", str(output)]) == 0
    told = capsys.readouterr().out
    assert "an exported scene" in told and f"next: glassplat view '{output}'" in told
    assert main(["export", str(output), "--output", str(tmp_path / "again"), "--formats", "ply"]) == 0
    assert len(load(tmp_path / "again").scene.planes) == 1


def test_another_program_reads_the_ply(tmp_path: Path) -> None:
    output, scene = exported(tmp_path, "--layer", "transmission", "--formats", "ply"), true_scene()
    assert sorted(path.name for path in output.iterdir()) == ["cameras.json", "glassplat.json", "scene.ply"]
    theirs = gsply.plyread(str(output / "scene.ply"))
    np.testing.assert_array_equal(theirs.means, scene.primary.means)
    np.testing.assert_array_equal(theirs.sh0, scene.primary.sh[:, 0])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--as-mirror 4", "no pane 4"),
        ("--formats ply --credit me", "add html to --formats"),
        ("--formats ply --spz-version 4", "add spz to --formats"),
    ],
)
def test_invalid_options_are_refused(
    options: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, output = write_run(tmp_path / "run"), tmp_path / "out"
    assert main(["export", str(run), "--output", str(output), *options.split()]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not output.exists()


@pytest.mark.parametrize("options", ["--remove-glass", "--layer transmission"])
def test_files_of_an_earlier_scene_are_removed(
    options: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = exported(tmp_path, "--formats", "ply", "spz", "html", "--url", "https://example.org")
    (output / "notes.txt").write_text("mine")
    again = ["export", str(tmp_path / "run"), "--output", str(output), "--formats", "ply", *options.split()]
    capsys.readouterr()
    assert main(again) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "removed index.html, preview.jpg, glass.ply, planes.json, scene.spz of the earlier run" in told
    names = ["cameras.json", "glassplat.json", "notes.txt", "scene.ply"]
    assert sorted(path.name for path in output.iterdir()) == names
    assert not len(load(output).scene.planes)


def test_exporting_another_scene_removes_the_earlier_panes(tmp_path: Path) -> None:
    output = exported(tmp_path, "--formats", "ply", "spz")
    splat = write_run(tmp_path / "splat", planar=False)
    assert main(["export", str(splat), "--output", str(output), "--formats", "spz"]) == 0
    assert sorted(path.name for path in output.iterdir()) == ["cameras.json", "glassplat.json", "scene.spz"]
    assert not len(load(output).scene.planes)


def test_a_folder_is_exported_onto_itself(tmp_path: Path) -> None:
    output = exported(tmp_path, "--formats", "ply", "html")
    onto_itself = ["export", str(output), "--output", str(output), "--formats", "spz"]
    assert main(onto_itself) == 0
    assert {"scene.ply", "scene.spz", "index.html", "planes.json"} <= {path.name for path in output.iterdir()}
    assert main([*onto_itself, "--remove-glass"]) == 0
    left = ["cameras.json", "glassplat.json", "scene.ply", "scene.spz"]
    assert sorted(path.name for path in output.iterdir()) == left
    assert torch.equal(load(output).scene.primary.means, true_scene().primary.means)


def test_too_many_panes_for_a_page_are_refused_before_writing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = load(write_run(tmp_path / "run"), device="cpu")
    scene = model.scene
    for label in range(2, MOST_PANES + 2):
        scene = with_pane(scene, Planes.rectangle((0.2 * label, 0, 2), (0, 0, -1), (0.09, 0.3), label=label))
    many, output = str(model.with_scene(scene).save(tmp_path / "many")), tmp_path / "an export"
    assert main(["export", many, "--output", str(output)]) == 2
    assert f"{MOST_PANES + 1} panes, and a page shows at most {MOST_PANES}" in " ".join(capsys.readouterr().err.split())
    assert not output.exists()
    for way_out in (("--layer", "transmission"), ("--formats", "ply", "spz")):
        assert main(["export", many, "--output", str(output), *way_out]) == 0


def test_a_format_that_cannot_hold_the_scene_does_not_stop_the_others(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, output = load(write_run(tmp_path / "run"), device="cpu"), exported(tmp_path, "--formats", "spz")
    model.scene.primary.means[0, 0] = 1e8
    far = model.save(tmp_path / "far")
    assert main(["export", str(far), "--output", str(output), "--formats", "html", "spz", "glb", "ply"]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert all(f"{kind}: a Gaussian lies 1e+08 units" in told for kind in ("not written: spz", "html"))
    assert {path.suffix for path in output.glob("scene.*")} == {".ply", ".glb"}
