"""`glassplat bench` from end to end on a tiny capture, interrupted and repeated."""

from __future__ import annotations

import json
import shutil
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import pytest

from glassplat.cli import main
from glassplat.commands.measuring import bench
from glassplat.commands.measuring.bench_runs import FinishedRun, PlannedRun, RunClock, scene_names
from glassplat.commands.training.train import Train, TrainingProgress
from glassplat.data.errors import InputError
from glassplat.init.planes import PlaneFitError
from glassplat.train.ablations import ABLATIONS, Ablated, Switch
from glassplat.train.checkpoint import load_checkpoint
from glassplat.train.messages import Message, StepDone
from glassplat.train.planar_recipe import PlanarRecipe
from glassplat.train.recipe import RECIPES
from glassplat.train.splat_recipe import SplatRecipe
from tests.train.tiny_capture import write_tiny_capture


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_tiny_capture(tmp_path / "tiny")


def bench_scenes(capture: Path, *options: str) -> int:
    output = capture.parent / "bench"
    return main(["bench", "scenes", "--data", str(capture), "--iterations", "8", "--output", str(output), *options])


def written(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Every file of the runs with its time of change and contents."""
    files = sorted(path for path in (folder / "runs").rglob("*") if path.is_file())
    return {str(path): (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def test_scenes_are_trained_evaluated_and_tabled_once(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench_scenes(capture, "--seeds", "0", "1") == 0
    output = capture.parent / "bench"
    assert "run 4 of 4: tiny, planar, seed 1 (about" in capsys.readouterr().out
    contents = json.loads((output / "scenes.json").read_text())
    assert [(run["variant"], run["seed"]) for run in contents["runs"]] == [
        ("splat", 0),
        ("planar", 0),
        ("splat", 1),
        ("planar", 1),
    ]
    assert [(row["scene"], row["title"], row["psnr"]["seeds"]) for row in contents["means"]] == [
        ("tiny", "splat", 2),
        ("tiny", "planar", 2),
    ]
    psnr = [run["psnr"] for run in contents["runs"]]
    (difference,) = contents["differences"]
    assert difference["title"] == "planar - splat"
    assert difference["psnr"]["mean"] == pytest.approx((psnr[1] - psnr[0] + psnr[3] - psnr[2]) / 2)
    table = (output / "scenes.md").read_text()
    assert "| tiny | planar |" in table and "| tiny | planar - splat |" in table

    before = written(output)
    (output / "scenes.md").unlink()
    assert bench_scenes(capture, "--seeds", "0", "1") == 0
    assert "4 of 4 runs are finished already" in capsys.readouterr().out
    assert written(output) == before
    assert (output / "scenes.md").read_text() == table


def test_an_interrupted_bench_goes_on(
    capture: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shown: list[int] = []

    def interrupt(self: TrainingProgress, message: Message) -> None:
        if isinstance(message, StepDone):
            shown.append(message.step)
            if len(shown) == 8 + 5:
                signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(TrainingProgress, "show", interrupt)
    assert bench_scenes(capture) == 130
    captured = capsys.readouterr()
    assert "stopped in run 2 of 2" in captured.out
    assert "repeat the command to go on" in " ".join(captured.err.split())
    output = capture.parent / "bench"
    assert [run["variant"] for run in json.loads((output / "scenes.json").read_text())["runs"]] == ["splat"]
    interrupted = output / "runs" / "tiny" / "planar-seed0"
    assert load_checkpoint(interrupted / "checkpoint.safetensors").step == 5
    before = written(output)

    assert bench_scenes(capture) == 0
    assert shown[13:] == [6, 7, 8]
    after = written(output)
    assert {p: f for p, f in after.items() if "splat-seed0" in p} == {p: f for p, f in before.items() if "splat-" in p}
    assert len(json.loads((output / "scenes.json").read_text())["differences"]) == 1


def rows_of(capture: Path) -> list[tuple[str, str]]:
    contents = json.loads((capture.parent / "bench" / "scenes.json").read_text())
    return [(row["scene"], row["title"]) for row in contents["means"]]


def test_commands_for_one_scene_each_share_their_tables(capture: Path, tmp_path: Path) -> None:
    other = write_tiny_capture(tmp_path / "other")
    assert bench_scenes(capture, "--methods", "splat") == 0
    assert bench_scenes(capture, "--data", str(other), "--methods", "splat") == 0
    assert rows_of(capture) == [("other", "splat"), ("tiny", "splat")]
    shutil.rmtree(other)
    assert bench_scenes(capture, "--methods", "planar", "--seeds", "0") == 0
    assert rows_of(capture) == [("tiny", "splat"), ("tiny", "planar"), ("other", "splat")]
    table = (capture.parent / "bench" / "scenes.md").read_text()
    assert "| tiny | planar - splat |" in table and "| other | splat |" in table


def test_runs_that_cannot_stand_in_one_table_are_told_apart(
    capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = write_tiny_capture(tmp_path / "other")
    assert bench_scenes(capture, "--methods", "splat") == 0
    before = (capture.parent / "bench" / "scenes.md").read_bytes()
    for options in (("--iterations", "9"), ("--downscale", "2")):
        assert bench_scenes(capture, "--data", str(other), "--methods", "splat", *options) == 2
        assert "because one table holds both" in " ".join(capsys.readouterr().err.split())
    assert (capture.parent / "bench" / "scenes.md").read_bytes() == before
    assert not (capture.parent / "bench" / "runs" / "other").exists()


def test_a_bench_too_short_for_a_method_ends_before_the_first_run(
    capture: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench_scenes(capture, "--iterations", "5") == 2
    assert "leave no room for the stage" in " ".join(capsys.readouterr().err.split())
    assert not (capture.parent / "bench").exists()


def test_another_run_in_the_way_is_not_overwritten(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench_scenes(capture, "--methods", "splat") == 0
    before = written(capture.parent / "bench")
    assert bench_scenes(capture, "--methods", "splat", "--iterations", "9") == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "holds a run with" in message and "Choose another --output" in message
    assert written(capture.parent / "bench") == before


def test_a_run_of_a_version_with_fewer_options_is_not_taken_for_one_of_this(
    capture: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert bench_scenes(capture, "--methods", "splat") == 0
    recipe = next((capture.parent / "bench").glob("runs/*/*/recipe.json"))
    recorded = json.loads(recipe.read_text())
    del recorded["rates"]["short_run_power"]
    recipe.write_text(json.dumps(recorded))
    assert bench_scenes(capture, "--methods", "splat") == 2
    assert "with another recipe" in " ".join(capsys.readouterr().err.split())


def test_a_scene_that_fails_does_not_stop_the_others(
    capture: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(self: PlanarRecipe, dataset: Any) -> None:
        raise PlaneFitError("pane 1 has no plane")

    monkeypatch.setattr(PlanarRecipe, "initialise", refuse)
    assert bench_scenes(capture, "--methods", "planar", "splat") == 2
    assert "1 of 2 runs failed" in " ".join(capsys.readouterr().err.split())
    assert "| tiny | splat |" in (capture.parent / "bench" / "scenes.md").read_text()


def test_the_ablation_tables_differences_to_the_full_method(capture: Path) -> None:
    output = capture.parent / "ablation"
    arguments = ["bench", "ablation", "--data", str(capture), "--iterations", "8", "--output", str(output)]
    assert main([*arguments, "--switches", "fresnel", "mask"]) == 0
    contents = json.loads((output / "ablation.json").read_text())
    psnr = {run["variant"]: run["psnr"] for run in contents["runs"]}
    assert list(psnr) == ["full", "no-fresnel", "no-mask"]
    rows = {row["title"]: row["psnr"]["mean"] for row in contents["differences"]}
    assert rows == {
        "w/o Fresnel-based reflection": pytest.approx(psnr["no-fresnel"] - psnr["full"]),
        "w/o L_m": pytest.approx(psnr["no-mask"] - psnr["full"]),
    }
    assert (
        "The paper's psnr, on its own scenes: w/o Fresnel-based reflection -0.24."
        in (output / "ablation.md").read_text()
    )
    before = written(output)
    assert main([*arguments, "--switches", "fresnel", "mask"]) == 0
    assert written(output) == before
    table = (output / "ablation.md").read_bytes()
    assert main([*arguments, "--switches", "mask"]) == 0
    assert written(output) == before and (output / "ablation.md").read_bytes() == table


@pytest.mark.parametrize("method", sorted(ABLATIONS))
def test_every_switch_changes_the_recipe_and_no_two_alike(method: Ablated) -> None:
    full, ablations = RECIPES[method](), ABLATIONS[method]
    recipes = [full, *(ablation.off(full) for ablation in ablations.values())]
    assert len({repr(recipe) for recipe in recipes}) == len(ablations) + 1


def test_switches_leave_the_rest_as_it_is() -> None:
    full = PlanarRecipe()
    off = ABLATIONS["planar"]["depth-and-conflict"].off(full).weights
    assert (off.depth, off.conflict, off.mask) == (0.0, 0.0, full.weights.mask)
    assert ABLATIONS["planar"]["perturbation"].off(full).perturbation.amplitude == 0


def test_every_switch_belongs_to_a_method() -> None:
    assert set(get_args(Switch)) == {switch for ablations in ABLATIONS.values() for switch in ablations}


def test_a_switch_of_another_method_is_refused(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["bench", "ablation", "--data", str(capture), "--output", str(capture.parent / "ablation")]
    assert main([*arguments, "--method", "deferred", "--switches", "fresnel"]) == 2
    assert "deferred has no parts ['fresnel']" in " ".join(capsys.readouterr().err.split())


@dataclass(frozen=True)
class StrategicRecipe:
    strategy: str = "default"


def test_a_strategy_is_set_where_there_is_one() -> None:
    assert bench.with_strategy(StrategicRecipe(), "mcmc") == StrategicRecipe("mcmc")
    recipe = SplatRecipe()
    if not hasattr(recipe, "strategy"):
        assert bench.with_strategy(recipe, "default") is recipe
        with pytest.raises(InputError, match="splat has no strategy 'mcmc'"):
            bench.with_strategy(recipe, "mcmc")


def test_options_named_twice(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bench_scenes(capture, "--seeds", "1", "1") == 2
    assert "--seeds is [1, 1]" in " ".join(capsys.readouterr().err.split())
    assert bench_scenes(capture, "--data", str(capture), str(capture)) == 2
    assert "twice" in " ".join(capsys.readouterr().err.split())


def test_a_capture_that_cannot_be_read_ends_it_before_the_first_run(capture: Path) -> None:
    assert bench_scenes(capture, "--data", str(capture), str(capture.parent / "none")) == 2
    assert not (capture.parent / "bench" / "runs").exists()


def test_scenes_are_called_by_as_little_as_tells_them_apart() -> None:
    assert scene_names([Path("/a/room"), Path("/b/hall")]) == ["room", "hall"]
    assert scene_names([Path("/a/room/capture"), Path("/a/hall/capture")]) == ["room-capture", "hall-capture"]


def planned(scene: str, variant: str) -> PlannedRun:
    recipe = PlanarRecipe() if variant.startswith("planar") else SplatRecipe()
    return PlannedRun(scene, variant, Train(recipe, Path("data"), Path("out")))


def test_the_time_left_is_judged_by_the_most_similar_runs() -> None:
    assert RunClock([]).left([planned("room", "splat")]) == "time left is known after the first run"
    finished = [
        FinishedRun(planned("room", "splat"), {"train_seconds": 60.0}),
        FinishedRun(planned("room", "planar"), {"train_seconds": 300.0}),
        FinishedRun(planned("hall", "planar"), {"train_seconds": 420.0}),
    ]
    clock = RunClock(finished)
    assert clock.left([planned("room", "planar")]) == "about 5 min left"
    assert clock.left([planned("yard", "planar"), planned("hall", "splat")]) == "about 7 min left"


def test_the_recipes_of_the_papers_are_compared_by_name(capture: Path) -> None:
    assert bench_scenes(capture, "--methods", "splat", "--presets", "glassplat", "paper") == 0
    output = capture.parent / "bench"
    contents = json.loads((output / "scenes.json").read_text())
    runs = contents["runs"]
    assert [row["title"] for row in contents["differences"]] == ["splat - splat-paper"]
    assert [run["variant"] for run in runs] == ["splat", "splat-paper"]
    recorded = [json.loads((Path(run["directory"]) / "recipe.json").read_text()) for run in runs]
    assert [recipe["densify"]["split_by"] for recipe in recorded] == ["pull", "gradient"]


def test_a_capture_that_cannot_be_read_leaves_no_tables(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (capture / "transforms.json").write_text("[]")
    assert bench_scenes(capture) == 2
    assert "transforms.json" in capsys.readouterr().err
    assert not (capture.parent / "bench").exists()


@pytest.mark.parametrize("name", ["runs", "scenes.md"])
def test_nothing_is_written_where_links_lead_out_of_the_output(
    name: str, capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bench").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "bench" / name).symlink_to(tmp_path / "elsewhere")
    assert bench_scenes(capture) == 2
    assert "leads out of" in capsys.readouterr().err
    assert not list((tmp_path / "elsewhere").iterdir())
