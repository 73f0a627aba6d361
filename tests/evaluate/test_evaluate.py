import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from glassplat.captures.dataset import load_dataset
from glassplat.errors import InputError
from glassplat.evaluate.evaluate import RENDERED_REGIONS, EvaluatedView, evaluate, peak_memory_mib
from glassplat.evaluate.metrics import json_values, plane_table, psnr
from glassplat.evaluate.truth import load_truth
from glassplat.render.deferred import view_directions
from glassplat.render.frame import Frame
from glassplat.scene.camera import Camera
from glassplat.scene.corrections import Exposures
from glassplat.scene.gaussians import Gaussians
from glassplat.scene.panes import Planes
from glassplat.scene.scene import Scene
from tests.training.object_capture import RADIUS, write_object_capture

REQUIRED_KEYS = {
    "resolution",
    "split",
    "num_gaussians",
    "seconds_per_frame",
    "psnr",
    "ssim",
    "lpips",
    "lpips_backbone",
    "pane_psnr",
    "pane_region",
    "transmission_psnr",
    "reflection_psnr",
    "planes",
    "peak_memory_mib",
    "normal_error_deg",
    "reflective_normal_error_deg",
    "strength_error",
}


@pytest.fixture(autouse=True)
def _no_lpips(monkeypatch: pytest.MonkeyPatch) -> None:
    """Results must not depend on the packages installed on this machine."""
    monkeypatch.setattr("glassplat.evaluate.metrics.load_lpips", lambda: "no LPIPS: install it")


def test_results_are_json_and_complete(case) -> None:
    evaluation = evaluate(case.scene, case.renderer, case.dataset)
    assert set(evaluation.results) >= REQUIRED_KEYS
    json.dumps([evaluation.results, evaluation.per_view], allow_nan=False)
    for table in (evaluation.results, *evaluation.per_view.values()):
        assert all(f"{key}_reason" in table for key, value in table.items() if value is None)
    assert evaluation.results["resolution"] == "48x32"
    assert evaluation.results["split"] == "every 8th image by name"
    assert evaluation.results["lpips_reason"] == "no LPIPS: install it"


def test_image_metrics_are_means_over_all_views(case) -> None:
    evaluation = evaluate(case.scene, case.renderer, case.dataset)
    expected = [psnr(case.renderer.frames[view.camera.fx].rgb, view.photo) for view in case.dataset.test]
    assert [row["psnr"] for row in evaluation.per_view.values()] == pytest.approx(expected)
    assert evaluation.results["psnr"] == pytest.approx(sum(expected) / 3)
    assert list(evaluation.per_view) == ["a.jpg", "b.jpg", "c.jpg"]


def test_region_metrics_are_means_over_the_views_that_see_a_pane(case) -> None:
    evaluation = evaluate(case.scene, case.renderer, case.dataset)
    views = evaluation.per_view
    assert evaluation.results["pane_psnr"] == pytest.approx(
        (views["a.jpg"]["pane_psnr"] + views["b.jpg"]["pane_psnr"]) / 2
    )
    assert evaluation.results["pane_psnr_views"] == 2 and "psnr_views" not in evaluation.results
    assert views["c.jpg"]["pane_psnr"] is None
    assert views["c.jpg"]["pane_psnr_reason"] == "fewer than 100 pixels show a pane"
    assert evaluation.results["pane_region"] == "ground-truth pane labels"
    region = case.renderer.frames[41.0].layers["mask"] > 0.5
    assert views["b.jpg"]["pane_psnr"] == psnr(case.renderer.frames[41.0].rgb, case.dataset.test[1].photo, region)


def test_the_reflection_is_compared_up_to_one_gain(case) -> None:
    evaluation = evaluate(case.scene, case.renderer, case.dataset)
    assert evaluation.results["reflection_gain"] == pytest.approx(2.0, rel=1e-5)
    assert evaluation.results["reflection_psnr"] is None
    assert "equal" in evaluation.results["reflection_psnr_reason"]
    noisy = case.renderer.with_layers(reflection=torch.rand(32, 48, 3, generator=torch.Generator().manual_seed(2)))
    louder = noisy.with_layers(reflection=3 * noisy.frames[40.0].layers["reflection"])
    values = [evaluate(case.scene, renderer, case.dataset).results["reflection_psnr"] for renderer in (noisy, louder)]
    assert values[0] == pytest.approx(values[1], abs=0.02)
    assert 5 < values[0] < 20


