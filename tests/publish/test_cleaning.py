"""Floaters are removed, everything else stays, and a change of units changes no pixel."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import pytest
import torch

import glassplat
from glassplat.cli.main import main
from glassplat.errors import InputError
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.model.model import Model
from glassplat.model.run_directory import RunDirectory
from glassplat.options import Cleaning
from glassplat.publish.cleaning import Floaters, clean_scene
from glassplat.scene.gaussians import Gaussians
from tests.cli.tiny_run import write_run
from tests.training.tiny_capture import tiny_capture, true_scene

CAMERA = torch.zeros(1, 3)


def wall(count: int = 12) -> Gaussians:
    """[count^2] small Gaussians on a wall three units away."""
    x, y = torch.meshgrid(torch.linspace(-1, 1, count), torch.linspace(-1, 1, count), indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, 3.0)], dim=-1).reshape(-1, 3)
    number = len(means)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0, 0, 0]]).repeat(number, 1),
        torch.full((number, 3), 0.1).log(),
        torch.zeros(number),
        torch.zeros(number, 1, 3),
    )


def with_one(gaussians: Gaussians, mean: tuple[float, float, float], deviation: float) -> Gaussians:
    one = gaussians.select(torch.tensor([0])).with_tensors(
        {"means": torch.tensor([mean]), "log_scales": torch.full((1, 3), deviation).log()}
    )
    return gaussians.concat(one)


@pytest.mark.parametrize(
    ("mean", "deviation", "rule"),
    [
        ((0.0, 0.0, 1.0), 0.1, "isolated"),
        ((0.0, 0.0, 0.5), 0.8, "oversized"),
        ((0.0, math.nan, 1.0), 0.1, "isolated"),
        ((0.0, 0.0, 3.0), math.nan, "isolated"),
        ((0.0, 0.0, 3.0), math.inf, "isolated"),
    ],
)
def test_the_rules_find_the_floater_and_not_the_wall(mean, deviation: float, rule: str) -> None:
    floaters = Floaters(with_one(wall(), mean, deviation), CAMERA)
    for name, found in floaters.masks(Cleaning()).items():
        assert found.nonzero().flatten().tolist() == ([144] if name == rule else [])
    off = Cleaning(isolated=0, oversized=0)
    assert not any(bool(found.any()) for found in floaters.masks(off).values())


def test_a_distant_large_gaussian_is_kept() -> None:
    found = Floaters(with_one(wall(), (0.0, 0.0, 40.0), 12.0), CAMERA).masks(Cleaning())
    assert not any(bool(gone.any()) for gone in found.values())


def test_a_box_keeps_what_is_in_it_whichever_corners_are_given() -> None:
    scene = dataclasses.replace(true_scene(), primary=wall())
    floaters = Floaters(scene.primary, CAMERA)
    for box in ((-2.0, -2.0, 0.0, 0.0, 2.0, 4.0), (0.0, 2.0, 4.0, -2.0, -2.0, 0.0)):
        left, counts = clean_scene(scene, floaters, Cleaning(box=box))
        assert counts["outside"] == 72 and bool((left.primary.means[:, 0] <= 0).all())
    assert torch.equal(left.planes.centers, scene.planes.centers) and len(scene.primary) == 144
    with pytest.raises(InputError, match="nothing would be left of 144"):
        clean_scene(scene, floaters, Cleaning(box=(5.0, 5.0, 5.0, 6.0, 6.0, 6.0)))


def test_units_change_no_picture() -> None:
    model = Model(
        true_scene(),
        PlanarRecipe(background=(0.0, 0.0, 0.0)),
        {view.name: view.camera for view in tiny_capture().train},
        "tiny",
    )
    scaled = model.scale(2.5)
    torch.testing.assert_close(scaled.image("2.png"), model.image("2.png"), atol=2e-4, rtol=0)
    torch.testing.assert_close(
        scaled.render("2.png", layers=["depth"]).layers["depth"],
        2.5 * model.render("2.png", layers=["depth"]).layers["depth"],
        atol=1e-3,
        rtol=1e-3,
    )
    assert scaled.scene.extent == 2.5 * model.scene.extent
    with pytest.raises(ValueError, match="positive"):
        model.scale(0.0)


@pytest.mark.parametrize(("kept", "warns"), [(0.2, True), (0.8, False)])
def test_a_box_that_takes_out_most_of_the_scene_is_warned_of(
    kept: float, warns: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    along = glassplat.load(run).scene.primary.means[:, 0]
    box = ["-99", "-99", "-99", str(float(along.quantile(kept))), "99", "99"]
    rules = ["--isolated", "0", "--oversized", "0", "--box", *box]
    assert main(["clean", str(run), "--output", str(tmp_path / "clean"), *rules]) == 0
    count = int((along > along.quantile(kept)).sum())
    said = f"warning: --box removes {count} Gaussians, more than half"
    assert (said in " ".join(capsys.readouterr().out.split())) == warns
    assert RunDirectory(tmp_path / "clean").latest_scene()[1] == RunDirectory(run).latest_scene()[1] == 1


def test_the_command_writes_another_scene_in_metres(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, output = write_run(tmp_path / "run"), tmp_path / "clean"
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    points = ["0", "0", "0", "0", "0", "2", "1"]
    assert (
        main(["clean", str(run), "--output", str(output), "--scale", *points, *["--isolated", "0", "--oversized", "0"]])
        == 0
    )
    said = " ".join(capsys.readouterr().out.split())
    assert "one unit is now a metre; it was 0.5 m" in said and "already" not in said
    again, splats, cleaned = tmp_path / "again", tmp_path / "x.ply", tmp_path / "cleaned"
    assert main(["clean", str(output), "--output", str(again)]) == 0
    assert main(["clean", str(run), "--output", str(splats)]) == main(["clean", str(splats), "--output", str(cleaned)])
    for scene, is_metric in ((output, True), (again, True), (cleaned, False)):
        assert main(["clean", str(scene), "--output", f"{scene}-scaled", "--scale", *points]) == 0
        told = f"warning: {scene} is in metres already" in " ".join(capsys.readouterr().out.split())
        assert told == is_metric, scene
    old, new = glassplat.load(run), glassplat.load(output)
    torch.testing.assert_close(new.scene.planes.centers, old.scene.planes.centers / 2)
    torch.testing.assert_close(new.image("2.png"), old.image("2.png"), atol=2e-4, rtol=0)
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before
    assert main(["eval", str(output), "--data", str(tmp_path / "capture")]) == 2
    assert "is a scene without a capture" in " ".join(capsys.readouterr().err.split())
    assert main(["clean", str(run), "--output", str(run)]) == 2
    (tmp_path / "mine.ply").write_text("mine")
    assert main(["clean", str(run), "--output", str(tmp_path / "mine.ply")]) == 2
    assert "mine.ply already exists; nothing was written" in " ".join(capsys.readouterr().err.split())
    assert main(["clean", str(run), "--output", str(tmp_path / "no"), "--scale", *"1231234"]) == 2
    assert "expected two different points" in " ".join(capsys.readouterr().err.split())
    for metres in ("1e-12", "1e30"):
        assert main(["clean", str(run), "--output", str(tmp_path / "no"), "--scale", *"000001", metres]) == 2
        assert "expected 1e-06 to 1e+06" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "no").exists()


@pytest.mark.parametrize(("name", "advice"), [("x.html", "next: open .*x.html in"), ("x.ply", "next: glassplat view")])
def test_a_page_is_opened_in_a_browser_and_any_other_scene_in_the_viewer(
    name: str, advice: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["clean", str(write_run(tmp_path / "run")), "--output", str(tmp_path / "new" / name)]) == 0
    assert re.search(advice, " ".join(capsys.readouterr().out.split()))


@pytest.mark.parametrize("scale", [[], ["--scale", *"0000012"]])
def test_files_of_another_scene_next_to_the_output_are_noticed_before_the_work(
    scale: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, output = write_run(tmp_path / "run"), tmp_path / "new" / "x.ply"
    assert main(["clean", str(run), "--output", str(output), *scale]) == 0
    output.unlink()
    assert main(["clean", str(run), "--output", str(output), *scale]) == 0
    output.unlink()
    (output.parent / "planes.json").write_text("[]")
    monkeypatch.setattr(Model, "clean", None)
    assert main(["clean", str(run), "--output", str(output), *scale]) == 2
    assert "planes.json already exists; nothing was written" in " ".join(capsys.readouterr().err.split())
    assert not output.exists()
