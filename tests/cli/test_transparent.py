"""Transparent photographs from end to end: trained, resumed, evaluated and rendered with one background."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from glassplat.cli.main import main
from glassplat.cli.runs import open_run
from glassplat.files.images import read_image
from tests.training.object_capture import write_object_capture


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_object_capture(tmp_path / "ball")


def train(capture: Path, *options: str) -> Path:
    run = capture.parent / "run"
    arguments = ["--data", str(capture), "--output", str(run), "--iterations", "3", "--sh-degree", "0", *options]
    assert main(["train", "splat", *arguments]) == 0
    return run


@pytest.mark.parametrize(
    ("options", "background"), [([], (1, 1, 1)), (["--background", "0", "0", "0"], (0, 0, 0))], ids=["white", "black"]
)
def test_nothing_has_the_background_in_photographs_and_renders(
    capture: Path, options: list[str], background: tuple[int, int, int]
) -> None:
    run = train(capture, *options)
    assert json.loads((run / "recipe.json").read_text())["background"] == list(background)
    assert main(["eval", str(run)]) == 0
    assert json.loads((run / "results.json").read_text())["normal_error_deg_reason"] == "the method renders no normals"
    assert main(["render", str(run), "--output", str(run / "out"), "--split", "all"]) == 0
    dataset = open_run(run).dataset
    assert len(dataset.test) == 2
    for view in (*dataset.train, *dataset.test):
        corner = np.array(background) * 255
        image = read_image(run / "out" / "rgb" / view.name)
        np.testing.assert_array_equal(view.photo[:4, :4].numpy(), np.broadcast_to(corner, (4, 4, 3)))
        np.testing.assert_array_equal(image[:4, :4], np.broadcast_to(corner, (4, 4, 3)))


def test_a_run_is_resumed_over_the_background_it_began_with(capture: Path) -> None:
    run = train(capture)
    assert train(capture, "--resume") == run
    assert json.loads((run / "recipe.json").read_text())["background"] == [1.0, 1.0, 1.0]
