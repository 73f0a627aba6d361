"""Comparisons over scenes: their runs, each executed once, and the contents of their tables."""

from __future__ import annotations

import errno
import json
import os
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks import compare
from benchmarks.compare import (
    COLUMNS,
    FAILED,
    RESULTS,
    Measured,
    compared,
    main,
    named_options,
    parsed,
    planned_runs,
    tables,
    values_of,
)
from glassplat.cli import main as command_line
from tests.training.tiny_capture import write_tiny_capture


def results(psnr: float, **more: object) -> dict:
    return {"psnr": psnr, "num_gaussians": 100, **more}


def measured(**by_run: list[dict]) -> Measured:
    """Values of runs, by the name of a method with an entry per scene."""
    return {
        (f"room-{number}", name.replace("_", ":"), 0): values_of(one)
        for name, ones in by_run.items()
        for number, one in enumerate(ones)
    }


def row(text: str, *begin: str) -> list[str]:
    """The cells of the only line that starts with the given ones."""
    (line,) = [line for line in text.splitlines() if line.startswith(f"| {' | '.join(begin)} |")]
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_the_help_shows_variants_that_can_be_trained() -> None:
    shown = re.findall(r"--variant (\S+=\".*?\")", compare.__doc__ or "")
    assert len(shown) == 3
    for _, method, options in named_options(["splat", "planar"], [shlex.split(variant)[0] for variant in shown]):
        command_line.parse_arguments(["train", method, "--data", "room", "--output", "run", *options])


def test_runs_are_trained_and_evaluated_once_and_failures_stop_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(write_tiny_capture(tmp_path / "tiny")), "--methods", "splat", "--iterations", "8"]
    arguments += ["--variant", "splat:broken=--no-such-option", "--output", str(tmp_path / "runs")]
    assert main(arguments) == 1
    said = capsys.readouterr()
    assert "tiny, splat:broken, seed 0: train ended with 2: " in said.err and "no-such-option" in said.err
    assert row(said.out, "tiny", "splat")[2] == f"{kept(tmp_path)['psnr']:.2f}"
    assert (tmp_path / "runs" / "tables.md").read_text().rstrip() in said.out

    monkeypatch.setattr(compare.Run, "start", lambda run: pytest.fail(f"{run.title} is begun again"))
    assert main(arguments[:-4] + arguments[-2:]) == 0
    assert "1 of 1 runs are finished" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"holds a run of `splat --data .* --iterations 8`"):
        main([*arguments, "--iterations", "9"])


def test_processes_share_the_work_in_an_output_and_resume_that_of_dead_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b", "c", "d"):
        (tmp_path / name).mkdir()
    scenes = [str(tmp_path / name) for name in ("a", "b", "c", "d")]
    arguments = [*scenes, "--methods", "splat", "--output", str(tmp_path / "runs")]
    begun: list[str] = []

    def work(run: compare.Run, command: str, *_: str) -> subprocess.Popen[bytes]:
        begun.append(f"{run.scene} {command}")
        script = "import sys, pathlib; pathlib.Path(sys.argv[1]).write_text('{\"psnr\": 1.0}')"
        return subprocess.Popen(
            [sys.executable, "-c", script if command == "eval" else "", str(run.directory / RESULTS)]
        )

    monkeypatch.setattr(compare.Run, "_glassplat", work)
    monkeypatch.setattr(compare, "PATIENCE", 0.01)
    runs = planned_runs(parsed(arguments))
    dead, finished = runs[1].claimed(), runs[3].claimed()
    assert dead is not None and finished is not None and runs[1].claimed() is None

    def elsewhere() -> None:
        """The other process finishes one of its two runs and dies during the other."""
        if len(begun) == 4:
            (runs[3].directory / RESULTS).write_text('{"psnr": 2.0}')
            finished.release()
            dead.release()

    assert compare.execute(runs, 1, elsewhere, first=2) == []
    assert begun == ["c train", "c eval", "a train", "a eval", "b train", "b eval"]
    assert main(arguments) == 0 and len(begun) == 6


def test_an_unwritable_run_folder_does_not_stop_other_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    scenes = [str(tmp_path / name) for name in ("a", "b")]
    runs = planned_runs(parsed([*scenes, "--methods", "splat", "--output", str(tmp_path / "runs")]))

    def work(run: compare.Run, command: str, *_: str) -> subprocess.Popen[bytes]:
        if run.scene == "a":
            raise OSError(errno.EDQUOT, "Disk quota exceeded")
        (run.directory / RESULTS).write_text('{"psnr": 1.0}')
        return subprocess.Popen([sys.executable, "-c", ""])

    monkeypatch.setattr(compare.Run, "_glassplat", work)
    (failure,) = compare.execute(runs, 1, lambda: None)
    assert "a, splat, seed 0: train could not begin: " in failure and "quota" in failure
    assert runs[0].claimed() is not None and runs[1].results() == {"psnr": 1.0}


