"""`deferred` from end to end on a tiny object: train, evaluate, render every layer, read the stored result."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.cli.main import main
from glassplat.cli.places import SceneEdits
from glassplat.cli.runs import open_run
from glassplat.errors import InputError
from glassplat.files.images import read_image
from glassplat.files.sidecars import read_equirect, write_equirect
from glassplat.model.model import load
from glassplat.render.deferred import equirect_from_environment
from glassplat.scene.scene import Environment
from glassplat.training.checkpoint import load_checkpoint
from tests.training.object_capture import few_steps, write_object_capture

LAYERS = ("rgb", "base", "reflection", "strength", "normal", "environment", "depth", "alpha")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a few steps on a capture with a true environment; tests only add to it."""
    folder = tmp_path_factory.mktemp("deferred")
    capture = write_object_capture(folder / "ball")
    environment = 0.2 + 0.6 * torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(0))
    write_equirect(capture / "environment.exr", environment)
    assert main(["train", "deferred", *few_steps(capture, folder / "run")]) == 0
    return folder / "run"


def test_it_is_measured_against_true_normals_strength_and_environment(run: Path) -> None:
    assert main(["eval", str(run)]) == 0
    results = json.loads((run / "results.json").read_text())
    assert results["method"] == "deferred"
    for name in ("normal_error_deg", "reflective_normal_error_deg", "strength_error", "environment_psnr"):
        assert results[name] is not None and results[name] > 0, name


def test_a_run_too_short_for_reflections_warns_and_can_be_evaluated_and_rendered(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    capture, run = write_object_capture(tmp_path / "ball"), tmp_path / "run"
    options = ["--data", str(capture), "--iterations", "12", "--sh-degree", "1"]
    assert main(["train", "deferred", *options, "--output", str(run)]) == 0
    assert "12 iterations are too few for normal propagation" in caplog.text
    assert main(["train", "splat", *options, "--output", str(tmp_path / "splat")]) == 0
    psnr = []
    for trained in (run, tmp_path / "splat"):
        assert main(["eval", str(trained)]) == 0
        psnr.append(json.loads((trained / "results.json").read_text())["psnr"])
    assert psnr[0] == pytest.approx(psnr[1], abs=1e-3)
    assert main(["render", str(run), "--layers", *LAYERS, "--output", str(tmp_path / "layers")]) == 0


def test_every_layer_can_be_rendered(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = run.parent / "layers"
    assert main(["render", str(run), "--layers", *LAYERS, "--output", str(output)]) == 0
    assert all(len(list((output / layer).rglob("*.png"))) == 2 for layer in LAYERS)
    assert main(["render", str(run), "--layers", "transmission", "--output", str(run.parent / "none")]) == 2
    assert "deferred renders no layer transmission" in capsys.readouterr().err


def test_the_stored_scene_is_the_trained_one(run: Path) -> None:
    trained, stored = load_checkpoint(run / "checkpoint.safetensors").scene, open_run(run, "cpu").scene
    assert stored.environment.region == trained.environment.region is not None
    assert {name: tensor.shape for name, tensor in trained.parameters().items()} == {
        name: tensor.shape for name, tensor in stored.parameters().items()
    }
    for name, tensor in trained.parameters().items():
        torch.testing.assert_close(stored.parameters()[name], tensor, rtol=0, atol=0, msg=name)
    panorama = read_equirect(run / "point_cloud" / "iteration_12" / "environment.png")
    expected = equirect_from_environment(trained.environment, panorama.shape[0])
    torch.testing.assert_close(panorama, expected, atol=0.01, rtol=0)


def test_surroundings_can_be_exchanged(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    panorama = run.parent / "red.png"
    write_equirect(panorama, torch.tensor([1.0, 0.0, 0.0]).expand(8, 16, 3))
    options = ["--layers", "environment", "--surroundings", str(panorama), "--output", str(run.parent / "red")]
    assert main(["render", str(run), *options]) == 0
    image = read_image(next((run.parent / "red" / "environment").rglob("*.png")))
    assert image[..., 0].min() > 250 and image[..., 1:].max() < 5
    options[3] = str(run.parent / "no.png")
    assert main(["render", str(run), *options]) == 2
    assert "no panorama at" in " ".join(capsys.readouterr().err.split())


def test_exchanging_surroundings_needs_a_reflective_scene(run: Path) -> None:
    scene = replace(open_run(run, "cpu").scene, environment=Environment.empty())
    with pytest.raises(InputError, match="nothing in the scene reflects an environment"):
        SceneEdits(surroundings=run.parent / "red.png").apply(scene)


def assert_own_colours_are_exported(run: Path) -> None:
    """`--layer transmission` of a glossy run exports its layer `base` as plain Gaussians, in every format."""
    output, stored = run.parent / "bare", open_run(run, "cpu")
    formats = ["--formats", "ply", "spz", "glb", "html"]
    assert main(["export", str(run), "--output", str(output), "--layer", "transmission", *formats]) == 0
    names = ["cameras.json", "glassplat.json", "index.html", "scene.glb", "scene.ply", "scene.spz"]
    assert sorted(path.name for path in output.iterdir()) == names
    bare, camera = load(output / "scene.ply", device="cpu"), stored.dataset.test[0].camera
    assert "logit_strength" not in bare.scene.primary.channels
    base = replace(stored.renderer, background=(0.0, 0.0, 0.0))(stored.scene, camera).layers["base"]
    torch.testing.assert_close(bare.render(camera).rgb, base, atol=1e-5, rtol=0)


def test_its_own_colours_are_exported_as_plain_gaussians(run: Path) -> None:
    assert_own_colours_are_exported(run)
