"""`glassplat render` with edits of the panes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from glassplat.cli import main
from glassplat.commands.scene_edits import SceneEdits
from glassplat.data.errors import InputError
from glassplat.files.images import read_image
from glassplat.scene.plane_edits import as_mirrors, shifted, tilted, with_reflectance, without_glass
from glassplat.scene.scene import Scene
from tests.commands.tiny_run import rendered, write_run
from tests.train.tiny_capture import true_scene

EDITS = {
    "--remove-glass": without_glass(true_scene()),
    "--as-mirror 1": as_mirrors(true_scene(), [1]),
    "--reflectance 1 0.8": with_reflectance(true_scene(), 1, 0.8),
    "--tilt 1 -10 4.5 --shift 1 -0.1": shifted(tilted(true_scene(), 1, -10, 4.5), 1, -0.1),
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
        ("--reflectance 1 2", "expected a number in [0, 1]"),
        ("--remove-glass --as-mirror 1", "without the other edits"),
        ("--as-mirror 1 --reflectance 1 0.5", "give one of the two"),
    ],
)
def test_edits_that_make_no_sense_write_nothing(
    options: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "run")
    assert main(["render", str(run), "--output", str(tmp_path / "out"), *options.split()]) == 2
    assert words in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()


def test_a_scene_without_panes_cannot_be_edited() -> None:
    bare = without_glass(true_scene())
    assert SceneEdits().applied(bare) is bare
    with pytest.raises(InputError, match="no panes to edit"):
        SceneEdits(remove_glass=True).applied(bare)