def test_a_perfect_transmission_is_found_perfect(case) -> None:
    results = evaluate(case.scene, case.renderer, case.dataset).results
    assert results["transmission_psnr"] is None
    assert "equal" in results["transmission_psnr_reason"]


def test_without_layers_the_image_stands_for_the_transmission(case) -> None:
    renderer = case.renderer.without_layers()
    results = evaluate(replace(case.scene, planes=Planes.empty()), renderer, case.dataset).results
    assert 10 < results["transmission_psnr"] < 60
    assert results["reflection_psnr_reason"] == "the method renders no reflection"
    assert (results["reflection_psnr"], results["reflection_gain"], results["planes"]) == (None, None, [])
    assert results["reflection_gain_reason"] == "the method renders no reflection"
    assert results["pane_psnr"] is not None


def test_mirrors_have_no_transmission(case, monkeypatch: pytest.MonkeyPatch) -> None:
    truth = load_truth(case.dataset.truth)
    assert truth is not None
    views = {name: truth.view(name, 48, 32) for name in ("a.jpg", "b.jpg", "c.jpg")}
    mirrors = {name: replace(view, strength=torch.ones(32, 48)) for name, view in views.items() if view is not None}
    monkeypatch.setattr("glassplat.evaluate.truth.GroundTruth.view", lambda self, name, width, height: mirrors[name])
    results = evaluate(case.scene, case.renderer.without_layers(), case.dataset).results
    assert results["transmission_psnr"] is None
    assert "the pane is a mirror, which transmits nothing" in results["transmission_psnr_reason"]


def test_without_truth_the_rendered_mask_is_the_region(case) -> None:
    dataset = replace(case.dataset, truth=None)
    results = evaluate(case.scene, case.renderer, dataset).results
    assert results["pane_region"] == "rendered mask > 0.5"
    assert results["pane_psnr"] == evaluate(case.scene, case.renderer, case.dataset).results["pane_psnr"]
    assert results["transmission_psnr_reason"] == "the data set has no ground truth"
    assert results["planes"][0]["normal_error_deg"] is None


def test_without_truth_and_mask_there_is_no_region(case) -> None:
    results = evaluate(case.scene, case.renderer.without_layers(), replace(case.dataset, truth=None)).results
    assert (results["pane_psnr"], results["pane_region"]) == (None, None)
    assert results["pane_region_reason"] == "the data set has no ground truth, and the method renders no mask"


def test_plane_errors(case) -> None:
    results = evaluate(case.scene, case.renderer, case.dataset).results
    (plane,) = results["planes"]
    assert plane["label"] == 1
    assert plane["normal"] == pytest.approx([0, 0, -1])
    assert plane["normal_error_deg"] == pytest.approx(0, abs=1e-4)
    assert plane["offset_error"] == pytest.approx(0.1 / 4, rel=1e-5)
    assert plane["base_reflectance_error"] == pytest.approx(0.42)
    assert results["missing_panes"] == [2]


@pytest.mark.parametrize("angle", [0.01, 1.0, 30.0, 179.5])
def test_normal_error_is_the_angle_between_lines(case, angle: float) -> None:
    radians = math.radians(angle)
    planes = case.scene.planes.with_tensors({"raw_normals": torch.tensor([[math.sin(radians), 0, math.cos(radians)]])})
    (plane,) = plane_table(planes, load_truth(case.dataset.truth), extent=4.0)
    assert plane["normal_error_deg"] == pytest.approx(min(angle, 180 - angle), rel=1e-3)


def test_the_first_frame_is_rendered_once_more_than_it_is_timed(case) -> None:
    evaluate(case.scene, case.renderer, case.dataset)
    assert case.renderer.calls == [40.0, 40.0, 41.0, 42.0]


