"""The command line from end to end on the bundled scene, at a size that takes seconds."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
import torch

from glassplat.cli.main import main
from glassplat.cli.train import LEAST_ITERATIONS, SCENE

PROMISED = {
    "method", "iterations", "resolution", "split", "seed", "num_gaussians", "train_seconds", "seconds_per_frame",
    "psnr", "ssim", "lpips", "lpips_backbone", "pane_psnr", "pane_region", "transmission_psnr", "reflection_psnr",
    "planes",
}  # fmt: skip
PLANE_KEYS = {
    "label", "center", "normal", "base_reflectance", "normal_error_deg", "offset_error", "base_reflectance_error",
}  # fmt: skip


@pytest.fixture(autouse=True)
def coarse_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the usual grid, the search for missing objects takes up to half of a training of a few steps."""
    monkeypatch.setattr("glassplat.training.actions.GRID_CELLS", 24)


def train(method: str, output: Path, *options: str) -> int:
    return main(["train", method, "--data", str(SCENE), "--output", str(output), "--downscale", "12", *options])


@pytest.mark.parametrize("method", ["splat", "planar"])
def test_train_eval_render(method: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "a run"
    assert train(method, run, "--iterations", "20") == 0
    told = " ".join(capsys.readouterr().out.split())
    assert f"next: glassplat eval '{run}'" in told
    assert (run / "point_cloud" / "iteration_20" / "point_cloud.ply").is_file()
    assert (run / "cameras.json").is_file()
    assert main(["eval", str(run)]) == 0
    results = json.loads((run / "results.json").read_text())
    assert set(results) >= PROMISED
    assert results["method"] == method
    assert f" s: {results['num_gaussians']} Gaussians, " in told
    assert all(f"{name}_reason" in results for name in PROMISED if results[name] is None)
    assert len(results["planes"]) == (1 if method == "planar" else 0)
    assert all(set(plane) >= PLANE_KEYS for plane in results["planes"])
    assert json.loads((run / "per_view.json").read_text())
    assert len(list((run / "sheets").glob("*.png"))) == results["num_test_views"]
    assert (run / "index.html").is_file()
    layers = (
        ["rgb", "depth"]
        if method == "splat"
        else ["rgb", "transmission", "without_panes", "reflection", "strength", "mask", "depth"]
    )
    assert main(["render", str(run), "--layers", *layers, "--split", "test", "--output", str(tmp_path / "out")]) == 0
    assert all(len(list((tmp_path / "out" / name).glob("*.png"))) == results["num_test_views"] for name in layers)


def test_a_run_is_not_overwritten_and_resumes_only_as_it_was_started(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert train("splat", run, "--iterations", "3") == 0
    assert train("splat", run, "--iterations", "3") == 2
    assert "--resume" in capsys.readouterr().err
    assert train("splat", run, "--iterations", "4", "--resume") == 2
    assert "expected the same to resume it" in " ".join(capsys.readouterr().err.split())
    assert train("splat", run, "--iterations", "3", "--resume") == 0


def test_a_run_finds_its_capture_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(SCENE.parent)
    options = ["--data", SCENE.name, "--output", str(tmp_path / "run"), "--downscale", "12", "--iterations", "3"]
    assert main(["train", "splat", *options]) == 0
    monkeypatch.chdir(tmp_path)
    assert main(["render", "run", "--layers", "rgb", "--output", "out"]) == 0
    assert main(["train", "splat", "--data", str(SCENE), *options[2:], "--resume"]) == 0


def test_the_strategy_and_its_cap_are_chosen_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    assert train("splat", run, "--iterations", "3", "--strategy", "mcmc", "--cap", "5000") == 0
    recipe = json.loads((run / "recipe.json").read_text())
    assert recipe["strategy"] == "mcmc" and recipe["mcmc"]["cap"] == 5000
    assert train("planar", tmp_path / "other", "--strategy", "genetic") == 2
    assert "invalid choice 'genetic'" in capsys.readouterr().err


def fails_with(arguments: list[str], capsys: pytest.CaptureFixture[str], *words: str) -> None:
    assert main(arguments) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "Traceback" not in message
    for word in words:
        assert word in message


def test_bad_input_ends_with_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = ["--output", str(tmp_path / "run")]
    empty = tmp_path / "empty"
    empty.mkdir()
    fails_with(["train", "splat", "--data", str(empty), *output], capsys, "error:", "Looked for")
    itself = str(empty / ".." / "empty")
    fails_with(["train", "splat", "--data", str(empty), "--output", itself], capsys, "is the capture itself; choose")
    fails_with(
        ["train", "splat", "--data", str(SCENE), *output, "--iterations", "0"], capsys, "--iterations is 0; expected"
    )
    short = ["train", "planar", "--data", str(SCENE), *output, "--iterations", "1"]
    assert main(short) == 2
    told = capsys.readouterr()
    assert "expected at least 8" in " ".join(told.err.split()) and "training and" not in told.out
    assert not (tmp_path / "run").exists()


def test_planar_without_masks_is_refused_with_advice(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = tmp_path / "capture"
    shutil.copytree(SCENE, capture, ignore=shutil.ignore_patterns("panes", "gt"))
    options = ["--output", str(tmp_path / "run"), "--downscale", "12", "--iterations", "20"]
    words = ("error:", "has no masks of panes", "capture/panes", "`glassplat train splat` needs none")
    fails_with(["train", "planar", "--data", str(capture), *options], capsys, *words)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("train splat --data x --output y --no-such-option", "glassplat train splat has no option --no-such-option"),
        ("train splat", "missing from glassplat train: --data PATH directory of"),
        ("dereflect RUN --output o --source [bold]", "invalid choice '[bold]' for argument '--source'"),
        ("render RUN", "missing from glassplat render: --output PATH output folder"),
        ("info", "missing from glassplat info: PATH any folder or file that glassplat reads or writes; all options: "),
        ("render RUN --output o --split foo", "invalid choice 'foo' for argument '--split'. Expected one of ('train'"),
        ("clean RUN --output", "missing value for argument '--output'"),
        ("view RUN --reflectance 1", "--reflectance: Failed to parse"),
        ("demo --iterations x", "--iterations: expected a whole number, not 'x'"),
    ],
)
def test_options_that_cannot_be_understood_end_with_one_line(
    words: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words.split()) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and said in line and re.search("[;?] all options", line)


def test_a_broken_scene_file_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = tmp_path / "run"
    assert train("splat", run, "--iterations", "2") == 0
    file = run / "point_cloud" / "iteration_2" / "point_cloud.ply"
    file.write_bytes(file.read_bytes()[:2000])
    fails_with(["eval", str(run)], capsys, "cannot be read", "point_cloud.ply")


def test_the_demo_compares_both_methods_and_can_be_repeated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("glassplat.cli.train.DEMO_DOWNSCALE", 12.0)
    for _ in range(2):
        assert main(["demo", "--output", str(tmp_path), "--iterations", str(LEAST_ITERATIONS)]) == 0
        shown = "".join(capsys.readouterr().out.split())
        assert "planar" in shown and "splat" in shown and "index.html" in shown
    assert (tmp_path / "planar" / "index.html").is_file()


def test_a_gpu_that_cannot_be_used_is_explained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    assert train("splat", tmp_path / "run", "--iterations", "3", "--device", "cuda") == 2
    assert "or use --device cpu" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()


def test_a_full_gpu_is_explained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object, **options: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.")

    monkeypatch.setattr("glassplat.model.training.Run.run_to_end", full)
    assert train("splat", tmp_path / "run", "--iterations", "3") == 1
    said = " ".join(capsys.readouterr().err.split())
    assert "stopped: CUDA out of memory; " in said and "--downscale" in said and "--device cpu" in said
