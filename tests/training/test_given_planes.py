"""A capture may define its panes as rectangles: it then needs no masks, and nothing is fitted."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from glassplat.captures.dataset import load_dataset
from glassplat.captures.view import PointCloud
from glassplat.cli.main import main
from glassplat.errors import InputError
from glassplat.files.sidecars import read_planes, write_planes
from glassplat.methods.planar import PaneSetup, capture_planes
from glassplat.methods.planar_recipe import PlanarRecipe
from glassplat.options import CLEAR_GLASS
from glassplat.panes import PlaneFit, PlaneFitError
from glassplat.scene.panes import Planes
from glassplat.training.stage import TrainState
from tests.training.progress_of import finished
from tests.training.tiny_capture import pane_frame, tiny_capture, true_scene, write_tiny_capture

PANE = true_scene().planes


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """The tiny capture with its pane given as a rectangle and without masks."""
    root = write_tiny_capture(tmp_path / "capture")
    shutil.rmtree(root / "panes")
    write_planes(root / "planes.json", PANE)
    return root


def test_a_run_without_masks_takes_the_rectangle(capture: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert main(["train", "planar", "--data", str(capture), "--output", str(run), "--iterations", "20"]) == 0
    trained = read_planes(run / "point_cloud" / "iteration_20" / "planes.json")
    assert trained.labels == (1,)
    assert float((trained.normals[0] @ PANE.normals[0]).abs()) > 0.999
    torch.testing.assert_close(trained.half_sizes, PlaneFit().margin * PANE.half_sizes)
    assert main(["eval", str(run)]) == 0


def test_hand_written_values_are_few(capture: Path) -> None:
    entry = {"label": 3, "center": [0, 0, 2], "normal": [0, 0, 1], "tangent": [1, 0, 0], "half_sizes": [0.5, 0.4]}
    (capture / "planes.json").write_text(json.dumps([entry]))
    planes = capture_planes(load_dataset(capture), None, PlaneFit())
    assert planes.labels == (3,) and planes.mirrors == ()
    assert float(planes.base_reflectances) == pytest.approx(CLEAR_GLASS)


def test_glass_of_unknown_reflectance_starts_where_the_options_say_and_known_glass_where_it_is(capture: Path) -> None:
    dataset, fit = load_dataset(capture), PlaneFit(glass_reflectance=0.15)
    for given, expected in ((CLEAR_GLASS, 0.15), (0.3, 0.3)):
        logits = torch.logit(torch.tensor([given]))
        planes = capture_planes(replace(dataset, planes=replace(PANE, logit_reflectances=logits)), None, fit)
        assert float(planes.base_reflectances) == pytest.approx(expected)


def test_panes_named_only_by_masks_are_fitted_in_addition() -> None:
    other = replace(PANE, labels=(2,), centers=PANE.centers + torch.tensor([0.0, 0.0, 0.5]))
    points = torch.cat([tiny_capture().points.positions, pane_frame(PANE)])
    cloud = PointCloud(points, torch.zeros(len(points), 3, dtype=torch.uint8))
    dataset = replace(tiny_capture(), points=cloud, planes=other)
    planes = capture_planes(dataset, None, PlaneFit())
    assert planes.labels == (1, 2)
    torch.testing.assert_close(planes.centers[1], other.centers[0])
    assert float((planes.normals[0] @ PANE.normals[0]).abs()) > 0.99


@pytest.mark.parametrize("mirror", [True, False])
def test_mirrors_declared_by_the_capture_are_mirrors(mirror: bool) -> None:
    given = replace(PANE, mirrors=PANE.labels if mirror else ())
    scene = replace(true_scene(), planes=Planes.empty(), glass=true_scene().glass.select(torch.zeros(0).long()))
    state = TrainState(scene, seed=0)
    entry = PaneSetup(PlanarRecipe(glass_count=50), seed=0)
    finished(entry(state, replace(tiny_capture(), planes=given)))
    assert state.scene.planes.mirrors == given.mirrors
    assert (float(state.scene.planes.base_reflectances) > 0.99) == mirror


def test_a_rectangle_of_another_frame_is_refused(capture: Path) -> None:
    write_planes(capture / "planes.json", replace(PANE, centers=PANE.centers + 1000))
    with pytest.raises(InputError, match=r"no photograph shows pane 1 of .*planes\.json"):
        load_dataset(capture)


def test_a_rectangle_that_is_not_where_the_masks_show_the_pane_is_refused() -> None:
    dataset, aside = tiny_capture(), PANE.centers + 2 * PANE.half_sizes.max() * PANE.axes()[0]
    assert len(capture_planes(replace(dataset, planes=PANE), None, PlaneFit())) == 1
    with pytest.raises(PlaneFitError, match=r"disagree about the position of pane 1: \d+% of .* Mark it again"):
        capture_planes(replace(dataset, planes=replace(PANE, centers=aside)), None, PlaneFit())
    elsewhere = replace(PANE, centers=aside, labels=(2,))
    assert capture_planes(replace(dataset, planes=elsewhere, pane_labels=()), None, PlaneFit()).labels == (2,)


def test_a_damaged_file_is_named(capture: Path) -> None:
    (capture / "planes.json").write_text('[{"label": 1}]')
    with pytest.raises(InputError, match=r"planes\.json"):
        load_dataset(capture)


def test_a_capture_without_panes_is_refused_with_advice(capture: Path) -> None:
    (capture / "planes.json").unlink()
    with pytest.raises(PlaneFitError, match="glassplat annotate"):
        PlanarRecipe().initialise(load_dataset(capture))


def test_a_mirror_that_is_not_a_pane_is_refused() -> None:
    """A recipe that names mirrors also disables their detection."""
    recipe = PlanarRecipe(plane_fit=PlaneFit(mirror_labels=(5,)))
    with pytest.raises(PlaneFitError, match="names pane 5; expected some of 1"):
        recipe.initialise(tiny_capture())


def test_a_pane_that_only_a_test_photograph_shows_is_refused_by_name(tmp_path: Path) -> None:
    root = write_tiny_capture(tmp_path / "capture")
    held_out = root / "panes" / load_dataset(root).test[0].name
    mask = np.array(Image.open(held_out))
    mask[:8, :8] = 2
    Image.fromarray(mask).save(held_out)
    with pytest.raises(PlaneFitError, match=f"pane 2 is marked only in {held_out.name}, which are test photographs"):
        PlanarRecipe().initialise(load_dataset(root))