def test_a_run_that_failed_elsewhere_is_reported_and_not_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "room").mkdir()
    (run,) = planned_runs(parsed([str(tmp_path / "room"), "--methods", "splat", "--output", str(tmp_path / "runs")]))
    run.directory.mkdir(parents=True)
    monkeypatch.setattr(compare.Run, "start", lambda run: pytest.fail("begun again"))
    (run.directory / FAILED).write_text("room: train ended with 2")
    os.utime(run.directory / FAILED, (time.time() + 60, time.time() + 60))
    assert compare.execute([run], 1, lambda: None) == ["room: train ended with 2"]
    assert run.failed_since(time.time() + 120) is None


def test_a_task_number_out_of_range_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([str(tmp_path), "--task", "3", "--of", "3"])
    assert "--task is 3, of 3; expected a number from 0 on, below --of" in capsys.readouterr().err


def kept(folder: Path) -> dict:
    """Results of the only finished run."""
    (one,) = json.loads((folder / "runs" / "results.json").read_text())
    return one


def test_a_started_run_is_resumed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "room").mkdir()
    options = parsed([str(tmp_path / "room"), "--methods", "planar", "--output", str(tmp_path / "runs")])
    (run,) = planned_runs(options)
    asked: list[tuple[str, ...]] = []
    monkeypatch.setattr(compare.Run, "_glassplat", lambda run, *arguments: asked.append(arguments))
    run.start()
    (run.directory / "checkpoint.safetensors").touch()
    run.start()
    first, second = asked
    assert first[:2] == ("train", "planar") and "--resume" not in first
    assert second == (*first, "--resume")


def test_variants_are_of_a_method_or_of_all_but_the_baseline() -> None:
    named = named_options(["splat", "planar", "traced"], ["dark=--a 0 --b 1", "splat:wide=--c"])
    assert [name for name, _, _ in named] == ["splat", "planar", "traced", "planar:dark", "traced:dark", "splat:wide"]
    assert named[3][1:] == ("planar", ["--a", "0", "--b", "1"])
    for wrong in ("nothing", "=--a", "deferred:dark=--a"):
        with pytest.raises(SystemExit, match="expected"):
            named_options(["splat", "planar"], [wrong])
    with pytest.raises(SystemExit, match="twice"):
        named_options(["planar"], ["dark=--a", "dark=--b"])


def test_scenes_are_named_by_their_distinguishing_folders(tmp_path: Path) -> None:
    folders = [tmp_path / "a" / "room", tmp_path / "b" / "room"]
    for folder in folders:
        folder.mkdir(parents=True)
    assert compare.scene_names(folders) == ["a-room", "b-room"]
    assert compare.scene_names(folders[:1]) == ["room"]
    with pytest.raises(SystemExit, match="twice"):
        compare.scene_names([folders[0], folders[0]])
    with pytest.raises(SystemExit, match="no such folder"):
        compare.scene_names([tmp_path / "c"])


def test_gains_are_means_over_scenes_with_the_worst_and_the_share_below() -> None:
    text = tables(
        measured(
            splat=[results(30.0, transmission_psnr=20.0), results(30.0), results(30.0)],
            planar=[
                results(33.0, transmission_psnr=26.0, reflection_psnr=25.0, planes=[{"base_reflectance_error": 0.01}]),
                results(29.0, planes=[{"base_reflectance_error": 0.02}, {"base_reflectance_error": 0.04}]),
                results(31.0),
            ],
        )
    )
    # image, pane, transmission, reflection, R0 error, worst, below
    assert row(text, "planar", "3")[2:] == ["+1.00", "-", "+6.00", "25.00", "0.020", "room-1 -1.00", "1 of 3"]


def test_variants_are_set_against_their_method_seed_by_seed() -> None:
    runs = measured(planar=[results(30.0)], planar_dark=[results(29.5) | {"num_gaussians": 50}])
    runs["room-0", "planar", 1] = values_of(results(31.0))
    runs["room-0", "planar:dark", 1] = values_of(results(31.0))
    runs["room-0", "planar:dark", 2] = values_of(results(90.0))
    (differences,) = compared(runs, "planar:dark", "planar").values()
    assert [values[COLUMNS[0]] for values in differences] == [-0.5, 0.0]
    text = tables(runs)
    assert row(text, "planar:dark", "1")[2:] == ["-0.25", "0.707", "-0.25"]
    assert row(text, "room-0", "planar")[2] == "30.50 ± 0.71"


def test_runs_with_differently_placed_test_cameras_are_not_compared_silently(tmp_path: Path) -> None:
    (tmp_path / "room").mkdir()
    given = [str(tmp_path / "room"), "--methods", "splat", "--output", str(tmp_path / "runs")]
    runs = planned_runs(parsed([*given, "--variant", "splat:poses=--poses.rate 0.0001"]))
    for run, cameras in zip(runs, ("as the capture has them", "aligned with their photographs"), strict=True):
        run.directory.mkdir(parents=True)
        (run.directory / RESULTS).write_text(json.dumps(results(30.0, test_cameras=cameras)))
    assert "Test cameras differ" not in compare.write_tables(tmp_path / "runs", runs[:1])
    text = compare.write_tables(tmp_path / "runs", runs)
    assert "--align always" in text and "- aligned with their photographs: room, splat:poses, seed 0" in text
