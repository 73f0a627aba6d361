"""`glassplat info` distinguishes captures, photographs, runs and splat files, and reports their problems."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from glassplat.captures.dataset import load_dataset
from glassplat.cli.main import main
from glassplat.cli.train import SCENE
from glassplat.files.ply import write_gaussians
from glassplat.files.spz import write_spz
from glassplat.methods.splat_recipe import SplatRecipe
from glassplat.model.run_directory import RunDirectory, RunSettings
from glassplat.model.training import Run
from glassplat.panes import PlaneFitError
from glassplat.scene.gaussians import Gaussians
from glassplat.training.messages import Message, StepDone
from tests.cli.tiny_run import write_run
from tests.prepare.test_video import film
from tests.training.tiny_capture import true_scene, write_tiny_capture


def told(path: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The JSON report of a path, after checking that the text agrees with it."""
    assert main(["info", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert main(["info", str(path)]) == 0
    text = capsys.readouterr().out
    assert found["kind"] in text and all(line.split("    ")[0] in text for line in found["next"])
    commands = [shlex.split(line) for line in found["next"] if line.startswith("glassplat")]
    assert all(any(word.startswith(str(path).removesuffix(".partial")) for word in words) for words in commands)
    return found


def test_a_capture_is_described_with_its_panes(capsys: pytest.CaptureFixture[str]) -> None:
    found = told(SCENE, capsys)
    assert found["kind"] == "a capture" and found["healthy"]
    assert found["facts"]["panes"].startswith("1; masks of 8")
    assert "points behind panes" in found["facts"]
    assert any("train planar" in line for line in found["next"])


def test_info_suggests_annotating_a_capture_without_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(SCENE, tmp_path / "my capture", ignore=shutil.ignore_patterns("panes", "gt"))
    found = told(tmp_path / "my capture", capsys)
    assert found["facts"]["panes"] == "none marked"
    assert any("glassplat annotate" in line for line in found["next"])


def test_masks_that_give_no_plane_are_to_be_marked_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*given: object) -> None:
        raise PlaneFitError("pane 1 is annotated in 2 views")

    monkeypatch.setattr("glassplat.cli.details.capture_planes", refuse)
    shutil.copytree(SCENE, tmp_path / "my capture", ignore=shutil.ignore_patterns("gt"))
    for mask in sorted((tmp_path / "my capture" / "panes").iterdir())[2:]:
        mask.unlink()
    found = told(tmp_path / "my capture", capsys)
    assert "2 masks only; three to ten, from positions far apart, work better" in found["problems"]
    assert "pane 1 is annotated in 2 views" in found["problems"]
    assert any("marks panes by their corners instead" in line for line in found["next"])


def test_estimated_normals_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = write_tiny_capture(tmp_path / "capture")
    assert "normals" not in told(capture, capsys)["facts"]
    (capture / "normals").mkdir()
    for photograph in sorted((capture / "images").iterdir())[1:4]:
        (capture / "normals" / photograph.with_suffix(".npy").name).touch()
    assert told(capture, capsys)["facts"]["normals"].startswith("estimated for 3 training photographs")


def test_the_share_excluded_by_masks_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = write_tiny_capture(tmp_path / "capture")
    (capture / "ignore").mkdir()
    for name in ("1.png", "2.png"):
        Image.fromarray(np.repeat(np.uint8([[0] * 30 + [255] * 10]), 28, axis=0)).save(capture / "ignore" / name)
    assert told(capture, capsys)["facts"]["ignored"].startswith("about 25% of 2 photographs, by masks")


def test_photographs_are_to_be_prepared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(SCENE / "images", tmp_path / "my photographs")
    (tmp_path / "my photographs" / "masks").mkdir()
    for mask in ("0001_mask.png", "masks/0002.png"):
        Image.new("L", (640, 480)).save(tmp_path / "my photographs" / mask)
    found = told(tmp_path / "my photographs", capsys)
    assert found["kind"] == "photographs without poses"
    assert found["facts"] == {"photographs": 64, "masks": 2}
    assert any("glassplat prepare" in line for line in found["next"])


def test_a_video_is_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    offsets = np.linspace(0, 40, 12)
    found = told(film(tmp_path / "a walk.avi", offsets), capsys)
    assert found["kind"] == "a video" and found["healthy"] and found["facts"]["frames"] == 12
    assert any("glassplat prepare" in line for line in found["next"])
    (tmp_path / "notes.mp4").write_text("no video")
    found = told(tmp_path / "notes.mp4", capsys)
    assert found["kind"] == "a file with a video's suffix" and not found["next"]
    assert "OpenCV cannot read a frame of it" in found["problems"][0]


def test_videos_are_recognised_by_name_without_opencv(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    (tmp_path / "walk.mp4").write_text("no video")
    found = told(tmp_path / "walk.mp4", capsys)
    assert found["kind"] == "a video, by its name" and "needs OpenCV" in found["problems"][0]


def test_info_names_photographs_that_prepare_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "photographs"
    folder.mkdir()
    for path in sorted((SCENE / "images").iterdir())[:25]:
        shutil.copy(path, folder)
    assert told(folder, capsys)["healthy"]
    first, second, *_ = sorted(folder.iterdir())
    first.write_bytes(first.read_bytes()[:900])
    second.write_bytes(b"\0\0\0\x18ftypheic")
    found = told(folder, capsys)
    assert not found["healthy"]
    assert f"2 are broken, tiny or of a kind that cannot be read ({first.name}, {second.name})" in found["problems"][0]


def test_a_photograph_of_a_capture_that_is_cut_off_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = shutil.copytree(SCENE, tmp_path / "capture", ignore=shutil.ignore_patterns("panes", "gt"))
    photograph = capture / "images" / "0005.jpg"
    photograph.write_bytes(photograph.read_bytes()[:4000])
    assert told(capture, capsys)["problems"] == [
        "1 are broken, tiny or of a kind that cannot be read (0005.jpg); replace or remove them"
    ]


def test_small_photographs_of_a_capture_are_valid(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """They are smaller than photographs that `prepare` could register."""
    capture = shutil.copytree(SCENE, tmp_path / "capture", ignore=shutil.ignore_patterns("panes", "gt"))
    for path in (capture / "images").iterdir():
        with Image.open(path) as image:
            image.resize((80, 60)).save(path)
    (scaled,) = told(capture, capsys)["problems"]
    assert "are scaled copies of the calibrated photographs" in scaled


def test_a_folder_of_few_photographs_gets_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "few").mkdir()
    shutil.copy(SCENE / "images" / "0000.jpg", tmp_path / "few")
    (tmp_path / "few" / "._0000.jpg").write_bytes(b"what a Mac leaves on foreign disks")
    assert told(tmp_path / "few", capsys)["problems"] == ["only 1 photograph; 30 or more work better"]


def test_info_suggests_resuming_an_interrupted_preparation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "my capture.partial").mkdir()
    (tmp_path / "my capture.partial" / "settings.json").write_text('{"input": "photographs"}')
    found = told(tmp_path / "my capture.partial", capsys)
    assert not found["healthy"] and found["next"][0].endswith("--resume")
    begun = {"input": "photographs", "max-size": 500, "frames": 150, "lens": "opencv", "mapper": "incremental"}
    (tmp_path / "my capture.partial" / "settings.json").write_text(json.dumps(begun))
    found = told(tmp_path / "my capture.partial", capsys)
    assert found["next"][0].endswith("my capture' --max-size 500 --lens opencv --resume")
    for damaged in ("{bad", "[]", "{}"):
        (tmp_path / "my capture.partial" / "settings.json").write_text(damaged)
        assert main(["info", str(tmp_path / "my capture.partial")]) == 2
        assert "report it" not in capsys.readouterr().err


def test_a_finished_run_with_a_damaged_scene_is_reported_with_the_reason(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_tiny_capture(tmp_path / "capture")
    run = tmp_path / "run"
    settings = RunSettings(str(tmp_path / "capture"), 12, seed=3)
    Run(SplatRecipe(sh_degree=1), settings, RunDirectory(run), load_dataset(settings.data)).run_to_end(lambda _: None)
    (run / "cameras.json").unlink()
    assert "cameras.json is missing" in told(run, capsys)["problems"][0]
    (scene,) = run.glob("point_cloud/*/point_cloud.ply")
    scene.write_bytes(scene.read_bytes()[:-100])
    found = told(run, capsys)
    (problem,) = found["problems"]
    assert "point_cloud.ply" in problem and "interrupted" not in problem
    (command,) = (line for line in found["next"] if "--resume" in line)
    assert main([*shlex.split(command)[1:], "--device", "cpu"]) == 0
    capsys.readouterr()
    assert told(run, capsys)["problems"] == [] and (run / "cameras.json").is_file()


def test_an_interrupted_run_prints_its_step_and_the_resume_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_tiny_capture(tmp_path / "a capture")
    options = ["--data", str(tmp_path / "a capture"), "--output", str(tmp_path / "run"), "--iterations", "12"]

    def stop(message: Message) -> None:
        if isinstance(message, StepDone) and message.step == 5:
            signal.raise_signal(signal.SIGINT)

    recipe, settings = SplatRecipe(sh_degree=1), RunSettings(str(tmp_path / "a capture"), 12, seed=3)
    with pytest.raises(KeyboardInterrupt):
        Run(recipe, settings, RunDirectory(tmp_path / "run"), load_dataset(settings.data)).run_to_end(stop)
    found = told(tmp_path / "run", capsys)
    assert "interrupted at step 5 of 12" in found["problems"]
    (command,) = (line for line in found["next"] if "--resume" in line)
    assert all(word in shlex.split(command) for word in options)
    assert main([*shlex.split(command)[1:], "--device", "cpu"]) == 0
    capsys.readouterr()
    assert told(tmp_path / "run", capsys)["facts"]["trained to"] == 12


def test_machine_readable_output_has_no_colours_and_no_log_lines(tmp_path: Path) -> None:
    capture = write_tiny_capture(tmp_path / "capture")
    command = [sys.executable, "-m", "glassplat", "info", str(capture), "--json"]
    colourful = os.environ | {"FORCE_COLOR": "1", "COLUMNS": "40"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True, env=colourful)
    assert json.loads(done.stdout)["path"] == str(capture) and "pane 1: " in done.stderr


def test_info_describes_a_run_with_a_missing_capture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "my run")
    found = told(run, capsys)
    assert found["kind"] == "a planar run" and found["facts"]["panes"].startswith("1 (R0")
    assert any("glassplat eval" in line for line in found["next"])
    shutil.move(tmp_path / "capture", tmp_path / "elsewhere")
    assert "no longer at" in " ".join(told(run, capsys)["problems"])
    assert told(run / "point_cloud" / "iteration_1", capsys)["kind"] == "an exported scene"


def test_info_suggests_resuming_a_run_without_a_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "run")
    shutil.rmtree(run / "point_cloud")
    (run / "checkpoint.safetensors").write_bytes(b"")
    assert any("--resume" in problem for problem in told(run, capsys)["problems"])


