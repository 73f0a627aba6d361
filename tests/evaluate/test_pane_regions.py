"""Every method is scored over the same pixels: those of the masks and of the planes fitted to them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.cli.evaluation import evaluate_run, pane_regions, plane_text
from glassplat.cli.runs import open_run
from glassplat.errors import InputError
from glassplat.evaluate.evaluate import RENDERED_REGIONS, TRUE_REGIONS, evaluate, marked_regions
from glassplat.evaluate.metrics import plane_table
from glassplat.render.frame import Frame
from tests.cli.tiny_run import write_run
from tests.render.tiny_scene import pane, shown_panes
from tests.training.tiny_capture import tiny_capture, true_scene, write_tiny_capture

NOTHING_RENDERED = Frame(torch.zeros(0), {})


def test_a_mask_marks_the_pane() -> None:
    regions = marked_regions(pane(2.0, half=0.1))
    view = tiny_capture().train[0]
    region = regions.find(view, NOTHING_RENDERED, None)
    assert isinstance(region, torch.Tensor)
    assert torch.equal(region, view.pane_labels > 0)


def test_the_fitted_plane_gives_the_region_without_a_mask() -> None:
    view = tiny_capture().train[1]
    assert view.pane_labels is None
    region = marked_regions(true_scene().planes).find(view, NOTHING_RENDERED, None)
    assert isinstance(region, torch.Tensor)
    assert torch.equal(region, shown_panes(true_scene().planes, view.camera)[0] > 0)
    assert 100 < int(region.sum()) < region.numel()


def test_methods_are_measured_over_the_same_pixels(tmp_path: Path) -> None:
    write_tiny_capture(tmp_path / "capture")
    runs = [open_run(write_run(tmp_path / name, planar=name == "planar")) for name in ("planar", "splat")]
    with_panes, without = (evaluate_run(run) for run in runs)
    assert with_panes["pane_region"] == without["pane_region"] == marked_regions(true_scene().planes).source
    assert with_panes["pane_psnr"] > without["pane_psnr"] + 1
    (plane,) = with_panes["planes"]
    assert plane["normal_drift_deg"] < 1
    assert plane["offset_drift"] < 0.05
    assert "from the plane of the masks" in plane_text(plane)


def test_an_evaluation_reports_progress(tmp_path: Path) -> None:
    write_tiny_capture(tmp_path / "capture")
    run, steps = open_run(write_run(tmp_path / "run")), []
    evaluate_run(run, align="always", show=steps.append)
    (count,) = {step.total for step in steps}
    assert count == len(run.dataset.test)
    aligning, rendering = "aligning the cameras of test views", "rendering test views"
    assert [(step.what, step.done) for step in steps] == [
        *((aligning, done) for done in range(count)),
        *((rendering, done) for done in range(count + 1)),
    ]


def test_regions_are_rendered_if_masks_give_no_plane(tmp_path: Path) -> None:
    path = write_run(tmp_path / "run")
    assert pane_regions(open_run(path).dataset, "auto") is RENDERED_REGIONS


@pytest.mark.parametrize(("source", "said"), [("truth", "no ground truth"), ("masks", "no pane masks")])
def test_a_source_that_the_capture_lacks_is_an_error(tmp_path: Path, source: str, said: str) -> None:
    dataset = open_run(write_run(tmp_path / "run")).dataset
    with pytest.raises(InputError, match=said):
        pane_regions(dataset, source)  # type: ignore[arg-type]


def test_the_truth_comes_first_and_masks_on_request(tmp_path: Path) -> None:
    write_tiny_capture(tmp_path / "capture")
    dataset = replace(open_run(write_run(tmp_path / "run")).dataset, truth=tmp_path)
    assert pane_regions(dataset, "auto") is TRUE_REGIONS
    assert pane_regions(dataset, "masks").planes is not None


def test_the_drift_of_a_plane_from_the_masks_is_measured() -> None:
    marked = pane(2.0, half=0.8)
    normal, angle = marked.normals[0], math.radians(5)
    sideways = torch.nn.functional.normalize(
        torch.linalg.cross(normal, torch.tensor([0.3, 1.0, 0.2]).to(normal)), dim=0
    )
    turned = math.cos(angle) * normal + math.sin(angle) * sideways
    trained = marked.with_tensors({"raw_normals": turned[None], "centers": marked.centers + 0.1 * turned})
    (plane,) = plane_table(trained, None, extent=2.0, marked=marked)
    assert plane["normal_drift_deg"] == pytest.approx(5, abs=1e-3)
    assert plane["offset_drift"] == pytest.approx(0.1 / 2.0, rel=1e-3)
    assert "normal_drift_deg" not in plane_table(trained, None, extent=2.0)[0]


def test_an_evaluation_takes_the_regions_it_is_given(case) -> None:  # type: ignore[no-untyped-def]
    dataset = replace(case.dataset, truth=None)
    results = evaluate(case.scene, case.renderer, dataset, regions=TRUE_REGIONS).results
    assert results["pane_psnr_reason"] == "the ground truth lacks this view"
