"""`glassplat render` with edits of the panes."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from glassplat.cli import progress
from glassplat.cli.main import main
from glassplat.cli.places import SceneEdits
from glassplat.errors import InputError
from glassplat.files.images import read_image
from glassplat.model.model import load
from glassplat.prepare.photographs import Note
from glassplat.scene.scene import (
    Scene,
    as_mirrors,
    glass_of_pane,
    shift_pane,
    tilt_pane,
    with_reflectance,
    without_glass,
)
from glassplat.training.messages import Working
from tests.cli.tiny_run import rendered, write_run
from tests.scene.test_plane_edits import two_panes
from tests.training.tiny_capture import true_scene

EDITS = {
    "--remove-glass": without_glass(true_scene()),
    "--as-mirror 1": as_mirrors(true_scene(), [1]),
    "--reflectance 1 0.8": with_reflectance(true_scene(), 1, 0.8),
    "--tilt 1 -10 4.5 --shift 1 -0.1": shift_pane(tilt_pane(true_scene(), 1, -10, 4.5), 1, -0.1),
}


@pytest.mark.parametrize(("options", "scene"), EDITS.items(), ids=EDITS)
def test_edits_reach_the_picture(options: str, scene: Scene, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    assert main(["render", str(run), "--output", str(tmp_path / "out"), *options.split()]) == 0
    image = read_image(tmp_path / "out" / "rgb" / "0.png").astype(int)
    assert np.abs(image - rendered(scene, 0).numpy()).max() <= 1
    assert np.abs(image - rendered(true_scene(), 0).numpy()).max() > 5


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--as-mirror 4", "no pane 4; the panes are 1"),
        ("--reflectance 1 2", "expected a number from 0 to 1"),
        ("--remove-glass --as-mirror 1", "without the other edits"),
        ("--as-mirror 1 --reflectance 1 0.5", "give one of the two"),
    ],
)
def test_invalid_edits_write_nothing(
    options: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    assert main(["render", str(run), "--output", str(tmp_path / "out"), *options.split()]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("method", ["splat", "planar"])
def test_every_layer_that_is_listed_can_be_rendered(method: str, tmp_path: Path) -> None:
    run = write_run(tmp_path / "run", planar=method == "planar")
    layers = load(run, device="cpu").layers
    assert main(["render", str(run), "--output", str(tmp_path / "out")]) == 0
    (tmp_path / "out" / "rgb" / "0.npy").symlink_to(tmp_path / "elsewhere")  # No layer is written there.
    assert len(layers) == (9 if method == "planar" else 4)
    assert main(["render", str(run), "--output", str(tmp_path / "out"), "--layers", *layers]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir() if path.is_dir()) == sorted(layers)
    arrays = {path.parent.name: np.load(path) for path in (tmp_path / "out").glob("*/0.npy") if path.is_file()}
    frame = load(run, device="cpu").render("0.png", layers=["depth", "normal"])
    assert sorted(arrays) == ["depth", "normal"] and arrays["depth"].max() > 1
    assert all(np.array_equal(array, frame.layers[layer].numpy()) for layer, array in arrays.items())


@pytest.mark.parametrize(
    ("method", "layers", "words"),
    [
        ("splat", ["base"], "splat renders no layer base; expected layers out of rgb, normal, depth, alpha"),
        ("planar", ["photographed"], "only a run trained with --photographer.learn has photographed"),
        ("splat", ["rgb", "mask", "depth", "base"], "splat renders no layer mask, base; expected"),
        ("planar", ["rgb", "environment"], "planar renders no layer environment; expected layers out of rgb, "),
        ("planar", [], "planar renders nothing without layers; expected layers out of rgb, "),
    ],
)
def test_layers_that_a_method_lacks_are_refused_before_anything_is_rendered(
    method: str, layers: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run", planar=method == "planar")
    assert main(["render", str(run), "--output", str(tmp_path / "out"), "--layers", *layers]) == 2
    said = capsys.readouterr()
    assert words in said.err and "rendering" not in said.out
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("command", "work", "end"),
    [
        ("render", "rendering", "1 view x 1 layer -> "),
        ("dereflect --split test", "taking reflections off", "1 image without reflections -> "),
    ],
)
def test_progress_is_printed_to_a_log(
    command: str,
    work: str,
    end: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(progress, "LINE_INTERVAL", 0)
    name, *options = command.split()
    run = write_run(tmp_path / "run")
    assert main([name, str(run), "--output", str(tmp_path / "out"), *options]) == 0
    said = capsys.readouterr().out
    assert f"{work} (1)\n{work}: 1 of 1, 0 s left\n{end}" in said


def test_a_terminal_shows_one_bar_and_the_notes_above_it() -> None:
    said = io.StringIO()
    with progress.WorkProgress(Console(file=said, force_terminal=True, width=80)) as shown:
        for message in (
            Working("rendering", 0, 3),
            Working("rendering", 1, 3),
            Note("one is dark"),
            Working("saving", 0, 2),
        ):
            shown.show(message)
    assert all(words in said.getvalue() for words in ("one is dark", "saving", "0/2"))


def test_panes_that_pass_each_other_keep_their_glass() -> None:
    scene = two_panes()
    own, other = glass_of_pane(scene, 1), scene.planes.labels[0]
    shifted = SceneEdits(shift={other: 25.0, 7: -25.0}, tilt={7: (10.0, 0.0)}).apply(scene)
    expected = shift_pane(tilt_pane(scene, 7, 10.0, 0.0), 7, -25.0)
    torch.testing.assert_close(shifted.glass.means[own], expected.glass.means[own])


def test_a_scene_without_panes_cannot_be_edited() -> None:
    bare = without_glass(true_scene())
    assert SceneEdits().apply(bare) is bare
    with pytest.raises(InputError, match="no panes to edit"):
        SceneEdits(remove_glass=True).apply(bare)