def test_a_scene_without_a_capture_is_described(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "out"
    assert main(["export", str(write_run(tmp_path / "run")), "--output", str(output), "--formats", "ply"]) == 0
    tidy = tmp_path / "my scene"
    assert main(["clean", str(output), "--output", str(tidy)]) == 0
    assert f"next: glassplat view '{tidy}'" in " ".join(capsys.readouterr().out.split())
    found = told(tidy, capsys)
    assert found["kind"] == "a scene without a capture" and found["facts"]["panes"].startswith("1 (R0")
    assert [line.split()[1] for line in found["next"]] == ["view", "export"]


def test_info_lists_the_panes_of_an_exported_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "an export"
    export = ["export", str(write_run(tmp_path / "run")), "--output", str(output), "--formats", "ply"]
    assert main([*export, "--as-mirror", "1"]) == 0
    capsys.readouterr()
    found = told(output, capsys)
    assert found["kind"] == "an exported scene" and found["facts"]["panes"] == "1 (mirror)"
    (output / "index.html").touch()
    assert f"open {output / 'index.html'} in a browser, or share it: it needs no server" in told(output, capsys)["next"]
    (output / "planes.json").write_text("{}")
    assert main(["info", str(output)]) == 2


def test_what_a_damaged_run_lacks_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = write_run(tmp_path / "a run")
    (run / "results.json").write_text('{"psnr": 31.25}')
    assert told(run, capsys)["facts"]["measured"] == "PSNR 31.250"
    (run / "results.json").write_text("[")
    assert f"{run / 'results.json'} is damaged; evaluate it again" in told(run, capsys)["problems"]
    (splats,) = run.glob("point_cloud/*/point_cloud.ply")
    assert "scene.json" in told(splats, capsys)["facts"]["next to it"]
    (run / "recipe.json").unlink()
    assert main(["info", str(run)]) == 2
    assert "holds a scene, but no recipe.json" in " ".join(capsys.readouterr().err.split())


def test_a_folder_of_runs_is_not_taken_for_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    demo = tmp_path / "a demo"
    write_run(demo / "planar")
    write_run(demo / "splat", planar=False)
    shutil.rmtree(demo / "capture")
    (demo / "planar" / "sheets").mkdir()
    shutil.copy(SCENE / "images" / "0000.jpg", demo / "planar" / "sheets")
    found = told(demo, capsys)
    assert found["kind"] == "a folder of runs" and found["facts"]["runs"] == "planar, splat"
    assert [shlex.split(line)[1:] for line in found["next"]] == [
        ["info", str(demo / "planar")],
        ["info", str(demo / "splat")],
    ]


def small(gaussians: Gaussians) -> Gaussians:
    return Gaussians(gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities, gaussians.sh)


@pytest.mark.parametrize("suffix", [".ply", ".spz"])
def test_splat_files_are_counted_and_judged(suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaussians = small(true_scene().primary)
    path = tmp_path / f"splat{suffix}"
    (write_gaussians if suffix == ".ply" else write_spz)(path, gaussians)
    found = told(path, capsys)
    assert found["facts"]["Gaussians"] == len(gaussians) and found["healthy"]
    faint = gaussians.with_tensors({"logit_opacities": torch.full((len(gaussians),), -8.0)})
    (write_gaussians if suffix == ".ply" else write_spz)(path, faint)
    assert told(path, capsys)["problems"] == ["100% of the Gaussians are nearly invisible"]
    (write_gaussians if suffix == ".ply" else write_spz)(path, gaussians.select(torch.zeros(len(gaussians)).bool()))
    assert told(path, capsys)["problems"] == ["it holds no Gaussian"]


def test_gaussians_without_a_finite_position_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    gaussians = small(true_scene().primary)
    nowhere = gaussians.with_tensors({"means": torch.full_like(gaussians.means, torch.nan)})
    write_gaussians(tmp_path / "splat.ply", nowhere)
    (problem,) = told(tmp_path / "splat.ply", capsys)["problems"]
    assert problem.startswith(f"{len(gaussians)} Gaussians have non-finite positions")


def test_glass_without_colours_has_no_degree(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    glass = true_scene().glass
    write_gaussians(tmp_path / "glass.ply", glass)
    facts = told(tmp_path / "glass.ply", capsys)["facts"]
    assert facts["Gaussians"] == len(glass) and "SH degree" not in facts


def test_an_unrecognised_folder_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(tmp_path)]) == 2
    assert "not a known kind of folder" in " ".join(capsys.readouterr().err.split())


def test_a_damaged_capture_is_refused_with_the_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(SCENE, tmp_path / "capture")
    (tmp_path / "capture" / "images" / "0000.jpg").unlink()
    assert main(["info", str(tmp_path / "capture")]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "images lacks 1 of the 64 photographs of the COLMAP model: 0000.jpg" in said