def ball_frame(scene: Scene, camera: Camera) -> Frame:
    """A ball with normals rotated by 90 degrees about z, and a strength 0.1 too high."""
    rays = torch.nn.functional.normalize(view_directions(camera), dim=-1)
    along = -(rays @ camera.center)
    beyond = RADIUS**2 - (camera.center.square().sum() - along.square())
    normals = (camera.center + (along - beyond.clamp(min=0).sqrt())[..., None] * rays) / RADIUS
    turned = torch.stack([-normals[..., 1], normals[..., 0], normals[..., 2]], dim=-1)
    strength = torch.where(normals[..., 2] > 0, 0.9, 0.1)
    return Frame(torch.ones_like(normals), {"normal": 0.5 * turned, "strength": strength})


def test_surfaces_are_compared_with_ground_truth_next_to_the_photographs(tmp_path: Path) -> None:
    dataset = load_dataset(write_object_capture(tmp_path / "ball"))
    seen: list[EvaluatedView] = []
    evaluation = evaluate(Scene(Gaussians.empty(1), 1.0), ball_frame, dataset, listen=seen.append)
    assert list(evaluation.per_view) == ["test/r_0.png", "test/r_1.png"]
    for evaluated, row in zip(seen, evaluation.per_view.values(), strict=True):
        assert evaluated.surface is not None and evaluated.surface.normals is not None
        normals = evaluated.surface.normals[evaluated.surface.covered]
        expected = torch.rad2deg(torch.acos(1 - normals[:, :2].square().sum(-1))).mean()
        assert row["normal_error_deg"] == pytest.approx(float(expected), abs=0.5)
        assert row["strength_error"] == pytest.approx(0.1, abs=0.02)
    assert evaluation.results["reflective_normal_error_deg"] == pytest.approx(
        sum(row["reflective_normal_error_deg"] for row in evaluation.per_view.values()) / 2
    )
    assert "normal_error_deg_reason" not in evaluation.results


def test_missing_true_surfaces_are_reported_with_a_reason(case) -> None:
    results = evaluate(case.scene, case.renderer, case.dataset).results
    assert results["normal_error_deg_reason"] == "there are no true normals for the photograph"
    assert results["strength_error_reason"] == "there is no true strength for the photograph"


def test_no_gradients_are_recorded(case) -> None:
    def renderer(scene, camera):
        assert not torch.is_grad_enabled()
        return case.renderer(scene, camera)

    assert evaluate(case.scene, renderer, case.dataset).results["num_test_views"] == 3


def test_a_broken_render_is_named(case) -> None:
    frame = case.renderer.frames[41.0]
    case.renderer.frames[41.0] = replace(frame, rgb=frame.rgb / 0)
    with pytest.raises(ValueError, match=r"render of b\.jpg contains non-finite values"):
        evaluate(case.scene, case.renderer, case.dataset)


def test_no_test_views_are_refused(case) -> None:
    with pytest.raises(InputError, match="has no test views"):
        evaluate(case.scene, case.renderer, replace(case.dataset, test=()))


def test_lpips_is_loaded_with_its_backbone(case, monkeypatch: pytest.MonkeyPatch) -> None:
    def constant(image: torch.Tensor, target: torch.Tensor) -> float:
        assert image.dtype == target.dtype == torch.uint8
        return 0.25

    monkeypatch.setattr("glassplat.evaluate.metrics.load_lpips", lambda: constant)
    results = evaluate(case.scene, case.renderer, case.dataset).results
    assert (results["lpips"], results["lpips_backbone"]) == (0.25, "vgg")


def test_plain_gives_a_reason_for_every_missing_number() -> None:
    assert json_values({"a": 1.5, "b": "because"}) == {"a": 1.5, "b": None, "b_reason": "because"}
    assert json_values({"a": math.inf})["a"] is None


def test_a_view_that_is_ignored_altogether_counts_in_no_mean(case) -> None:
    first, *others = case.dataset.test
    whole = replace(first, read_ignored=lambda: torch.ones_like(first.photo[..., 0], dtype=torch.bool))
    results = evaluate(case.scene, case.renderer, replace(case.dataset, test=(whole, *others))).results
    expected = evaluate(case.scene, case.renderer, replace(case.dataset, test=tuple(others))).results
    for name in ("psnr", "ssim", "right_half_psnr", "corrected_psnr"):
        assert results[name] == expected[name], name


