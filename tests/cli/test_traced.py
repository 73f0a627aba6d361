"""`traced` from end to end on a tiny object: train, evaluate, render every layer, read the stored result."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.cli.main import main
from glassplat.cli.places import SceneEdits
from glassplat.cli.runs import open_run
from glassplat.files.sidecars import write_equirect
from glassplat.scene.scene import Environment
from glassplat.training.checkpoint import load_checkpoint
from tests.cli.test_deferred import assert_own_colours_are_exported
from tests.training.object_capture import few_steps, write_object_capture

LAYERS = ("rgb", "base", "reflection", "strength", "normal", "surroundings", "depth", "alpha")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a few steps; tests only add to it."""
    folder = tmp_path_factory.mktemp("traced")
    capture = write_object_capture(folder / "ball")
    options = [*few_steps(capture, folder / "run"), "--surroundings.start.cells", "3"]
    assert main(["train", "traced", *options]) == 0
    return folder / "run"


def test_it_is_measured_and_every_layer_can_be_rendered(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(run)]) == 0
    results = json.loads((run / "results.json").read_text())
    assert results["method"] == "traced" and results["num_surroundings_gaussians"] > 0
    for name in ("normal_error_deg", "reflective_normal_error_deg", "reflective_psnr", "strength_error"):
        assert results[name] is not None and results[name] > 0, name
    output = run.parent / "layers"
    assert main(["render", str(run), "--layers", *LAYERS, "--output", str(output)]) == 0
    assert all(len(list((output / layer).rglob("*.png"))) == 2 for layer in LAYERS)
    assert main(["render", str(run), "--layers", "mask", "--output", str(run.parent / "none")]) == 2
    assert "traced renders no layer mask" in capsys.readouterr().err


def test_discs_have_a_median_depth_in_addition_to_all_other_layers(tmp_path: Path) -> None:
    capture, run, output = write_object_capture(tmp_path / "ball"), tmp_path / "run", tmp_path / "layers"
    options = [*few_steps(capture, run), "--surroundings.start.cells", "3", "--primitive", "disc"]
    assert main(["train", "traced", *options]) == 0
    stored = open_run(run, "cpu")
    listed = stored.renderer.layers(stored.scene)
    assert set(listed) == {*LAYERS, "median_depth"}
    assert main(["render", str(run), "--layers", *listed, "--output", str(output)]) == 0
    assert all(len(list((output / layer).rglob("*.png"))) == 2 for layer in listed)


def test_the_stored_scene_is_the_trained_one(run: Path) -> None:
    trained, stored = load_checkpoint(run / "checkpoint.safetensors").scene, open_run(run, "cpu").scene
    assert trained.parameters().keys() == stored.parameters().keys()
    for name, tensor in trained.parameters().items():
        assert torch.equal(stored.parameters()[name], tensor), name


def test_a_run_without_its_surroundings_is_reported(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = shutil.copytree(run, tmp_path / "run")
    (damaged / "point_cloud" / "iteration_12" / "surroundings.ply").unlink()
    assert main(["eval", str(damaged)]) == 2
    assert "no surroundings.ply in" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize("mirrors", ["both", "surroundings"])
def test_a_panorama_also_replaces_near_surroundings(run: Path, mirrors: str) -> None:
    panorama = run.parent / "red.png"
    write_equirect(panorama, torch.tensor([1.0, 0.0, 0.0]).expand(8, 16, 3))
    stored = open_run(run, "cpu")
    assert len(stored.scene.surroundings)
    own = Environment.empty() if mirrors == "surroundings" else stored.scene.environment
    scene = SceneEdits(surroundings=panorama).apply(replace(stored.scene, environment=own))
    camera = stored.dataset.test[0].camera
    seen = stored.renderer.with_layers(("surroundings",))(scene, camera).layers["surroundings"]
    assert seen[..., 0].min() > 0.95 and seen[..., 1:].max() < 0.05


def test_broken_normals_next_to_the_photographs_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = write_object_capture(tmp_path / "ball")
    (capture / "train" / "normals").mkdir()
    shutil.copy(capture / "transforms_train.json", capture / "train" / "normals" / "r_0.npy")
    assert main(["train", "traced", *few_steps(capture, tmp_path / "other")]) == 2
    assert "r_0.npy is not an array that NumPy can read" in " ".join(capsys.readouterr().err.split())


def test_its_own_colours_are_exported_as_plain_gaussians(run: Path) -> None:
    assert_own_colours_are_exported(run)