def test_right_halves_need_a_left_half_that_counts(case) -> None:
    view = case.dataset.test[0]
    columns = torch.arange(view.camera.width).expand_as(view.photo[..., 0])
    halved = replace(view, read_ignored=lambda: columns < view.camera.width // 2)
    results = evaluate(case.scene, case.renderer, replace(case.dataset, test=(halved,))).results
    assert results["right_half_psnr"] is None and "left half" in results["right_half_psnr_reason"]
    assert results["psnr"] is not None


def test_another_exposure_costs_nothing_where_colours_are_corrected(case) -> None:
    view = case.dataset.test[0]
    rendered = case.renderer.frames[view.camera.fx].rgb
    dark = replace(view, read_photo=lambda: (255 * (0.5 * rendered + 0.1)).round().to(torch.uint8))
    results = evaluate(case.scene, case.renderer, replace(case.dataset, test=(dark,))).results
    assert results["psnr"] < 25 and min(results["corrected_psnr"], results["right_half_psnr"]) > 48


def test_a_pane_is_measured_where_it_is_not_ignored(case) -> None:
    view = case.dataset.test[1]
    columns = torch.arange(view.camera.width).expand_as(view.photo[..., 0])
    ignored = columns % 3 == 0
    frame = case.renderer.frames[view.camera.fx]
    dataset = replace(case.dataset, test=(replace(view, read_ignored=lambda: ignored),))
    results = evaluate(case.scene, case.renderer, dataset, regions=RENDERED_REGIONS).results
    assert results["pane_psnr"] == psnr(frame.rgb, view.photo, (frame.layers["mask"] > 0.5) & ~ignored)


def test_a_perfect_view_does_not_hide_the_mean_of_the_others(case) -> None:
    view, *others = case.dataset.test
    exact = (case.renderer.frames[view.camera.fx].rgb.clamp(0, 1) * 255).round().to(torch.uint8)
    perfect = replace(view, read_photo=lambda: exact)
    results = evaluate(case.scene, case.renderer, replace(case.dataset, test=(perfect, *others))).results
    without = evaluate(case.scene, case.renderer, replace(case.dataset, test=tuple(others))).results
    assert results["psnr"] == without["psnr"]
    alone = evaluate(case.scene, case.renderer, replace(case.dataset, test=(perfect,))).results
    assert alone["psnr"] is None and "infinite" in alone["psnr_reason"]


def test_peak_memory_is_measured_where_supported(monkeypatch: pytest.MonkeyPatch) -> None:
    peak = peak_memory_mib()
    assert isinstance(peak, float) and 50 < peak < 1e6
    monkeypatch.setitem(sys.modules, "resource", None)
    assert peak_memory_mib() == f"not available on {sys.platform}"


def test_test_views_are_compared_as_their_neighbours_were_exposed(case) -> None:
    affine = torch.zeros(2, 3, 4)
    affine[0, :, 3], affine[1, :, 3] = 0.06, 0.02
    scene = replace(case.scene, exposures=Exposures(affine, ("a1.jpg", "z.jpg")))
    seen: list[EvaluatedView] = []
    results = evaluate(scene, case.renderer, case.dataset, listen=seen.append).results
    plainly = evaluate(case.scene, case.renderer, case.dataset).results
    assert "neighbouring" in results["test_exposures"] and "scene" in plainly["test_exposures"]
    elsewhere = replace(scene, exposures=Exposures(affine, ("train/a1.jpg", "train/z.jpg")))
    assert "scene" in evaluate(elsewhere, case.renderer, case.dataset).results["test_exposures"]
    offsets = [float((e.photographed.photographed - e.frame.rgb).mean()) for e in seen]
    # One before a1, and two between a1 and z.
    assert offsets == pytest.approx([0.06, 0.04, 0.04], abs=1e-6)
    expected = [psnr(e.frame.rgb + offset, e.view.photo) for e, offset in zip(seen, offsets, strict=True)]
    assert results["psnr"] == pytest.approx(sum(expected) / 3)
    for layer in ("transmission_psnr", "reflection_psnr"):
        assert results[layer] == plainly[layer]
